"""Values of channels along a motion, and paths of points: positions, rates, accelerations, reactions, user-defined functions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.annotations import Numbers
from udkjax.argument_types import HISTORY
from udkjax.equations.states.quantities import equations_of
from udkjax.equations.states.scene_changes import scene_along
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.pinv import SVD
from udkjax.positions.assembling.channels import (
    LOADS,
    Channel,
    Quantity,
    StateHistory,
    locate,
    point_of_pin,
)
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import defined
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND, Frame, Point, between
from udkjax.scene.mechanism import Mechanism


def measure(
    mechanism: Mechanism | ConstrainedSystem, solution: StateHistory, channels: Sequence[Channel | Quantity]
) -> Float[Array, "T C"]:
    """Return the values of channels at the output times of a solution, which may be traced and batched.

    Accelerations and reactions are those of the constraints without stabilization,

        lambda = -(D^+)^T D^+ b,    M a = F - Psi_q^T lambda,

    of minimum norm where constraints are redundant. They are computed only if a channel needs them, and by `SVD`, independently
    of the run's method, because a batch would execute both sides of a branch.

    Args:
        mechanism: the mechanism, or the system, that moved.
        solution: a `Solution`, or another pytree with ts (T,), q and v (T, bodies, 3).
        channels: channels to measure.

    Returns:
        Values (T, C) in SI units, one column per channel; NaN where the state is NaN, after a run has failed. At a toggle,
        positions, angles and distances are finite, and velocities are NaN. Derivatives of NaN values are zero.
    """
    needs_dynamics = any(isinstance(c, Channel) and c.needs != "states" for c in channels)
    motion, placed, reached = _fill(mechanism, solution, scene_along(mechanism, solution) if needs_dynamics else None)
    filled = eqx.tree_at(lambda s: (s.q, s.v), solution, (motion.q, motion.v))
    columns = [c.function(mechanism, filled) if isinstance(c, Quantity) else _MEASURES[c.section](c, motion) for c in channels]
    if not columns:
        return jnp.zeros((len(motion.q), 0))
    valid = [placed if isinstance(c, Channel) and c.quantity in POSITION_QUANTITIES else reached for c in channels]
    return jnp.where(jnp.stack(valid, -1), jnp.stack(columns, -1), jnp.nan)


@checked
def path(
    mechanism: Mechanism,
    solution: Annotated[StateHistory, HISTORY],
    of: str,
    point: Numbers | None = None,
    derivative: Literal[0, 1, 2] = 0,
) -> Float[Array, "T 2"]:
    """Return the path of a point of a body, or of a pin, over a motion; or the point's velocities or accelerations.

    The function is pure, jittable, batched by `vmap`, and differentiable with respect to every number of the mechanism, the
    point and the motion.

    Args:
        mechanism: the mechanism that moved.
        solution: a `Solution`, a `Kinematics`, or another motion with ts (T,), q and v (T, bodies, 3).
        of: a body; or a pin, by the name of its joint or in the drawing. A joint with two points denotes that of its second body.
        point: a point in the body's frame (m); by default its centre of mass.
        derivative: 0 for positions (m), 1 for velocities (m/s), 2 for accelerations (m/s^2). These are read from the
            motion if it has them, as a `Kinematics` does; else they follow from the equations of motion, a = a_F + M^(-1/2) D^+
            b.

    Returns:
        x and y (T, 2) in ground axes; NaN where the motion is NaN. At a toggle, only positions are finite.

    Raises:
        ValueError: the body or pin is unknown.
    """
    body, local = locate(mechanism, of, point)
    accelerations = getattr(solution, "a", None)
    scene = scene_along(mechanism, solution) if derivative == 2 and accelerations is None else None
    motion = jnp.asarray(solution.ts), jnp.asarray(solution.q), jnp.asarray(solution.v)
    given = accelerations if derivative == 2 else None, scene
    return _path(mechanism.without_origin, *motion, *given, local, body, derivative)


@deferred
@defined
def _path(mechanism, ts, q, v, a, scene, local, body, derivative):
    motion, placed, reached = _fill(mechanism, SimpleNamespace(ts=ts, q=q, v=v, a=a), scene)
    return jnp.where((reached if derivative else placed)[:, None], jnp.stack(motion.point(body, local, derivative), -1), jnp.nan)


def _fill(
    mechanism: Any, solution: StateHistory | SimpleNamespace, scene: Any
) -> tuple["_Motion", Bool[Array, "T"], Bool[Array, "T"]]:
    """Return a motion whose NaN states are replaced, to keep all derivatives finite, and two masks.

    The scene's guess replaces NaN states; in a model without bodies the first state does, or ones. The first mask is True at
    times at which positions are finite, the second at times at which velocities are finite as well.
    """
    axes = tuple(range(1, jnp.ndim(solution.q)))
    placed = jnp.all(jnp.isfinite(solution.q), axis=axes)
    reached = placed & jnp.all(jnp.isfinite(solution.v), axis=axes)
    guess = (mechanism.q0, mechanism.v0)
    if not mechanism.has_bodies:
        guess = (jnp.where(jnp.isfinite(x[0]), x[0], 1.0) for x in (solution.q, solution.v))
    filled = zip((placed, reached), (solution.q, solution.v), guess, strict=True)
    q, v = (jnp.where(jnp.expand_dims(valid, axes), x, jax.lax.stop_gradient(x0)) for valid, x, x0 in filled)
    a = getattr(solution, "a", None)
    a = None if a is None else jnp.where(reached[:, None, None], a, 0.0)
    return _Motion(mechanism, solution.ts if scene is None else scene.ts, q, v, a, scene), placed, reached


POSITION_QUANTITIES = ("x", "y", "angle", "distance")  # quantities that do not depend on velocities
DERIVATIVE_ORDER = {"": 0, "v": 1, "a": 2}  # order of the derivative of a position, by the letter before x or y


class _Dynamics(NamedTuple):
    """Psi_q, lambda, the constraint of each of its m rows, and the accelerations, at all output times."""

    psi_q: Float[Array, "T m bodies 3"]
    multipliers: Float[Array, "T m"]
    row_owners: list[str]
    a: Float[Array, "T bodies 3"]


@dataclass(frozen=True, eq=False)
class _Motion:
    """States at all output times, and quantities derived from them."""

    mechanism: Mechanism
    ts: Float[Array, "T"]
    q: Float[Array, "T bodies 3"]
    v: Float[Array, "T bodies 3"]
    a: Float[Array, "T bodies 3"] | None  # accelerations of the motion, if it has them
    scene: Any  # `SceneAlong`: the constraints along the motion; None if accelerations are not needed

    @cached_property
    def dynamics(self) -> _Dynamics:
        """Psi_q, the multipliers and the accelerations at all output times, computed only if a channel needs them."""
        assert self.scene is not None  # a channel that needs it asks for it
        mechanism, analysis, knowledge = self.scene[:3]
        equations: Any = equations_of(mechanism, SVD(), analysis=analysis)

        def at(t, q, v, known):
            here = equations.known(known)
            a, multipliers = here.motion(t, q.ravel(), v.ravel())
            return here.jacobian(t, q.ravel()).reshape(-1, *q.shape), multipliers, a.reshape(q.shape)

        psi_q, multipliers, a = jax.vmap(at)(self.ts, self.q, self.v, knowledge.states(mechanism))
        return _Dynamics(psi_q, multipliers, [name for name, _ in equations.row_names], a)

    @cached_property
    def frames(self) -> dict[str, Frame]:
        """The frames of bodies and of the ground; their entries have the shape (T,)."""
        frames = {}
        for body in (*self.mechanism.body_names, GROUND):
            (x, y, angle), (vx, vy, omega) = self._entries(self.q, body), self._entries(self.v, body)
            frames[body] = Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), vx, vy, omega)
        return frames

    @cached_property
    def loads(self) -> dict[str, Float[Array, "T bodies 3"]]:
        """Forces and torques of each constraint on all bodies: -Psi_q^T lambda of the constraint's rows."""
        psi_q, multipliers, owners, _ = self.dynamics
        by_row = -multipliers[..., None, None] * psi_q
        rows_by_owner = {owner: [k for k, name in enumerate(owners) if name == owner] for owner in owners}
        found = {owner: by_row[:, indices[0] : indices[-1] + 1].sum(1) for owner, indices in rows_by_owner.items()}
        names = self.scene.names  # it is known, as for `dynamics`
        return (
            found if names is None else {name: sum((found[x] for x in joined), jnp.zeros(())) for name, joined in names.items()}
        )

    def acceleration(self, body: str) -> list[Array]:
        """Return ax, ay and alpha of a body, each (T,)."""
        return self._entries(self.q if body == GROUND else self.dynamics.a if self.a is None else self.a, body)

    def point(self, body: str, local: Float[Array, "2"] | tuple[float, float], derivative: int) -> Point:
        """Return the position, velocity or acceleration of a point of a body, x and y each (T,)."""
        frame = self.frames[body]
        if derivative == 0:
            return frame.point(local)
        if derivative == 1:
            return frame.velocity(local)
        ax, ay, alpha = self.acceleration(body)  # a + alpha x r - omega^2 r
        arm, square = frame.vector(local), frame.omega**2
        return Point(ax - alpha * arm.y - square * arm.x, ay + alpha * arm.x - square * arm.y)

    def load(self, owner: str, body: str) -> tuple[Array, Array, Array]:
        """Return force x, force y (N) and torque (N m) of a constraint on a body, each (T,).

        Torques are about the centre of mass. The load on the ground is minus the sum over the bodies, with the torque about the
        origin.
        """
        loads = self.loads[owner]
        if body != GROUND:
            fx, fy, torque = self._entries(loads, body)
            return fx, fy, torque
        fx, fy, torque = (loads[..., k] for k in range(3))
        about_origin = torque + self.q[..., 0] * fy - self.q[..., 1] * fx
        return -fx.sum(1), -fy.sum(1), -about_origin.sum(1)

    def _entries(self, x: Array, body: str) -> list[Array]:
        index = None if body == GROUND else self.mechanism.body_names.index(body)
        return [jnp.zeros(len(x)) if index is None else x[:, index, k] for k in range(3)]


