"""Jumps: the changes of velocities, phase, added joints and held contacts at the instant of an event.

The action of the event is applied first. The complementarity of all closed contacts is then solved (`impacts`), since every event
except `Log` and `Stop` can push or lift them. Their positions follow (`closing`).
"""

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from udkjax.complementarity.stick_or_slip import FrictionModes
from udkjax.integrate.events.instant.closing import Gaps, close_contacts
from udkjax.integrate.events.instant.impacts import (
    ATTACH_TOL,
    OPEN,
    ContactChanges,
    Contacts,
    KnownContacts,
    hit_contacts,
    rows_of_directions,
    rows_of_mobilities,
)
from udkjax.integrate.events.instant.runs import MemberIndices, RunState, take
from udkjax.integrate.events.instant.sticking import settle_friction
from udkjax.integrate.events.instant.system import StateValues, System
from udkjax.integrate.events.law.actions import NUMBERS_OF_ACTIONS
from udkjax.integrate.events.law.crossings import NO_EVENT, ConditionValues
from udkjax.integrate.solution import Result
from udkjax.transforms.gradients import stop_gradients


class JumpResult(NamedTuple):
    """The states of b members after an event, the changes of their contacts, and a `Result` for each member."""

    state: RunState
    contacts: ContactChanges | None  # None if no event is an impact
    code: Int[Any, "b"]  # not successful if constraints block an impact, an attached joint is open, or friction has no solution


def apply_event(
    system: System,
    members: MemberIndices,
    k: Int[Any, "b"],
    before: RunState,
    values: ConditionValues,
    state_values: StateValues,
    known: KnownContacts | None = None,
    modes: FrictionModes | None = None,
) -> JumpResult:
    """Apply the action of event k of each member, or, if k >= E, release the contact of event k - E.

    Args:
        system: the system.
        members: the indices of the members; None: all.
        k: indices of the events.
        before: the states of the members before the event.
        values: the conditions in these states.
        state_values: derivatives of the conditions, and directions of impulses.
        known: the states of contacts at the event, from the run that is differentiated; None: they are determined here.
        modes: the modes of joints with set-valued friction after the event; None: they are determined here.
    """
    found, gaps = _apply_event(system, members, k, before, values, state_values, known)
    if system.plan.sticking:
        found = _settle_friction(system, members, k, found, modes)
    return found if gaps is None else found._replace(state=found.state._replace(q=close_contacts(system, gaps, found.state)))


def _settle_friction(
    system: System, members: MemberIndices, k: Int[Any, "b"], found: JumpResult, modes: FrictionModes | None
) -> JumpResult:
    """Return the result of an event with the modes of all joints that may stick, which are decided here unless given."""
    plan, xp, contacts = system.plan, system.xp, found.contacts
    stopped = xp.where(xp.asarray(plan.slides)[k % plan.count], k, NO_EVENT)
    resting = None if contacts is None else contacts.rests
    state, code = settle_friction(system, members, found.state, stopped, modes, resting)
    if contacts is not None:
        contacts = contacts._replace(held=xp.where(plan.impacts, plan.held(state.phase, xp), contacts.held))
    return JumpResult(state, contacts, xp.where(found.code == Result.successful, code, found.code))


