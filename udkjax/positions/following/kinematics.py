"""Kinematics: positions, velocities and accelerations of a mechanism over the values of a driver."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from udkjax.annotations import NumberLike, Numbers
from udkjax.argument_types import FINITE, NUMBERS_BY_NAME
from udkjax.arrays import FULL_TURN, is_traced, library_for, make_module, number, stored, without_derivatives
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.positions.assembling.assembly import State, assemble, close
from udkjax.positions.assembling.coordinates import element_of
from udkjax.positions.following.branches import SAME_POSITION
from udkjax.positions.following.carried_bodies import carried_bodies
from udkjax.positions.following.continuation import Points, Reached, follow, no_points
from udkjax.positions.following.curve import AbstractCurve, Curve, NumpyCurve
from udkjax.positions.following.drive import Drive, Driven, drive
from udkjax.positions.following.march import MarchResult, can_march, march, march_at_once
from udkjax.positions.following.position_derivatives import with_derivative, with_derivatives
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_numbers, units
from udkjax.programs.control_flow import BY_JAX, ControlFlow, solve
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import Frame, frame_over_time
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.description import format_pose, size_of
from udkjax.scene.tables.checks import SceneError
from udkjax.transforms.gradients import stop_gradients

UNLIMITED_TRAVEL = 500.0  # in characteristic lengths: a coordinate that gets this far without a toggle has no limit


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
        """Return the motion with its values, which are concrete, in rising order, each once."""
        order = np.unique(np.asarray(without_derivatives(self.values)), return_index=True)[1]
        if np.array_equal(order, np.arange(len(self.values))):
            return self
        states = "values", "q", "v", "a", "rate", "acceleration", "status"
        return make_module(Kinematics, **vars(self) | {name: getattr(self, name)[order] for name in states})

    def frame(self, body: str) -> Frame:
        """Return the frame of a body, each of its numbers (T,)."""
        return frame_over_time(self.bodies, self.q, self.v, body)

    def path(self, body: str, point: Numbers = (0.0, 0.0)) -> Float[Array, "T 2"]:
        """Return the path (m) of a point given in the body's own frame (m): a coupler curve. `udkjax.path` accepts pins, too."""
        return jnp.stack(self.frame(body).point(number(point)), -1)


class Travel(PrintsTable):
    """The values (rad, m) between which a coordinate can be driven.

    Attributes:
        lower: the lower end (rad, m); -inf without a toggle.
        upper: the upper end (rad, m); inf without a toggle.
        lower_q: the position at the lower toggle; infinite without one.
        upper_q: the position at the upper toggle; infinite without one.
        unit: unit of the coordinate.
    """

    lower: Float[Array, ""]
    upper: Float[Array, ""]
    lower_q: Float[Array, "bodies 3"]
    upper_q: Float[Array, "bodies 3"]
    status: Int[Array, "2"]  # a `Reached` for each end: `beyond_limit` if a toggle was found
    unit: str = eqx.field(static=True, default="")

    _units = units(lower_q="m, m, rad", upper_q="m, m, rad")

    def _table(self) -> PrintedTable:
        if np.ndim(self.lower):
            given = {"lower": self.unit, "upper": self.unit, **self._units}
            return fields_table(self, given, f"travel of {np.size(self.lower)} members")
        rows = []
        for name, value, code in zip(("lower", "upper"), (self.lower, self.upper), np.asarray(self.status), strict=True):
            at = format_numbers(value, self.unit)
            rows.append(
                (
                    name,
                    f"{at}, a toggle"
                    if np.isfinite(value)
                    else "no limit"
                    if code == Reached.closed
                    else f"{Reached(int(code))}",
                )
            )
        return PrintedTable("travel", rows)


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
    driven, q = _start(mechanism, driver, first, state, held)
    return solve(_kinematics, driven, q, values, rate, acceleration, mechanism.body_names, put=put)


