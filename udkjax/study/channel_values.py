"""What channels show of a motion: positions, rates, accelerations, reactions, and functions of the user's own."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.equations.abstract_system import MechanismSystem
from udkjax.equations.textbook import prepare
from udkjax.pinv import SVD
from udkjax.scene.bodies import GROUND, Frame, between
from udkjax.scene.mechanism import Mechanism
from udkjax.study.channels import LOADS, Channel, Quantity, Trajectory


def measure(mechanism: Mechanism, solution: Trajectory, channels: Sequence[Channel | Quantity]) -> Float[Array, "T C"]:
    """Compute the values of channels at the output times of a solution; it may be traced and batched.

    Accelerations and reactions are those of the constraints without stabilization,

        lambda = -(D^+)^T D^+ b,    M a = F - Psi_q^T lambda,

    of minimum norm where constraints are redundant, by singular values (`SVD`), whatever the method of the run: a batch would
    compute both sides of a branch. They are only computed where a channel needs them.

    Args:
        mechanism: the mechanism that moved.
        solution: a `Solution`, or another pytree with ts (T,), q and v (T, bodies, 3).
        channels: what is measured of it.

    Returns:
        Values (T, C) in SI units, one channel a column. Where a state is not a number, after a run has failed, nor are its
        values; derivatives are zero there, and unharmed elsewhere.
    """
    reached = jnp.all(jnp.isfinite(solution.q) & jnp.isfinite(solution.v), axis=(1, 2))
    finite = reached[:, None, None]
    # The scene's guess stands in: any state at which all derivatives are numbers.
    q, v = (jnp.where(finite, x, jax.lax.stop_gradient(x0)) for x, x0 in ((solution.q, mechanism.q0), (solution.v, mechanism.v0)))
    filled = eqx.tree_at(lambda s: (s.q, s.v), solution, (q, v))
    motion = _Motion(mechanism, solution.ts, q, v)
    columns = [c.function(mechanism, filled) if isinstance(c, Quantity) else _MEASURES[c.section](c, motion) for c in channels]
    return jnp.where(reached[:, None], jnp.stack(columns, -1), jnp.nan) if columns else jnp.zeros((len(q), 0))


class _Dynamics(NamedTuple):
    """Psi_q, lambda, the constraint of each of its m rows, and the accelerations, at all output times."""

    psi_q: Float[Array, "T m bodies 3"]
    multipliers: Float[Array, "T m"]
    row_owners: list[str]
    a: Float[Array, "T bodies 3"]


@dataclass(frozen=True, eq=False)
class _Motion:
    """States at all output times, and what follows from them."""

    mechanism: Mechanism
    ts: Float[Array, "T"]
    q: Float[Array, "T bodies 3"]
    v: Float[Array, "T bodies 3"]

    @cached_property
    def dynamics(self) -> _Dynamics:
        """Solve the equations of motion: only where a channel asks for it."""
        equations: MechanismSystem = prepare(self.mechanism, SVD())
        mass = jnp.stack([jnp.stack([body.mass, body.mass, body.inertia]) for body in self.mechanism.bodies.values()])

        def at(t, q, v):
            _, F, psi_q, _ = equations.matrices(t, q.ravel(), v.ravel())
            multipliers = equations.multipliers(t, q.ravel(), v.ravel())
            return psi_q.reshape(-1, *q.shape), multipliers, (F - psi_q.T @ multipliers).reshape(q.shape) / mass

        psi_q, multipliers, a = jax.vmap(at)(self.ts, self.q, self.v)
        return _Dynamics(psi_q, multipliers, [name for name, _ in equations.row_names], a)

    @cached_property
    def frames(self) -> dict[str, Frame]:
        """The frame of each body and of the ground, each of its entries (T,)."""
        found = {}
        for body in (*self.mechanism.body_names, GROUND):
            (x, y, angle), (vx, vy, omega) = self._entries(self.q, body), self._entries(self.v, body)
            found[body] = Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), vx, vy, omega)
        return found

    @cached_property
    def loads(self) -> dict[str, Float[Array, "T bodies 3"]]:
        """Forces and torques of each constraint on all bodies, -Psi_q^T lambda of its rows."""
        psi_q, multipliers, owners, _ = self.dynamics
        by_row = -multipliers[..., None, None] * psi_q
        rows = {owner: [k for k, name in enumerate(owners) if name == owner] for owner in owners}
        return {owner: by_row[:, own[0] : own[-1] + 1].sum(1) for owner, own in rows.items()}

    def acceleration(self, body: str) -> list[Array]:
        """Return ax, ay and alpha of a body, each (T,)."""
        return self._entries(self.dynamics.a, body)

    def load(self, owner: str, body: str) -> tuple[Array, Array, Array]:
        """Return force and torque of a constraint on a body; on the ground: minus those on the others."""
        loads = self.loads[owner]
        if body != GROUND:
            fx, fy, torque = self._entries(loads, body)
            return fx, fy, torque
        fx, fy, torque = (loads[..., k] for k in range(3))
        about_origin = torque + self.q[..., 0] * fy - self.q[..., 1] * fx
        return -fx.sum(1), -fy.sum(1), -about_origin.sum(1)

    def _entries(self, x: Array, body: str) -> list[Array]:
        place = None if body == GROUND else self.mechanism.body_names.index(body)
        return [jnp.zeros(len(x)) if place is None else x[:, place, k] for k in range(3)]


def _measure_body(channel: Channel, motion: _Motion) -> Array:
    (name,), (point,), quantity = channel.bodies, channel.points, channel.quantity
    frame = motion.frames[name]
    if quantity in ("angle", "omega"):
        return getattr(frame, quantity)
    if quantity == "alpha":
        return motion.acceleration(name)[2]
    axis = quantity[-1]
    if channel.needs == "accelerations":  # a + alpha x r - omega^2 r
        ax, ay, alpha = motion.acceleration(name)
        arm, square = frame.vector(point), frame.omega**2
        return ax - alpha * arm.y - square * arm.x if axis == "x" else ay + alpha * arm.x - square * arm.y
    return getattr(frame.velocity(point) if quantity[0] == "v" else frame.point(point), axis)


def _measure_joint(channel: Channel, motion: _Motion) -> Array:
    if channel.needs == "reactions":
        return motion.load(channel.owner, channel.bodies[0])[list(LOADS).index(channel.quantity)]
    if channel.quantity == "alpha":
        one, two = (motion.acceleration(body)[2] for body in channel.bodies)
    else:
        one, two = (getattr(motion.frames[body], channel.quantity) for body in channel.bodies)
    return two - one


def _measure_driver(channel: Channel, motion: _Motion) -> Array:
    """-lambda: the row of a driver is its coordinate minus what is prescribed."""
    return -motion.dynamics.multipliers[:, motion.dynamics.row_owners.index(channel.owner)]


def _measure_distance(channel: Channel, motion: _Motion) -> Array:
    return between(channel.points, *(motion.frames[body] for body in channel.bodies)).norm()


_MEASURES: dict[str, Callable[[Channel, _Motion], Array]] = {
    "body": _measure_body,
    "joint": _measure_joint,
    "driver": _measure_driver,
    "distance": _measure_distance,
}
