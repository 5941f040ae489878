"""Efforts that hold a mechanism at rest with friction: all efforts between two bounds.

At rest the friction of a joint has any value up to its limit: the constant torque, plus the static coefficient times the load.
The bounds are matters of statics (admissible_reactions.py): masses enter by their weights only. Where a bound is infinite,
friction locks the mechanism, or redundant joints can be preloaded without limit.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from udkjax.annotations import NumberLike
from udkjax.argument_types import FINITE, NUMBERS_BY_NAME
from udkjax.equations.rows.analysis import Analysis
from udkjax.positions.assembling.assembly import State
from udkjax.positions.assembling.coordinates import Coordinate
from udkjax.positions.following.drive import drive
from udkjax.positions.following.kinematics import kinematics
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_numbers, units
from udkjax.programs.deferred import deferred
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.statics.admissible_reactions import UNBALANCED_TOL, largest_effort, reactions_at
from udkjax.wording import join_names

# Missing part of the unit speed along the coordinate. Where the coordinate moves, rounding errors are below 1e-8; at dead points
# other rows take a good share of the speed.
STOPPED_TOL = 1e-5


class HoldingEfforts(PrintsTable):
    """Bounds of the effort along a coordinate between which friction holds a mechanism at rest, for each value of the coordinate.

    All are NaN where the position is not reached, and at dead points of the coordinate.

    Attributes:
        values: values of the coordinate (rad, m).
        q: x, y (m) and angle (rad) of each body.
        lower: the effort (N m along an angle, N along a length) below which the coordinate moves backwards; minus infinity: no
            effort moves it.
        upper: the effort above which the coordinate moves forwards; infinity: no effort moves it.
        without_friction: the only effort that would hold the mechanism without friction.
        by_preload: whether `lower` and `upper` are infinite because of preloads alone; otherwise friction locks the mechanism.
        redundant: the names of the redundant constraints, between which there may be preloads.
    """

    values: Float[Array, "T"]
    q: Float[Array, "T bodies 3"]
    lower: Float[Array, "T"]
    upper: Float[Array, "T"]
    without_friction: Float[Array, "T"]
    by_preload: Bool[Array, "T 2"]
    redundant: tuple[str, ...] = eqx.field(static=True, default=())
    unit: str = eqx.field(static=True, default="")  # of the efforts

    _units = units(values="rad or m", q="m, m, rad", lower="N m or N", upper="N m or N", without_friction="N m or N")

    def _table(self) -> PrintedTable:
        if np.ndim(self.values) != 1:
            return fields_table(self, self._units, "efforts that hold a mechanism, batched")
        rests, names = np.asarray(self.rests), ("lower", "upper", "without_friction")
        rows = [(name.replace("_", " "), format_numbers(getattr(self, name), self.unit)) for name in names]
        held = np.asarray(self.values)[rests]
        alone = f"at {rests.sum()} of {rests.size} values, from {held.min():g} to {held.max():g}" if held.size else "at no value"
        return PrintedTable("efforts that hold a mechanism at rest", [*rows, ("rests without effort", alone), *self._reasons()])

    def _reasons(self) -> list[tuple[str, str]]:
        """Return rows of the table that say at how many values bounds are infinite, and for which reason."""
        infinite = np.isinf(np.stack([np.asarray(self.lower), np.asarray(self.upper)], 1))
        preloaded = np.asarray(self.by_preload)
        reasons = {
            "locked by friction": (infinite & ~preloaded, "no effort moves it there"),
            "locked by preloads": (
                preloaded,
                f"redundant constraints, {join_names(self.redundant)}, can press joints together without limit; "
                "preload=False: loads of least norm",
            ),
        }
        return [
            (name, f"at {marks.any(1).sum()} of {len(marks)} values: {text}")
            for name, (marks, text) in reasons.items()
            if marks.any()
        ]

    @property
    def rests(self) -> Bool[Array, "T"]:
        """Mask of the values at which the mechanism rests without any effort: its resting positions."""
        return (jnp.asarray(self.lower) <= 0) & (jnp.asarray(self.upper) >= 0)


@checked
def holding_efforts(
    mechanism: Mechanism,
    driver: str | Coordinate,
    values: Annotated[Float[ArrayLike, "T"] | Sequence[float], FINITE],
    state: State | None = None,
    held: Annotated[Mapping[str, NumberLike], NUMBERS_BY_NAME] | None = None,
    preload: bool = True,
) -> HoldingEfforts:
    """Return the bounds of the efforts along a coordinate that hold a mechanism at rest, at each value of the coordinate.

    An effort holds the mechanism if there are reactions and friction that balance all bodies, with the friction of each joint
    within its limit: `torque` + `static_coefficient` (by default `coefficient`) times the load. This includes `Friction` with
    the smooth law, which creeps in runs. Between the bounds friction can hold the mechanism; where zero is between them, it rests
    by itself. Bounds depend on weights, but not on inertia.

    Redundant constraints admit internal loads, such as those of a part that was pressed into place. By default these may have any
    size, and as they press on joints, they can make a bound infinite: `by_preload` marks such bounds.

    The function is pure and batched by `vmap`; efforts have derivatives of first order with respect to every number of the
    mechanism.

    Args:
        mechanism: a mechanism of one degree of freedom once other drivers hold.
        driver: a driver of the scene, a coordinate by its name (`body.crank.angle`), or a `Coordinate`.
        values: values of the coordinate (rad, m), in the order in which they are reached.
        state: a position on the branch; by default the initial guess, assembled.
        held: values that other drivers or coordinates hold, by name; by default drivers keep their values of time 0.
        preload: whether redundant constraints may have any internal loads; False: loads are those of least norm, as in runs.

    Returns:
        A `HoldingEfforts`, with two bounds for each value.

    Raises:
        SceneError: no such driver or coordinate, or positions do not follow from it.
    """
    mechanism.require_masses("efforts at rest")
    driven = drive(mechanism, driver, 0.0, held)
    q = kinematics(mechanism, driver, values, state, held=held).q
    analysis, positions = driven.analysis, jnp.asarray(q).reshape(len(q), -1)
    bounds, exact, by_preload = _efforts(driven.mechanism, analysis, positions, driven.row, preload)
    redundant = tuple(dict.fromkeys(name for name, _ in analysis.redundant))
    unit = driven.mechanism.drivers[driven.name].effort_unit
    lower, upper = bounds
    return HoldingEfforts(jnp.asarray(values, float), q, lower, upper, exact, by_preload, redundant, unit)


@deferred
def _efforts(
    mechanism: Mechanism, analysis: Analysis, q: Float[Array, "T n"], row: int, preload: bool
) -> tuple[list[Array], Array, Array]:
    def at(q: Array) -> tuple[list[Array], Array, Array]:
        reactions, balance = reactions_at(mechanism, analysis, 0.0, q, row)
        known = (jnp.abs(balance.motion - 1) < STOPPED_TOL) & (balance.force <= UNBALANCED_TOL * reactions.scale)
        signs = -1.0, 1.0
        bounds = [sign * largest_effort(mechanism, reactions.without_internal, sign) for sign in signs]
        by_preload = jnp.zeros(2, bool)
        if preload and analysis.redundant_rows != ():
            least, bounds = bounds, [sign * largest_effort(mechanism, reactions, sign) for sign in signs]
            by_preload = jnp.isinf(jnp.stack(bounds)) & jnp.isfinite(jnp.stack(least))
        exact = reactions.without_internal.effort(jnp.zeros(len(reactions.units)))
        bounds = [jnp.where(known, x + 0.0, jnp.nan) for x in bounds]
        return bounds, jnp.where(known, exact + 0.0, jnp.nan), known & by_preload

    reached = jnp.all(jnp.isfinite(q), axis=1)
    bounds, exact, by_preload = jax.vmap(at)(jnp.where(reached[:, None], q, mechanism.q0.ravel()))
    bounds, exact = jax.tree.map(lambda x: jnp.where(reached, x, jnp.nan), (bounds, exact))
    return bounds, exact, reached[:, None] & by_preload