@checked
def travel(
    mechanism: Mechanism,
    driver: Drive,
    state: State | None = None,
    held: Annotated[Mapping[str, NumberLike], NUMBERS_BY_NAME] | None = None,
) -> Travel:
    """Return the values between which a coordinate can be driven: the toggles on either side, where ds/dsigma = 0.

    An angle that makes a whole turn has no limits. Bodies attached to a single other one, such as a free wheel or a pendulum,
    limit nothing: they keep their pose relative to it. `lower` and `upper` have exact derivatives with respect to every number
    of the mechanism.

    Args:
        mechanism: a mechanism of one degree of freedom once its drivers hold.
        driver: a driver of the scene, or a coordinate by name or as a `Coordinate`, as for `kinematics`.
        state: a position on the branch; by default the initial guess, assembled.
        held: values that other drivers or coordinates hold, by name.

    Returns:
        A `Travel`: `lower` and `upper` (rad, m), infinite without a limit, and the positions at the toggles.

    Raises:
        SceneError: no such driver or coordinate, or positions do not follow from it.
    """
    if driver is None:
        raise SceneError(["driver is None: name one of the drivers, or the coordinate whose travel is computed"], mechanism.name)
    carried = carried_bodies(mechanism, driver, held)
    if not carried.carrier:
        driven, q = _start(mechanism, driver, 0.0, state, held)
        return solve(_travel, driven, q, FULL_TURN if driven.is_angle else UNLIMITED_TRAVEL * driven.unit)
    is_driver = isinstance(driver, str) and driver in mechanism.drivers
    coordinate = driver if is_driver else element_of(mechanism, driver)  # a pin may be on a carried body
    start = assemble(mechanism, 0.0, state, throw=False).q
    rest = start[carried.kept(len(start))]
    found = travel(carried.without(mechanism), coordinate, State(rest, jnp.zeros_like(rest)), held)
    lower_q, upper_q = (carried.carry(start, jax.lax.stop_gradient(q)) for q in (found.lower_q, found.upper_q))
    return eqx.tree_at(lambda x: (x.lower_q, x.upper_q), found, (lower_q, upper_q))


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
    points = _solve(driven, driven.value(q) if driven.name else values[0], q, values, by)
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


def _travel(driven: Driven, q: Float[Array, "n"], far: NumberLike, by: ControlFlow) -> Travel:
    xp, s = by.xp, driven.value(q)

    def towards(way: Any) -> Points:
        return _solve(driven, s, q, stop_gradients(xp.asarray(s + way * far)[None]), by, False)

    if xp is np:
        down = towards(np.asarray(-1.0))
        up = down if driven.is_angle and _returns(driven, q, down) else towards(np.asarray(1.0))
    else:
        down_up = by.vmap(towards)(xp.array([-1.0, 1.0]))
        down, up = (jax.tree.map(lambda x, k=k: x[k], down_up) for k in (0, 1))
    lower, upper = (xp.where(p.status[0] == Reached.beyond_limit, p.limit, way * np.inf) for p, way in ((down, -1), (up, 1)))
    lower_q, upper_q = (p.limit_q.reshape(-1, 3) for p in (down, up))
    return Travel(lower, upper, lower_q, upper_q, xp.stack([down.status[0], up.status[0]]), driven.value_unit)


def _returns(driven: Driven, q: Any, points: Points) -> bool:
    """Return True if a whole turn leads back to the position q, so that the motion has no limit in the other direction either."""
    if points.status[0] != Reached.closed:
        return False
    moved = (points.q[0] - q) / driven.analysis.scales.coordinates(len(q))
    moved[2::3] -= 2 * np.pi * np.round(moved[2::3] / (2 * np.pi))
    return bool(np.max(np.abs(moved)) <= SAME_POSITION)


