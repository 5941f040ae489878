"""Channels: what can be measured of a motion, each under a name in the dialect of the parameters' names.

    body.NAME.x  y  angle  vx  vy  omega  ax  ay  alpha       centre of mass and angle, their rates and accelerations
    body.NAME(px, py).x  y  vx  vy  ax  ay                    a point given in the body's own frame (m)
    joint.NAME.angle  omega  alpha                            theta_2 - theta_1 of the joint's two bodies: an encoder at the pin
    joint.NAME.fx  fy  torque                                 what the joint does to its second body, as in `reactions`
    joint.NAME.BODY.fx  fy  torque                            what it does to one that is named
    driver.NAME.load                                          what the driver exerts on its second body along its coordinate
    distance.BODY(px, py).BODY2(px, py)                       between two points; a body may be "ground"

Torques are about the centre of mass, those on the ground about the origin. SI units throughout.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.equations.motion import MechanismMotion
from udkjax.equations.textbook import prepare
from udkjax.pinv import SVD
from udkjax.scene.bodies import GROUND, Frame, between
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.naming import LOADS, Channel
from udkjax.study.identify.naming import channel_of as channel_of
from udkjax.study.identify.naming import channels_of as channels_of


@dataclass(frozen=True, eq=False)
class Quantity:
    """A channel of the user's own: function(mechanism, solution) -> (T,), in `units`, written in jax.numpy.

    Equal only to itself: made once and kept, it compiles once.
    """

    name: str
    function: Callable[[Mechanism, Any], Float[Array, "T"]]
    units: str = ""

    def __str__(self) -> str:
        return self.name


def measured(mechanism: Mechanism, solution: Any, channels: Sequence[Channel | Quantity]) -> Float[Array, "T C"]:
    """Return the values of channels at the output times of a solution, one channel a column; it may be traced and batched.

    `solution` is a `Solution`, or another pytree with ts (T,), q and v (T, bodies, 3). Where a state is not a number, after a
    run has failed, nor are the values; derivatives are zero there, and unharmed elsewhere. Accelerations and reactions are those
    of the constraints without stabilization,

        lambda = -(D^+)^T D^+ b,    M a = F - Psi_q^T lambda,

    of minimum norm where constraints are redundant, by singular values (`SVD`), whatever the method of the run: a batch would
    compute both sides of a branch. They are only computed where a channel needs them.
    """
    reached = jnp.all(jnp.isfinite(solution.q) & jnp.isfinite(solution.v), axis=(1, 2))
    there = reached[:, None, None]
    # The scene's guess stands in: any state at which all derivatives are numbers.
    q, v = (jnp.where(there, x, jax.lax.stop_gradient(x0)) for x, x0 in ((solution.q, mechanism.q0), (solution.v, mechanism.v0)))
    whole = eqx.tree_at(lambda s: (s.q, s.v), solution, (q, v))
    dynamic = any(isinstance(c, Channel) and c.needs != "states" for c in channels)
    state = State(mechanism, q, v, *(_dynamics(mechanism, solution.ts, q, v) if dynamic else (None,) * 4))
    columns = [c.function(mechanism, whole) if isinstance(c, Quantity) else _VALUES[c.section](c, state) for c in channels]
    return jnp.where(reached[:, None], jnp.stack(columns, -1), jnp.nan) if columns else jnp.zeros((len(q), 0))


class State(NamedTuple):
    """A motion at all output times. Psi_q, lambda, its rows' constraints and a are there if a channel needs them."""

    mechanism: Mechanism
    q: Float[Array, "T bodies 3"]
    v: Float[Array, "T bodies 3"]
    psi_q: Any  # (T, m, bodies, 3)
    multipliers: Any  # (T, m)
    owners: Any  # of each row
    a: Any  # (T, bodies, 3)

    def frame(self, body: str) -> Frame:
        """The frame of a body, each of its entries (T,)."""
        (x, y, angle), (vx, vy, omega) = self._of(self.q, body), self._of(self.v, body)
        return Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), vx, vy, omega)

    def acceleration(self, body: str) -> list[Array]:
        """ax, ay and alpha of a body, each (T,)."""
        return self._of(self.a, body)

    def load(self, owner: str, body: str) -> tuple[Array, Array, Array]:
        """Force and torque of a constraint on a body: -Psi_q^T lambda of its rows. On the ground: minus those on the others."""
        rows = [k for k, name in enumerate(self.owners) if name == owner]
        loads = -jnp.einsum("tm,tmbc->tbc", self.multipliers[:, jnp.array(rows)], self.psi_q[:, jnp.array(rows)])
        if body != GROUND:
            fx, fy, torque = self._of(loads, body)
            return fx, fy, torque
        fx, fy, torque = (loads[..., k] for k in range(3))
        about_origin = torque + self.q[..., 0] * fy - self.q[..., 1] * fx
        return -fx.sum(1), -fy.sum(1), -about_origin.sum(1)

    def _of(self, x: Array, body: str) -> list[Array]:
        place = None if body == GROUND else self.mechanism.body_names.index(body)
        return [jnp.zeros(len(x)) if place is None else x[:, place, k] for k in range(3)]


