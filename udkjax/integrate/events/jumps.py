"""Jumps: what an event changes in an instant: velocities, the phase, the joints that it adds, the contacts that are held.

The action of the event comes first, then all contacts that are closed, together, by their complementarity (`impacts`): whatever
the event is, but for `Log` and `Stop`, it can push or lift them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from udkjax.equations import udwadia_kalaba as uk
from udkjax.integrate.events.crossings import ConditionValues
from udkjax.integrate.events.hybrid import Hybrid, RunState
from udkjax.integrate.events.impacts import ATTACHABLE, OPEN, ContactChanges, contact_rows, hit_contacts
from udkjax.integrate.gradients import stop_gradients


class JumpResult(NamedTuple):
    """The state after an event."""

    state: RunState
    contacts: ContactChanges | None  # None where no event is an impact
    blocked: Bool[Array, ""]  # the constraints leave an impact no motion, or an attached joint is open


def apply_event(
    hybrid: Hybrid, k: Int[Array, ""], state: RunState, values: ConditionValues, closed: Int[Array, "E"] | None = None
) -> JumpResult:
    """Apply the action of event k, or, from `hybrid.count` on, release the contact of event k - count.

    Args:
        hybrid: the system.
        k: index of the event.
        state: the state before.
        values: the conditions there.
        closed: the states of the contacts that take part, OPEN, TOUCHES or SLOW; None where they are to be found.
    """
    releases, e = k >= hybrid.count, k % hybrid.count
    t, q, v, phase, added = state
    blocked, held = jnp.array(False), hybrid.is_held(phase)
    after = jnp.where(releases, phase, hybrid.table("after")[phase, e])
    if hybrid.phases.added:
        is_new = [~releases & (e == by) for by, _ in hybrid.phases.added_by]
        new = (hybrid.phases.joint_at(i, q) for i in range(len(added)))
        added = tuple(
            jax.tree.map(lambda a, b, is_new=is_new: jnp.where(is_new, a, b), a, b)
            for is_new, a, b in zip(is_new, new, added, strict=True)
        )
        adds = jnp.any(jnp.stack(is_new))

        def close(p: int, t: Array, q: Array, v: Array, added: tuple) -> tuple[Array, Array]:
            # Velocities jump to a state that the phase allows: its derivatives are not those of a small correction.
            equations = hybrid.textbook(p, added)
            return uk.project(equations.mechanism, t, q, v, equations.method, equations.weights)

        q1, v1 = hybrid.in_phase(after, close, t, q, v, added)
        if hybrid.impacts.any():  # a contact at rest may be left
            v1 = hybrid.in_phase(hybrid.without_contacts(after), close, t, q1, v, added, among=hybrid.contact_free_phases)[1]
        blocked = adds & (stop_gradients(hybrid.scales.size(q1 - q)) > ATTACHABLE)
        q, v = jnp.where(adds, q1, q), jnp.where(adds, v1, v)
    after = RunState(t, q, v, after, added)
    if not hybrid.impacts.any():
        return JumpResult(after, None, blocked)
    found = _hit_contacts(hybrid, k, after, held, values, closed)
    acts = hybrid.changes_motion(k)
    found = found._replace(
        closed=jnp.where(acts, found.closed, OPEN),
        hits=found.hits & acts,
        held=jnp.where(acts, found.held, held),
        ends=found.ends & acts,
    )
    phase = hybrid.with_contacts(hybrid.without_contacts(after.phase), found.held)
    after = after._replace(v=jnp.where(acts, found.v, v), phase=phase)
    return JumpResult(after, found, blocked | (acts & found.blocked))


def _hit_contacts(
    hybrid: Hybrid,
    k: Int[Array, ""],
    state: RunState,
    held: Bool[Array, "E"],
    values: ConditionValues,
    closed: Int[Array, "E"] | None,
) -> ContactChanges:
    """Hit the contacts that are closed at an event; `state` is that before, in the phase that is to follow but for contacts."""
    E = hybrid.count
    t, q, v, phase, added = state
    free_phase = hybrid.without_contacts(phase)
    rate, normals = hybrid.conditions_and_rates(t, q, v)[1], jax.jacfwd(hybrid.conditions, 1)(t, q, v)
    of_phase = lambda p, t, q, normals, added: contact_rows(hybrid.textbook(p, added), t, q, normals)  # noqa: E731
    rows = hybrid.in_phase(free_phase, of_phase, t, q, normals, added, among=hybrid.contact_free_phases)

    def second_rates(v: Array) -> Array:
        after = stop_gradients(RunState(t, q, v, free_phase, added))
        return hybrid.second_rates(after.t, after.q, v, hybrid.accelerations(after, among=hybrid.contact_free_phases))

    before = ConditionValues(values.h[:E], values.rate[:E], values.rate_2[:E], values.a, values.scale[:E])
    return hit_contacts(hybrid.contacts, k, v, held, before, rows, rate, second_rates, closed)
