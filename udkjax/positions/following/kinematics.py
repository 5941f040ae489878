"""Kinematics: positions, velocities and accelerations of a mechanism over the values of a driver."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from udkjax.annotations import NumberLike, Numbers
from udkjax.argument_types import FINITE, NUMBERS_BY_NAME
from udkjax.arrays import is_traced, library_for, make_module, number, stored, without_derivatives
from udkjax.positions.assembling.assembly import State
from udkjax.positions.following.branch_positions import solve_on_branch, start_on_branch
from udkjax.positions.following.continuation import Reached
from udkjax.positions.following.drive import Drive, Driven
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_numbers, units
from udkjax.programs.control_flow import ControlFlow, solve
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import Frame, frame_over_time
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.description import format_pose, size_of


class Kinematics(PrintsTable):
    """Positions, velocities and accelerations over the values of a driver; NaN at values that are not reached.

    Where the driver does not determine velocities (status `not_determined`), they are NaN. `limit_q` has no derivative.

    Attributes:
        q: x, y (m) and angle (rad) of each body.
        v: their rates (m/s, rad/s).
        a: the rates of these (m/s^2, rad/s^2).
        status: the number of a `Reached` for each value.
        limit: the value at the toggle that ended the motion; infinite without one.
        limit_q: the position at that toggle; infinite without one.
        bodies: the names of the bodies, in the order of q.
        values_of: the name of the driver that has these values, "value" for a coordinate without one; None: they are times.
    """

    values: Float[Array, "T"]  # values of the driver (rad, m), or times (s)
    q: Float[Array, "T bodies 3"]
    v: Float[Array, "T bodies 3"]
    a: Float[Array, "T bodies 3"]
    rate: Float[Array, "T"]  # s_dot of the driver
    acceleration: Float[Array, "T"]  # s_ddot
    status: Int[Array, "T"]
    limit: Float[Array, ""]
    limit_q: Float[Array, "bodies 3"]
    bodies: tuple[str, ...] = eqx.field(static=True)
    unit: str = eqx.field(static=True, default="")  # unit of the values
    values_of: str | None = eqx.field(static=True, default=None)  # None: they are times

    _units = units(q="m, m, rad", v="m/s, m/s, rad/s", a="m/s², m/s², rad/s²", limit_q="m, m, rad")

    def _table(self) -> PrintedTable:
        status, counts = np.unique(np.asarray(self.status), return_counts=True)
        became = ", ".join(f"{n} {Reached(int(code))}" for code, n in zip(status, counts, strict=True))
        if np.ndim(self.status) > 1:
            return fields_table(self, self._units, f"kinematics of {len(self.status)} members: {became}")
        rows = [("values", format_numbers(self.values, self.unit)), ("became", became)]
        if np.isfinite(np.asarray(self.limit)):
            rows.append(("toggle at", format_numbers(self.limit, self.unit)))
        q, good = np.asarray(self.q), np.flatnonzero(np.asarray(self.reached))
        if good.size:
            size, ends = size_of(q), zip(q[good[0]], q[good[-1]], strict=True)
            poses = [f"from {format_pose(first, size)} to {format_pose(last, size)}" for first, last in ends]
            rows += zip(self.bodies, poses, strict=True)
        return PrintedTable("kinematics", rows)

    @property
    def reached(self) -> Bool[Array, "T"]:
        """True for each value that was reached."""
        return stored(Reached.has_position(library_for(self.status).asarray(self.status)))

    @property
    def ts(self) -> Float[Array, "T"]:
        """The values, as times: a kinematic motion over times can replace a `Solution`."""
        return self.values

    @property
    def slopes(self) -> Float[Array, "T bodies 3"]:
        """The derivatives of q by the values (m, m, rad per unit of the values); NaN where `rate` is zero."""
        return stored(self.v / self.rate[..., None, None])

    def in_order(self) -> "Kinematics":
        """Return the motion with its values, which are concrete, in increasing order, without duplicates."""
        order = np.unique(np.asarray(without_derivatives(self.values)), return_index=True)[1]
        if np.array_equal(order, np.arange(len(self.values))):
            return self
        states = "values", "q", "v", "a", "rate", "acceleration", "status"
        return make_module(Kinematics, **vars(self) | {name: getattr(self, name)[order] for name in states})

    def frame(self, body: str) -> Frame:
        """Return the frame of a body over the motion; each of its entries has the shape (T,)."""
        return frame_over_time(self.bodies, self.q, self.v, body)

    def path(self, body: str, point: Numbers = (0.0, 0.0)) -> Float[Array, "T 2"]:
        """Return the path (m) of a point given in the body's own frame (m): a coupler curve. `udkjax.path` accepts pins, too."""
        return jnp.stack(self.frame(body).point(number(point)), -1)


