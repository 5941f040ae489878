"""Efforts that hold a mechanism at rest with friction: all efforts between two bounds.

At rest the friction of a joint has any value up to its limit: the constant torque, plus the static coefficient times the load.
The mechanism begins to move along a coordinate c, in the direction s = 1 or -1, when all joints that slide in this motion resist
it with their limits, and the effort f along c exceeds this resistance,

    s C a > 0,        M a + Psi_q^T lambda = F + C^T f + G_s(lambda),        C = c_q.

Friction is a sum of norms of loads, so s C a is a concave function of s f: its first zero is the bound. Newton's method
approaches this zero from within. If s C a stops growing below zero, no effort moves the mechanism in this direction: friction
locks it, and the bound is infinite.
"""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from udkjax.annotations import NumberLike
from udkjax.equations import constraints
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.analysis import Analysis
from udkjax.equations.directed_friction import DirectedFriction
from udkjax.pinv import SVD
from udkjax.positions.assembly import State
from udkjax.positions.coordinates import Coordinate
from udkjax.positions.drive import drive
from udkjax.positions.kinematics import kinematics
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_numbers, units
from udkjax.programs.deferred import deferred
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.newton_steps import repeated_newton

LOCKED = 1e-9  # smaller derivatives of the acceleration by the effort, relative to that without friction, are rounding errors
STILL = 1e-9  # smaller sliding speeds in a motion, relative to the fastest coordinate, are rounding errors
# Missing part of the unit speed along the coordinate. Where the coordinate moves, rounding errors are below 1e-8, as the rank
# tolerance leaves eight digits; at dead points other rows take a good share of the speed.
STOPPED = 1e-5


class HoldingEfforts(PrintsTable):
    """Bounds of the effort along a coordinate between which friction holds a mechanism at rest, for each value of the coordinate.

    All are NaN where the position is not reached, and at dead points of the coordinate.

    Attributes:
        values: values of the coordinate (rad, m).
        q: x, y (m) and angle (rad) of each body.
        lower: below this effort (N m along an angle, N along a length) it moves backwards; minus infinity: friction locks it.
        upper: above this effort it moves forwards; infinity: friction locks it.
        without_friction: the only effort that would hold it without friction.
    """

    values: Float[Array, "T"]
    q: Float[Array, "T bodies 3"]
    lower: Float[Array, "T"]
    upper: Float[Array, "T"]
    without_friction: Float[Array, "T"]
    unit: str = eqx.field(static=True, default="")  # of the efforts

    _units = units(values="rad or m", q="m, m, rad", lower="N m or N", upper="N m or N", without_friction="N m or N")

    def _table(self) -> PrintedTable:
        if np.ndim(self.values) != 1:
            return fields_table(self, self._units, "efforts that hold a mechanism, batched")
        rests, names = np.asarray(self.rests), ("lower", "upper", "without_friction")
        rows = [(name.replace("_", " "), format_numbers(getattr(self, name), self.unit)) for name in names]
        held = np.asarray(self.values)[rests]
        alone = f"at {rests.sum()} of {rests.size} values, from {held.min():g} to {held.max():g}" if held.size else "at no value"
        return PrintedTable("efforts that hold a mechanism at rest", [*rows, ("rests without effort", alone)])

    @property
    def rests(self) -> Bool[Array, "T"]:
        """Mask of the values at which the mechanism rests without any effort: its resting positions."""
        return (jnp.asarray(self.lower) <= 0) & (jnp.asarray(self.upper) >= 0)