def _start(
    mechanism: Mechanism, driver: Drive, start: NumberLike, state: State | None, held: Mapping[str, NumberLike] | None
) -> tuple[Driven, Float[Array, "n"]]:
    """Return the driven mechanism and its closed first position; if time is the driver, at time `start`."""
    driven = drive(mechanism, driver, 0.0, held)
    if driver is None:
        return driven, _assemble(driven.mechanism, start, state, driven.analysis)
    q = _assemble(mechanism, 0.0, state, analyse(mechanism))
    if held:
        at_rest = State(q.reshape(-1, 3), jnp.zeros((len(q) // 3, 3)))
        q = _assemble(driven.mechanism, driven.value(q), at_rest, driven.analysis)
    return driven, q


def _assemble(mechanism: Mechanism, t: NumberLike, state: State | None, analysis: Analysis) -> Float[Array, "n"]:
    q = close(mechanism, t, state, analysis=analysis).state.q
    return library_for(q).ravel(q)


def _solve(
    driven: Driven, s: Float[Array, ""], q: Float[Array, "n"], values: Float[Array, "T"], by: ControlFlow, fast: bool = True
) -> Points:
    """Solve by machine code (if `fast`) as long as its steps are reliable, then by continuation."""
    xp, is_traced = by.xp, by is BY_JAX
    curve = (Curve if is_traced else NumpyCurve).of(driven)
    points, first = no_points(len(values), len(q), xp), xp.asarray(0)
    given = driven.mechanism, driven.analysis, driven.unit, s, q, values
    if fast and can_march(driven.mechanism, driven.analysis):
        found = march(*stop_gradients(given)) if is_traced else march_at_once(*given)
        first = _count_on_branch(curve, s, q, values, found)
        if is_traced or first < len(values):
            s, q = _place_to_go_on(s, q, values, found, first, xp)
        points = points._replace(q=found.q, dq=found.dq, ddq=found.ddq, status=xp.zeros_like(points.status))
    if not is_traced:
        points = follow(curve, s, q, values, points, first)
        has_position = Reached.has_position(points.status)
        if has_position.all():
            return points
        known = {name: np.where(has_position[:, None], getattr(points, name), np.nan) for name in ("q", "dq", "ddq")}
        return points._replace(**known)
    assert isinstance(curve, Curve)
    points = follow(*stop_gradients((curve, s, q, values)), points, first)
    return _with_derivatives(curve, q, values, points)


def _count_on_branch(
    curve: AbstractCurve, s: Float[Array, ""], q: Float[Array, "n"], values: Float[Array, "T"], march_result: MarchResult
) -> Int[Array, ""] | int:
    """Return the number of trusted positions that are on the first branch.

    The side changes where the branch meets another, and where machine code jumps to a neighbouring branch. Continuation with
    shorter steps distinguishes the two: for concrete numbers from the previous value, for traced ones from this value on.
    """
    if isinstance(curve, Curve):
        is_same_side = march_result.side == march_result.first_side
        return jnp.sum(jnp.cumprod(is_same_side & (np.arange(len(values)) < march_result.trusted)))
    trusted = int(march_result.trusted)
    if (march_result.side[:trusted] == march_result.first_side).all():
        return trusted
    previous_sides = np.append(march_result.first_side, march_result.side[:-1])
    for k in np.flatnonzero(march_result.side[:trusted] != previous_sides[:trusted]).tolist():
        s, q = (values[k - 1], march_result.q[k - 1]) if k else (s, q)
        reached = follow(curve, s, q, values[k : k + 1], no_points(1, len(q), np), 0)
        distance = np.abs(reached.q[0] - march_result.q[k]) / curve.units[:-1]
        if not (Reached.has_position(reached.status[0]) and np.max(distance) <= SAME_POSITION):
            return k
    return trusted


def _place_to_go_on(
    s: Float[Array, ""],
    q: Float[Array, "n"],
    values: Float[Array, "T"],
    march_result: MarchResult,
    first: Int[Array, ""] | int,
    xp: Any,
) -> tuple[Any, Any]:
    """Return the value and the position from which continuation finds the position at values[first]."""
    last, following = xp.maximum(first - 1, 0), xp.minimum(first, len(values) - 1)
    some, m = first > 0, march_result
    side = xp.where(some, m.side[last], m.first_side)
    # Machine code may have come nearer, on the same branch.
    is_nearer = (first == m.trusted) & (first < len(values)) & (m.side[following] == side)
    s, q = xp.where(some, values[last], s), xp.where(some, m.q[last], q)
    return xp.where(is_nearer, m.reached, s), xp.where(is_nearer, m.q[-1], q)


def _with_derivatives(curve: Curve, q: Float[Array, "n"], values: Float[Array, "T"], points: Points) -> Points:
    has_position = Reached.has_position(points.status)
    safe = jnp.where(has_position[:, None], points.q, jax.lax.stop_gradient(q))
    regular = ~has_position | (points.status == Reached.closed)
    derivatives = with_derivatives(curve, values, points._replace(q=safe), regular)
    q, dq, ddq = (jnp.where(has_position[:, None], x, jnp.nan) for x in derivatives)
    limited = jnp.isfinite(points.limit)
    X = jnp.where(limited, jnp.append(points.limit_q, points.limit), jax.lax.stop_gradient(jnp.append(safe[0], values[0])))
    limit = jnp.where(limited, with_derivative(curve, X), jnp.inf)
    return points._replace(q=q, dq=dq, ddq=ddq, limit=limit)