def _dynamics(mechanism: Mechanism, ts: Array, q: Array, v: Array) -> tuple[Array, Array, list[str], Array]:
    """Psi_q, lambda, the constraint of each row and a."""
    equations: MechanismMotion = prepare(mechanism, SVD())

    def at(t, q, v):
        _, F, psi_q, _ = equations.matrices(t, q.ravel(), v.ravel())
        multipliers = equations.multipliers(t, q.ravel(), v.ravel())
        return psi_q.reshape(-1, *q.shape), multipliers, (F - psi_q.T @ multipliers).reshape(q.shape) / mass

    mass = jnp.stack([jnp.stack([body.mass, body.mass, body.inertia]) for body in mechanism.bodies.values()])
    psi_q, multipliers, a = jax.vmap(at)(ts, q, v)
    return psi_q, multipliers, [name for name, _ in equations.row_names], a


def _of_body(channel: Channel, state: State) -> Array:
    (name,), (spot,), quantity = channel.bodies, channel.spots, channel.quantity
    frame = state.frame(name)
    if quantity in ("angle", "omega"):
        return getattr(frame, quantity)
    if quantity == "alpha":
        return state.acceleration(name)[2]
    axis = quantity[-1]
    if channel.needs == "accelerations":  # a + alpha x r - omega^2 r
        ax, ay, alpha = state.acceleration(name)
        arm, square = frame.vector(spot), frame.omega**2
        return ax - alpha * arm.y - square * arm.x if axis == "x" else ay + alpha * arm.x - square * arm.y
    return getattr(frame.velocity(spot) if quantity[0] == "v" else frame.point(spot), axis)


def _of_joint(channel: Channel, state: State) -> Array:
    if channel.needs == "reactions":
        return state.load(channel.owner, channel.bodies[0])[list(LOADS).index(channel.quantity)]
    if channel.quantity == "alpha":
        one, two = (state.acceleration(body)[2] for body in channel.bodies)
    else:
        one, two = (getattr(state.frame(body), channel.quantity) for body in channel.bodies)
    return two - one


def _of_driver(channel: Channel, state: State) -> Array:
    """-lambda: the row of a driver is its coordinate minus what is prescribed."""
    return -state.multipliers[:, state.owners.index(channel.owner)]


def _of_distance(channel: Channel, state: State) -> Array:
    return between(channel.spots, *map(state.frame, channel.bodies)).norm()


_VALUES: dict[str, Callable[[Channel, State], Array]] = {
    "body": _of_body,
    "joint": _of_joint,
    "driver": _of_driver,
    "distance": _of_distance,
}
