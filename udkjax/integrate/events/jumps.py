"""Jumps: what an event changes in an instant: velocities, the phase, the joints that it adds, the contacts that are held.

The action of the event comes first, then all contacts that are closed, together, by their complementarity (`impacts`): whatever
the event is, but for `Log` and `Stop`, it can push or lift them.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from udkjax.integrate.events.crossings import ConditionValues
from udkjax.integrate.events.impacts import ATTACHABLE, OPEN, ContactChanges, hit_contacts, rows_of_directions
from udkjax.integrate.events.runs import MemberIndices, RunState, take
from udkjax.integrate.events.system import StateValues, System
from udkjax.transforms.gradients import stop_gradients


class JumpResult(NamedTuple):
    """The states after an event of each of some members."""

    state: RunState
    contacts: ContactChanges | None  # None where no event is an impact
    blocked: Bool[Any, "b"]  # the constraints leave an impact no motion, or an attached joint is open


def apply_event(
    system: System,
    some: MemberIndices,
    k: Int[Any, "b"],
    before: RunState,
    values: ConditionValues,
    found: StateValues,
    closed: Int[Any, "b E"] | None = None,
) -> JumpResult:
    """Apply the action of event k of each of some members, or, from E on, release the contact of event k - E.

    Args:
        system: the system.
        some: the members.
        k: indices of the events.
        before: their states.
        values: the conditions there.
        found: their derivatives, and directions of impulses.
        closed: the states of the contacts that take part, OPEN, TOUCHES or SLOW; None where they are to be found.
    """
    plan, xp = system.plan, system.xp
    releases, e = k >= plan.count, k % plan.count
    t, q, v, phase, joints = before
    after = xp.where(releases, phase, xp.asarray(plan.after)[phase, e])
    blocked, adds = xp.zeros_like(releases), ~releases & xp.asarray(plan.adds)[e]
    if plan.adds.any() and (xp is not np or adds.any()):
        joints = system.add_joints(some, xp.where(adds, e, -1), q, joints)
        # Velocities jump to a state that the phase allows, but for contacts at rest, which may be left.
        q1, _ = system.project(some, RunState(t, q, v, after, joints))
        _, v1 = system.project(some, RunState(t, q1, v, xp.asarray(plan.free)[after], joints), is_free=True)
        moved = xp.abs(q1 - q) / take(system.coordinates, some)
        moved = moved if xp is np else stop_gradients(moved)
        blocked = adds & (xp.max(moved, axis=-1) > ATTACHABLE)
        q, v = (xp.where(adds[:, None], x, y) for x, y in ((q1, q), (v1, v)))
    state, acts = RunState(t, q, v, after, joints), (releases | xp.asarray(plan.changes)[e])[:, None]
    if not plan.impacts.any() or (xp is np and not acts.any()):
        return JumpResult(state, None, blocked)

    free, held = state._replace(phase=xp.asarray(plan.free)[after]), xp.asarray(plan.held)[phase]
    is_evaluated = xp is np and not plan.adds.any() and np.array_equal(free.phase, phase)
    found = found if is_evaluated else system.look(some, free, is_free=True)
    rows = rows_of_directions(found.by_q, found.directions, take(system.inverse_mass, some))

    def second_rates(v: Any) -> Any:
        after = free._replace(v=v)
        return system.look(some, after if xp is np else stop_gradients(after), is_free=True).rate_2

    hit = hit_contacts(system.contacts(some), k, v, held, values, rows, found.rate, second_rates, closed, xp)
    contacts = hit._replace(
        closed=xp.where(acts, hit.closed, OPEN),
        hits=hit.hits & acts,
        held=xp.where(acts, hit.held, held),
        ends=hit.ends & acts,
    )
    phase = plan.with_contacts(free.phase, contacts.held, xp)
    return JumpResult(state._replace(v=xp.where(acts, hit.v, v), phase=phase), contacts, blocked | (acts[:, 0] & hit.blocked))
