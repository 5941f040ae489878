"""Travel: the values between which a coordinate can be driven."""

from collections.abc import Mapping
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udkjax.annotations import NumberLike
from udkjax.argument_types import NUMBERS_BY_NAME
from udkjax.arrays import FULL_TURN
from udkjax.positions.assembling.assembly import State, assemble
from udkjax.positions.assembling.coordinates import element_of
from udkjax.positions.following.branch_positions import solve_on_branch, start_on_branch
from udkjax.positions.following.branches import SAME_POSITION_TOL
from udkjax.positions.following.carried_bodies import carried_bodies
from udkjax.positions.following.continuation import Points, Reached
from udkjax.positions.following.drive import Drive, Driven
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_numbers, units
from udkjax.programs.control_flow import ControlFlow, solve
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.transforms.gradients import stop_gradients

UNLIMITED_TRAVEL = 500.0  # in characteristic lengths: a coordinate that gets this far without a toggle has no limit


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
        driven, q = start_on_branch(mechanism, driver, 0.0, state, held)
        return solve(_travel, driven, q, FULL_TURN if driven.is_angle else UNLIMITED_TRAVEL * driven.unit)
    is_driver = isinstance(driver, str) and driver in mechanism.drivers
    coordinate = driver if is_driver else element_of(mechanism, driver)  # a pin may be on a carried body
    start = assemble(mechanism, 0.0, state, throw=False).q
    rest = start[carried.kept(len(start))]
    found = travel(carried.without(mechanism), coordinate, State(rest, jnp.zeros_like(rest)), held)
    lower_q, upper_q = (carried.carry(start, jax.lax.stop_gradient(q)) for q in (found.lower_q, found.upper_q))
    return eqx.tree_at(lambda x: (x.lower_q, x.upper_q), found, (lower_q, upper_q))


def _travel(driven: Driven, q: Float[Array, "n"], far: NumberLike, by: ControlFlow) -> Travel:
    xp, s = by.xp, driven.value(q)

    def towards(way: Any) -> Points:
        return solve_on_branch(driven, s, q, stop_gradients(xp.asarray(s + way * far)[None]), by, False)

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
    """Return True if the turn that ends at `points` leads back to q: then there is no limit in the other direction either."""
    if points.status[0] != Reached.closed:
        return False
    moved = (points.q[0] - q) / driven.analysis.scales.coordinates(len(q))
    moved[2::3] -= 2 * np.pi * np.round(moved[2::3] / (2 * np.pi))
    return bool(np.max(np.abs(moved)) <= SAME_POSITION_TOL)