def _apply_event(
    system: System,
    members: MemberIndices,
    k: Int[Any, "b"],
    before: RunState,
    values: ConditionValues,
    state_values: StateValues,
    known: KnownContacts | None,
) -> tuple[JumpResult, Gaps | None]:
    """Apply events, except for decisions about joints with set-valued friction.

    Also return the gaps of the contacts, for `close_contacts`; None if no contact can push another one.
    """
    plan, xp = system.plan, system.xp
    releases, e = k >= plan.count, k % plan.count
    t, q, v, phase, joints = before
    if plan.kinks.any():
        joints = system.with_sides(members, joints, system.turned(members, k, before))
    after = xp.where(releases[:, None], phase, plan.after(phase, e, xp))
    blocked, adds = xp.zeros_like(releases), ~releases & xp.asarray(plan.adds)[e]
    if plan.adds.any() and (xp is not np or adds.any()):
        joints = system.add_joints(members, adds[:, None] & (e[:, None] == np.array(plan.added_by)), q, joints)
        # The new velocities satisfy the phase without its contacts at rest, since these contacts may open.
        q1, _, _ = system.project(members, RunState(t, q, v, after, joints))
        _, v1, _ = system.project(members, RunState(t, q1, v, plan.free(after), joints), is_free=True)
        # A nearly dependent row amplifies rounding: after one projection, what stops would still creep past its event.
        _, v1, left = system.project(members, RunState(t, q1, v1, plan.free(after), joints), is_free=True)
        # A driver may demand velocities that the new joints do not allow: v1 is then a compromise, or violates either row.
        unit = take(system.coordinates, members)
        moved, slower, faster = (xp.max(xp.abs(x) / unit, axis=-1) for x in (q1 - q, v1, v))
        is_open = (moved > ATTACH_TOL) | (left > ATTACH_TOL * xp.maximum(slower, faster))
        blocked = adds & (is_open if xp is np else stop_gradients(is_open))
        q, v = (xp.where(adds[:, None], x, y) for x, y in ((q1, q), (v1, v)))
    acts = ((releases | xp.asarray(plan.changes)[e]) & ~xp.asarray(plan.slides)[e])[:, None]
    state = RunState(t, q, v, after, joints)
    if not plan.impacts.any() or (xp is np and not acts.any()):
        return JumpResult(state, None, _code(blocked, xp)), None

    free, held = state._replace(phase=plan.free(after)), plan.held(phase, xp)
    is_evaluated = xp is np and v is before.v and np.array_equal(free.phase, phase)
    state_values = state_values if is_evaluated else system.look(members, free, is_free=True)
    if not plan.has_bodies:
        rows = rows_of_mobilities(state_values.by_q, state_values.directions, state_values.mobilities)
    else:
        normals = xp.where(plan.slides[:, None], state_values.by_v, state_values.by_q)
        rows = rows_of_directions(normals, state_values.directions, take(system.inverse_mass, members))
    rate = xp.where(plan.slides, state_values.g, state_values.rate)  # of contacts with friction, also along their lines

    def second_rates(v: Any) -> Any:
        after = state._replace(v=v, phase=plan.without_contacts(state.phase))
        return system.look(members, after if xp is np else stop_gradients(after), is_free=not plan.sticking).rate_2

    hit = hit_contacts(_contacts(system, members), k, v, held, values, rows, rate, second_rates, known, xp)
    contacts = hit._replace(
        contact_state=xp.where(acts, hit.contact_state, OPEN),
        hits=hit.hits & acts,
        held=xp.where(acts, hit.held, held),
        rests=xp.where(acts, hit.rests, held & plan.impacts),
        ends=hit.ends & acts,
    )
    phase = plan.with_contacts(free.phase, contacts.held, xp)
    code = _code(blocked | (acts[:, 0] & hit.blocked), xp)
    result = JumpResult(state._replace(v=xp.where(acts, hit.v, v), phase=phase), contacts, code)
    may_push = plan.adds.any() or (plan.held_at_rest.any() and plan.impacts.sum() > 1)
    return result, Gaps(rows, state_values.g, values.scale, plan.impacts & rows.free & acts) if may_push else None


def _contacts(system: System, members: MemberIndices) -> Contacts:
    """Return the properties of the contacts of members."""
    plan, numbers = system.plan, system.numbers_of_actions(members)
    restitution, friction = (numbers[:, NUMBERS_OF_ACTIONS.index(name)] for name in ("rebound", "friction"))
    given = restitution, friction, take(system.rate, members)
    return Contacts(plan.impacts, plan.held_at_rest, plan.stops_at_rest, plan.tangents, *given)


def _code(blocked: Bool[Any, "b"], xp: ModuleType) -> Int[Any, "b"]:
    return xp.where(blocked, int(Result.event_impossible), int(Result.successful))