@checked
def kinematics(
    mechanism: Mechanism,
    driver: Drive,
    values: Annotated[Float[ArrayLike, "T"] | Sequence[float], FINITE],
    state: State | None = None,
    rate: Annotated[Float[ArrayLike, "*T"], FINITE] = 1.0,
    acceleration: Annotated[Float[ArrayLike, "*T"], FINITE] = 0.0,
    held: Annotated[Mapping[str, NumberLike], NUMBERS_BY_NAME] | None = None,
) -> Kinematics:
    """Return the positions Psi(s, q) = 0 of a mechanism over the values s of a driver, one after another on one branch.

    With Psi_q q' = -Psi_s and Psi_q q'' = gamma, velocities are q' s_dot and accelerations q'' s_dot^2 + q' s_ddot.

    The branch is that of `state`, or of the initial guess, and is followed from there by its arc length. Where it cannot be
    followed, the motion ends, with a `status` that says why. Branches closer than some 0.003 rad of transmission angle are
    treated as meeting. Toggles, where the driver can go no farther, are located to machine precision. Constraints may be
    redundant.

    Pure, jittable and batched by `vmap`; q, v, a and `limit` have exact derivatives of any order with respect to every number
    of the mechanism and the values. Where branches meet (`Reached.singular`) they have first derivatives, which are NaN for
    numbers that separate the branches, such as the length of one of two equal cranks. Where velocities are `not_determined`,
    derivatives with respect to numbers that move the position are NaN.

    Args:
        mechanism: a mechanism of one degree of freedom once its drivers hold.
        driver: a driver of the scene, a coordinate by its name (`body.crank.angle`, `joint.B.angle`, `body.slider.x`), or a
            `Coordinate`; None: all drivers, along the times `values`.
        values: values of the driver (rad, m), or times (s), in the order in which they are reached.
        state: a position on the branch; by default the initial guess, assembled.
        rate: s_dot, for all values or each (rad/s, m/s; 1 for times).
        acceleration: s_ddot (rad/s^2, m/s^2).
        held: values that other drivers or coordinates hold, by name; by default drivers keep their values of time 0.

    Returns:
        A `Kinematics`: q, v, a (T, bodies, 3) and a status for each value.

    Raises:
        SceneError: no such driver or coordinate, or positions do not follow from it.
        ValueError: `values`, `rate` or `acceleration` has the wrong shape.
    """
    return _over_values(mechanism, driver, number(values), state, rate, acceleration, held, put=True)


def motion_in_time(mechanism: Mechanism, ts: Float[ArrayLike, "T"]) -> Kinematics:
    """Return the `kinematics` of all drivers at the times ts (s), with NumPy arrays if all numbers are concrete."""
    return _over_values(mechanism, None, ts, None, 1.0, 0.0, None, put=False)


def _over_values(
    mechanism: Mechanism,
    driver: Drive,
    values: Any,
    state: State | None,
    rate: Any,
    acceleration: Any,
    held: Mapping[str, NumberLike] | None,
    put: bool,
) -> Kinematics:
    rate, acceleration = (number(x) if is_traced(x) else np.asarray(x, float) for x in (rate, acceleration))
    if values.ndim != 1 or not len(values):
        raise ValueError(f"values must be a list of at least one number, not of the shape {values.shape}; batch it by jax.vmap")
    for name, given in (("rate", rate), ("acceleration", acceleration)):
        if given.shape not in ((), values.shape):
            raise ValueError(
                f"{name} must be one number, or one for each of the {len(values)} values; its shape is {given.shape}"
            )
    first = values[0] if isinstance(values, Tracer) else np.asarray(values)[0]
    driven, q = start_on_branch(mechanism, driver, first, state, held)
    return solve(_kinematics, driven, q, values, rate, acceleration, mechanism.body_names, put=put)


def _kinematics(
    driven: Driven,
    q: Float[Array, "n"],
    values: Float[Array, "T"],
    rate: Float[Array, "*T"],
    acceleration: Float[Array, "*T"],
    bodies: tuple[str, ...],
    by: ControlFlow,
) -> Kinematics:
    xp = by.xp
    points = solve_on_branch(driven, driven.value(q) if driven.name else values[0], q, values, by)
    s_dot, s_ddot = (x[:, None] if x.ndim else x for x in (rate, acceleration))
    v = points.dq * s_dot
    a = points.ddq * s_dot**2 + points.dq * s_ddot
    q, v, a = (xp.reshape(x, (len(values), -1, 3)) for x in (points.q, v, a))
    limit_q, unit = points.limit_q.reshape(-1, 3), driven.value_unit
    return make_module(
        Kinematics,
        values=values,
        q=q,
        v=v,
        a=a,
        rate=xp.broadcast_to(rate, values.shape),
        acceleration=xp.broadcast_to(acceleration, values.shape),
        status=points.status,
        limit=points.limit,
        limit_q=limit_q,
        bodies=bodies,
        unit=unit,
        values_of=driven.name or None,
    )