@checked
def holding_efforts(
    mechanism: Mechanism,
    driver: str | Coordinate,
    values: Float[ArrayLike, "T"] | Sequence[float],
    state: State | None = None,
    held: Mapping[str, NumberLike] | None = None,
) -> HoldingEfforts:
    """Return the bounds of the efforts along a coordinate that hold a mechanism at rest, at each value of the coordinate.

    Every `Friction` counts with its constant torque and static coefficient, also one with the smooth law, which creeps in runs.
    Between the bounds the mechanism stays where it is; where zero is between them, it stays by itself. Joints that do not slide
    in the motion have no friction; redundant joints have loads of least norm.

    The function is pure and batched by `vmap`; efforts have derivatives of first order with respect to every number of the
    mechanism.

    Args:
        mechanism: a mechanism of one degree of freedom once other drivers hold.
        driver: a driver of the scene, a coordinate by its name (`body.crank.angle`), or a `Coordinate`.
        values: values of the coordinate (rad, m), in the order in which they are reached.
        state: a position on the branch; by default the initial guess, assembled.
        held: values that other drivers or coordinates hold, by name; by default drivers keep their values of time 0.

    Returns:
        The `HoldingEfforts`.

    Raises:
        SceneError: no such driver or coordinate, or positions do not follow from it.
    """
    driven = drive(mechanism, driver, 0.0, held)
    q = kinematics(mechanism, driver, values, state, held=held).q
    found = _efforts(driven.mechanism, driven.analysis, jnp.asarray(q).reshape(len(q), -1), driven.row)
    return HoldingEfforts(jnp.asarray(values, float), q, *found, unit=driven.mechanism.drivers[driven.name].effort_unit)


@deferred
def _efforts(mechanism: Mechanism, analysis: Analysis, q: Float[Array, "T n"], row: int) -> list[Array]:
    directed, scales = DirectedFriction.put_in(mechanism, every=True), analysis.scales
    method, root = SVD(scales.rank_tol), uk.inverse_sqrt_mass(mechanism)
    free = scales.weights.at[row].set(0.0)  # the coordinate moves
    count = len(directed.joints)

    def at(q: Array) -> list[Array]:
        still, A = jnp.zeros_like(q), constraints.psi_q(mechanism, 0.0, q)
        C, D = A[row], free[:, None] * A * root
        plus = uk.pseudoinverse(method, D)
        whole = uk.pseudoinverse(method, scales.weights[:, None] * A * root)
        u = root * (whole @ (scales.weights * jnp.eye(len(A))[row]))  # the motion with C u = 1
        fastest, speeds = scales.size(u), directed.sliding_speeds(q, u)
        slides = jnp.abs(speeds) > STILL * fastest * directed.units(scales.length)
        forwards = jax.lax.stop_gradient(jnp.where(slides, jnp.sign(speeds), 0.0))

        def acceleration(effort: Array, sign: float) -> Array:
            """Return C a where all joints resist a motion in the direction `sign`."""
            sides = jnp.stack([sign * forwards, jnp.ones(count)], axis=-1)
            scene = directed.with_sides(sides)

            def b(load: Array) -> Array:
                return -free * (A @ uk.a_F(scene, 0.0, q, still, load))

            def multipliers(friction: Array) -> Array:
                return -free * (plus.T @ (plus @ b(friction + effort * C)))

            load = directed.friction(sides, multipliers, 0.0, q, still) + effort * C
            return C @ (uk.a_F(scene, 0.0, q, still, load) + root * (plus @ b(load)))

        one = jnp.ones(())
        value, slope = jax.jvp(lambda f: acceleration(f, 0.0), (0.0 * one,), (one,))
        exact = -value / slope

        def bound(sign: float) -> Array:
            def along(x: Array) -> tuple[Array, Array]:
                return jax.jvp(lambda x: sign * acceleration(sign * x, sign), (x,), (one,))

            def step(x: Array) -> tuple[Array, Array, Array]:
                value, growth = along(x)
                new = jnp.where(growth > LOCKED * slope, x - value / growth, jnp.inf)  # also for NaN: it jams
                return new, jnp.abs(new - x), jnp.abs(new)

            start = jax.lax.stop_gradient(sign * exact)
            x, _ = repeated_newton(step, start)
            x = jax.lax.stop_gradient(x)
            value, growth = along(jnp.where(jnp.isfinite(x), x, start))
            return sign * jnp.where(jnp.isfinite(x), x - value / jax.lax.stop_gradient(growth), jnp.inf)

        known = jnp.abs(C @ u - 1) < STOPPED
        return [jnp.where(known, x, jnp.nan) for x in (bound(-1.0), bound(1.0), exact)]

    reached = jnp.all(jnp.isfinite(q), axis=1)
    found = jax.vmap(at)(jnp.where(reached[:, None], q, mechanism.q0.ravel()))
    return [jnp.where(reached, x, jnp.nan) for x in found]
