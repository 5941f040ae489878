"""Jumps: what an event changes in an instant: velocities, the phase, the joints that it adds.

Impact: the jump of the velocities when a contact closes, with all constraints kept, however redundant. A contact g(t, q) >= 0 has
the rate g_dot = n v + g_t, n = g_q. Its impulse acts along n^T, those of the constraints along Psi_q^T:
M (v+ - v-) = n^T Lambda + Psi_q^T mu, Psi_q (v+ - v-) = 0, and Newton's law g_dot+ = -e g_dot-. With

    D = Psi_q M^(-1/2),        u = M^(-1/2) n^T,        u_t = (I - D^+ D) u,

where u_t is the part of the impulse that the constraints do not take, this is

    v+ = v- - (1 + e) g_dot- M^(-1/2) u_t / (u_t . u_t).

It is what D^+ of the constraints' rows with the row u^T appended gives, of [0; -(1 + e) g_dot-], where that row does not depend
on the others; where it does, no jump can reverse g_dot, and u_t is zero up to rounding. The kinetic energy of a scleronomic
mechanism changes by -(1 - e^2) / 2 g_dot-^2 / (u_t . u_t).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.textbook import TextbookEquations
from udkjax.integrate.events.actions import Impact
from udkjax.integrate.events.crossings import ZERO_RATE_2
from udkjax.integrate.events.hybrid import Added, ConditionValues, Hybrid, RunState
from udkjax.integrate.gradients import stop_gradients

# (u_t . u_t) / (u . u): the square of the sine between the contact's row and those of the constraints, in the metric of M.
BLOCKED = 1e-16
# Of a condition's scale per T: an impact slower than this, where the contact is pressed on, is rest. Its rebound rises by 1e-10
# of that scale.
REST = 1e-5
OPEN = 1e-6  # of L, or rad: a joint that is attached must be closed up to that


class VelocityJump(NamedTuple):
    """The change of the velocities in an impact without restitution; times 1 + e it is that of any impact."""

    dv: Float[Array, "n"]
    free: Bool[Array, ""]  # whether the constraints leave the contact any motion


class JumpResult(NamedTuple):
    """The state after an event."""

    state: RunState
    blocked: Bool[Array, ""]  # the constraints leave an impact no motion, or an attached joint is open


def velocity_jump(
    equations: TextbookEquations, t: Float[ArrayLike, ""], q: Float[Array, "n"], normal: Float[Array, "n"], rate: Float[Array, ""]
) -> VelocityJump:
    """Bring g_dot, now `rate`, to zero by an impulse along `normal` = g_q, with all constraints kept."""
    mechanism, w = equations.mechanism, equations.weights
    root, D = uk.inverse_sqrt_mass(mechanism), uk.D(mechanism, t, q, w)
    u = root * normal
    u_t = u - uk.pseudoinverse(equations.method, D) @ (D @ u)
    square = u_t @ u_t
    free = square > BLOCKED * (u @ u)
    return VelocityJump(jnp.where(free, -rate / jnp.where(free, square, 1.0) * root * u_t, 0.0), free)


def comes_to_rest(hybrid: Hybrid, k: Int[Array, ""], values: ConditionValues) -> Bool[Array, ""]:
    """Tell whether an event is an impact that is too slow to rebound, of a contact that is pressed on."""
    e, unit = k % hybrid.count, values.scale[k % hybrid.count] * hybrid.rate
    slow, pressed = jnp.abs(values.rate[e]) < REST * unit, values.rate_2[e] < -ZERO_RATE_2 * unit * hybrid.rate
    return jnp.array(hybrid.impacts)[e] & (k < hybrid.count) & slow & pressed


def apply_event(
    hybrid: Hybrid, k: Int[Array, ""], rests: Bool[Array, ""], state: RunState, values: ConditionValues
) -> JumpResult:
    """Apply the action of event k, or, from `hybrid.count` on, release the contact of event k - count.

    Args:
        hybrid: the system.
        k: which event.
        rests: whether it is an impact that comes to rest.
        state: the state before.
        values: the conditions there.
    """
    releases, e = k >= hybrid.count, k % hybrid.count
    t, q, v, phase, added = state
    blocked, dv = jnp.array(False), jnp.zeros_like(v)
    if hybrid.impacts.any():
        hits = jnp.array(hybrid.impacts)[e] & ~releases

        def jump(p: int, t: Array, q: Array, normal: Array, rate: Array, added: Added) -> VelocityJump:
            return velocity_jump(hybrid.textbook(p, added), t, q, normal, rate)

        found = hybrid.in_phase(phase, jump, t, q, values.normals[e], values.rate[e], added)
        blocked = hits & ~found.free
        dv = jnp.where(hits, (1 + jnp.where(rests, 0.0, _restitutions(hybrid)[e])) * found.dv, 0.0)
    v = v + dv
    after = jnp.where(rests, hybrid.table("resting")[phase, e], hybrid.table("after")[phase, e])
    after = jnp.where(releases, hybrid.table("freed")[phase, e], after)
    if hybrid.phases.added:
        is_new = [~releases & (e == by) for by, _ in hybrid.phases.added_by]
        new = (hybrid.phases.joint_at(i, q) for i in range(len(added)))
        added = tuple(
            jax.tree.map(lambda a, b, is_new=is_new: jnp.where(is_new, a, b), a, b)
            for is_new, a, b in zip(is_new, new, added, strict=True)
        )
        adds = jnp.any(jnp.stack(is_new))

        def close(p: int, t: Array, q: Array, v: Array, added: Added) -> tuple[Array, Array]:
            # Velocities jump to a state that the phase allows: its derivatives are not those of a small correction.
            equations = hybrid.textbook(p, added)
            return uk.project(equations.mechanism, t, q, v, equations.method, equations.weights)

        q1, v1 = hybrid.in_phase(after, close, t, q, v, added)
        blocked = blocked | (adds & (stop_gradients(hybrid.scales.size(q1 - q)) > OPEN))
        q, v = jnp.where(adds, q1, q), jnp.where(adds, v1, v)
    return JumpResult(RunState(t, q, v, after, added), blocked)


def _restitutions(hybrid: Hybrid) -> Float[Array, "E"]:
    return jnp.stack([e.action.restitution if isinstance(e.action, Impact) else jnp.zeros(()) for e in hybrid.events])