def _measure_body(channel: Channel, motion: _Motion) -> Array:
    (name,), (point,), quantity = channel.bodies, channel.points, channel.quantity
    frame = motion.frames[name]
    if quantity in ("angle", "omega"):
        return getattr(frame, quantity)
    if quantity == "alpha":
        return motion.acceleration(name)[2]
    return _component(motion, name, point, quantity)


def _component(motion: _Motion, body: str, point: Float[Array, "2"] | tuple[float, float], quantity: str) -> Array:
    """Return x or y of the position, velocity or acceleration of a point of a body; `quantity` is x, y, vx, vy, ax or ay."""
    values = motion.point(body, point, DERIVATIVE_ORDER[quantity[:-1]])
    return jnp.broadcast_to(getattr(values, quantity[-1]), motion.ts.shape)


def _measure_pin(channel: Channel, motion: _Motion) -> Array:
    return _component(motion, *point_of_pin(motion.mechanism, channel.owner), channel.quantity)


def _measure_joint(channel: Channel, motion: _Motion) -> Array:
    if channel.needs == "reactions":
        return motion.load(channel.owner, channel.bodies[0])[list(LOADS).index(channel.quantity)]
    if channel.is_of_point:
        return _measure_pin(channel, motion)
    if channel.quantity == "alpha":
        first, second = (motion.acceleration(body)[2] for body in channel.bodies)
    else:
        first, second = (getattr(motion.frames[body], channel.quantity) for body in channel.bodies)
    return second - first


def _measure_driver(channel: Channel, motion: _Motion) -> Array:
    """Return -lambda: the row of a driver is its coordinate minus the prescribed value."""
    return -motion.dynamics.multipliers[:, motion.dynamics.row_owners.index(channel.owner)]


def _measure_state(channel: Channel, motion: _Motion) -> Array:
    return getattr(motion, channel.owner)[:, int(channel.quantity)]


def _measure_distance(channel: Channel, motion: _Motion) -> Array:
    return between(channel.points, *(motion.frames[body] for body in channel.bodies)).norm()


_MEASURES: dict[str, Callable[[Channel, _Motion], Array]] = {
    "body": _measure_body,
    "joint": _measure_joint,
    "pin": _measure_pin,
    "driver": _measure_driver,
    "distance": _measure_distance,
    "state": _measure_state,
}
