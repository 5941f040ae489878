"""Set-valued friction at a single state, on arrays: which joints stick, and the forces of all.

A joint i slides at the speed s_i = A_i(q) v, and its friction f_i acts on the bodies as A_i^T f_i. While it sticks, f_i is a
multiplier, that of the row A_i a = -(d A_i / dt) v, in addition to those of the constraints:

    M a + Psi_q^T lambda = F + G(lambda) + sum of A_i^T f_i over joints that stick.

G is the friction of joints that slide, by the Newton's method of rubbing.py. A joint is at rest if its speed is zero, up to
rounding errors in units of the scene; which of the joints at rest stick follows from the law (stick_or_slip.py), or is known from
a run. Where joints lock each other, the forces of least norm among those that the law allows count.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.annotations import Time, Vector
from udkjax.complementarity.stick_or_slip import AT_REST, FrictionModes, JointsAtRest, Response
from udkjax.equations.friction import rubbing
from udkjax.equations.friction.compliance import sharing
from udkjax.equations.friction.directed_friction import DirectedFriction, DirectedMechanism
from udkjax.equations.laws import udwadia_kalaba as uk
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.programs.scales import Scales
from udkjax.equations.terms import constraints, loads
from udkjax.pinv import Pseudoinverse
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.gradients import stop_gradients


class StickingLoads(NamedTuple):
    """Multipliers, and loads of friction, of a mechanism in which some joints stick."""

    multipliers: Float[Array, "m"]
    friction: Float[Array, "n"]  # loads of all friction without the constant torques, which `loads.force` includes
    by_name: dict[str, Float[Array, "n"]]  # loads of each friction


class StickingState(eqx.Module):
    """A mechanism with set-valued friction at one state.

    Args:
        mechanism: The scene.
        method: The pseudoinverse.
        baumgarte: Gains of Baumgarte stabilization; None: no stabilization.
        w: Weights of the rows (m,).
        scales: Scales of the scene.
        soft: Compliances of the rows (m,); None: loads of least norm.
        sticking: The joints that are known to stick, in the order of the forces; None: those at rest that the law holds.
    """

    mechanism: Mechanism
    method: Pseudoinverse
    baumgarte: Baumgarte | None
    w: Float[Array, "m"]
    scales: Scales
    soft: Float[Array, "m"] | None
    sticking: Bool[Array, "F"] | None

    def loads(self, t: Time, q: Vector, v: Vector) -> StickingLoads:
        """Return the multipliers and the friction at a state; NaN where friction admits no motion."""
        modes, failed = self.modes(t, q, v)
        directed = DirectedFriction.put_in(self.mechanism)
        found, _ = self._respond(directed, modes, self._rows(directed, t, q, v), t, q, v)
        return jax.tree.map(lambda x: jnp.where(failed, jnp.nan, x), found)

    def modes(self, t: Time, q: Vector, v: Vector) -> tuple[FrictionModes, Bool[Array, ""]]:
        """Return the modes of the joints, without derivatives, and True if no modes obey the law."""
        return stop_gradients(self)._decide(*stop_gradients((t, q, v)))

    def _decide(self, t: Time, q: Vector, v: Vector) -> tuple[FrictionModes, Bool[Array, ""]]:
        directed = DirectedFriction.put_in(self.mechanism)
        unit, rows = directed.units(self.scales.length), self._rows(directed, t, q, v)
        speed, A = rows.speeds, rows.slopes[len(self.w) :]
        sticking = jnp.zeros(len(unit), bool) if self.sticking is None else self.sticking
        rest = sticking | (jnp.abs(speed) <= AT_REST.closed * unit * self.scales.rate)
        D, root = uk.D(self.mechanism, t, q, self.w), uk.inverse_sqrt_mass(self.mechanism)
        plus = uk.pseudoinverse(self.method, D)
        u = jax.vmap(lambda row: row - plus @ (D @ row))(root * A)
        mobility, accelerations = jnp.sum((root * A) ** 2, axis=1), unit * self.scales.rate**2
        rest = rest & jnp.all(jnp.isfinite(u))
        none = jnp.zeros_like(rest)
        joints = JointsAtRest.of(rest, jnp.sign(speed), u @ u.T, mobility, sticking, none, accelerations, jnp)
        respond = jax.jit(lambda modes: self._respond(directed, modes, rows, t, q, v)[1])
        found, failed, _ = joints.decide(respond, jnp.zeros(len(unit)), none, none, jnp)
        if self.sticking is None:
            return found, failed
        known = FrictionModes(sticking, jnp.where(rest, 0.0, joints.sliding), none, none)
        return jax.tree.map(lambda x, y: jnp.where(failed, x, y), known, found), jnp.asarray(False)

    def _respond(
        self, directed: DirectedMechanism, modes: FrictionModes, rows: "_Rows", t: Time, q: Vector, v: Vector
    ) -> tuple[StickingLoads, Response]:
        """Return the loads in given modes, and the accelerations of the joints with the margins of their friction forces."""
        mechanism, root, count = directed.with_sides(modes.sides(jnp)), uk.inverse_sqrt_mass(self.mechanism), len(self.w)
        held = jnp.where(modes.locked, self.scales.length / directed.units(self.scales.length), 0.0)  # weights as in `Scales`
        w, free = jnp.concatenate([self.w, held]), uk.a_F(mechanism, t, q, v)
        D, b = w[:, None] * rows.slopes * root, w * (rows.drift - rows.slopes @ free)
        plus, share = uk.pseudoinverse(self.method, D), sharing(D, self.soft, w)

        def multipliers(friction: Array) -> Array:
            return share(-w * (plus.T @ (plus @ (b - D @ (root * friction)))))

        found = rubbing.settle(multipliers, mechanism, t, q, v)
        friction = rubbing.rubbing_loads(mechanism, t, q, v, found)
        a = free + root * (root * friction + plus @ (b - D @ (root * friction)))
        limits, of_locks, A = self._limits(directed, found), found[count:], rows.slopes[count:]
        total = loads.force(mechanism, t, q, v) + friction - A.T @ of_locks
        response = Response(A @ a - rows.drift[count:], limits - of_locks, limits + of_locks)
        by_name = rubbing.loads_of_friction(mechanism, t, q, v, found)
        for (_, k), row, multiplier in zip(directed.joints, A, of_locks, strict=True):
            by_name[mechanism.force_names[k]] = by_name[mechanism.force_names[k]] - row * multiplier
        return StickingLoads(found[:count], total - loads.force(self.mechanism, t, q, v), by_name), response

    def _limits(self, directed: DirectedMechanism, multipliers: Float[Array, "k"]) -> Float[Array, "F"]:
        """Return the largest forces (N, N m) by which the joints with set-valued friction stick, for given multipliers."""
        owners = [name for name, _ in constraints.row_names(self.mechanism)]
        found = []
        for name, k in directed.joints:
            friction: Any = self.mechanism._forces[k]
            own = [multipliers[row] for row, owner in enumerate(owners) if owner == name]
            found.append(friction.largest_force(self.mechanism.joints[name], own))
        return jnp.stack([jnp.asarray(x, float) for x in found])

    def _rows(self, directed: DirectedMechanism, t: Time, q: Vector, v: Vector) -> "_Rows":
        speeds = directed.sliding_speeds
        s, rate = jax.jvp(lambda q: speeds(q, v), (q,), (v,))
        slopes = jnp.concatenate([constraints.psi_q(self.mechanism, t, q), jax.jacfwd(speeds, 1)(q, v)])
        return _Rows(s, slopes, jnp.concatenate([uk.drift(self.mechanism, t, q, v, self.baumgarte), -rate]))


class _Rows(NamedTuple):
    """Rows slopes a = drift: those of the constraints, followed by those that lock each joint with set-valued friction."""

    speeds: Float[Array, "F"]  # of the joints, A v
    slopes: Float[Array, "m+F n"]  # Psi_q, and A
    drift: Float[Array, "m+F"]  # gamma - 2 alpha Psi_dot - beta^2 Psi, and -(d A / dt) v


def sticking_joints(mechanism: Mechanism) -> tuple[str, ...]:
    """Return the names of the joints with set-valued friction, in the order of the forces."""
    return tuple(name for name, _ in DirectedFriction.put_in(mechanism).joints)


def known_sticking(mechanism: Any, sticking: Mapping[str, Any] | None) -> Bool[Array, "T F"] | None:
    """Return a mask of the joints that stick in a run, if this is known.

    Args:
        mechanism: The scene.
        sticking: `Solution.sticking`; None: it is not known.

    Returns:
        A mask over times and joints with set-valued friction, in the order of the forces; None: unknown, or no such joints.
    """
    if not sticking or not mechanism.has_bodies:
        return None
    names = sticking_joints(mechanism)
    if not names or not set(names) <= set(sticking):  # only contacts stick, or it is a run of another mechanism
        return None
    return jnp.stack([jnp.asarray(sticking[name]) for name in names], axis=-1)
