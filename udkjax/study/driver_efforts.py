"""Efforts of drivers for a prescribed motion, as inverse_dynamics.py derives them: by JAX, or by NumPy for concrete numbers."""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import NumericArray
from udkjax.arrays import is_traced
from udkjax.complementarity.stick_or_slip import AT_REST
from udkjax.equations import constraints, loads
from udkjax.equations.friction.directed_friction import DirectedFriction
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.states.effort_arrays import efforts_by_numpy
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.pinv import SVD
from udkjax.positions.assembling.coordinates import Coordinate, element_of, slopes_of, value_of
from udkjax.positions.following.drive import with_drivers
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism
from udkjax.statics.load_scale import load_sizes

States: TypeAlias = Float[Array, "T bodies 3"]
Efforts: TypeAlias = tuple[NumericArray, NumericArray, NumericArray]  # as `efforts_by_numpy` returns


def driver_efforts(
    joints: Mechanism,
    analysis: Analysis,
    values: Sequence[Coordinate],
    weights: Float[Array, "k"],
    ts: Float[Array, "T"],
    motion: tuple[States, States, States],
) -> Efforts:
    """Return the efforts of drivers of least weighted norm, the rates of their coordinates, and the unbalanced part of the loads.

    Args:
        joints: the mechanism without its drivers.
        analysis: the analysis of `joints`.
        values: the coordinates along which the drivers exert efforts.
        weights: weight of each squared effort.
        ts: times (s).
        motion: q, v and a.

    Returns:
        Efforts (N m, N) and rates (rad/s, m/s), each (k, T), and the part of M a - F that nothing exerts, relative to M a and the
        loads.
    """
    found = None
    if joints.is_concrete and not is_traced(values):
        found = efforts_by_numpy(joints, slopes_of(values, joints.body_names), analysis, weights, ts, motion)
    return found or _by_jax(joints.without_origin, analysis, values, jnp.asarray(weights), ts, *map(jnp.asarray, motion))


@deferred
def _by_jax(
    mechanism: Mechanism, analysis: Analysis, values: Sequence[Coordinate], w: Array, ts: Array, q: States, v: States, a: States
) -> Efforts:
    scales = analysis.scales
    units, share, weights = analysis.coordinate_units, 1 / jnp.sqrt(w), scales.length / analysis.row_units
    coordinates = [value_of(mechanism, element) for element in values]
    directed = DirectedFriction.put_in(mechanism)
    fastest = jax.lax.stop_gradient(scales.size(jnp.where(jnp.isfinite(v), v, 0.0)))

    def at(t: Array, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        q, v, a = q.ravel(), v.ravel(), a.ravel()
        speed = directed.sliding_speeds(q, v)
        moves = jnp.abs(speed) > AT_REST.closed * fastest * directed.units(scales.length)
        sides = jax.lax.stop_gradient(jnp.stack([jnp.where(moves, jnp.sign(speed), 0.0), jnp.zeros(len(speed))], axis=-1))
        mechanism = directed.with_sides(sides)
        C = jax.jacfwd(lambda q: jnp.stack([c(q.reshape(-1, 3)) for c in coordinates]))(q)
        J = weights[:, None] * constraints.psi_q(mechanism, t, q) * units
        free, determined = _free_part(J), jnp.asarray(True)
        given = loads.mass(mechanism) * a - loads.force(mechanism, t, q, v)
        if analysis.rank is not None:  # otherwise the number of degrees of freedom is unknown
            deficient = SVD(RANK_TOL).plus(J).rank < analysis.rank if len(J) else jnp.asarray(False)
            u = v / units
            speed = jnp.linalg.norm(jnp.where(deficient, u, 1.0))
            u = u / jnp.where(speed > 0, speed, 1.0)
            everywhere, determined = free, ~deficient | ((analysis.degrees_of_freedom == 1) & (speed > 0))
            free = lambda x: jnp.where(deficient, jnp.tensordot(u, u @ x, 0), everywhere(x))  # noqa: E731
        drive, bearing = SVD(RANK_TOL).plus(free((C * units).T * share)), SVD(RANK_TOL).plus(J) if len(J) else None

        def efforts(friction: Array) -> Array:
            return share * (drive @ free(units * (given - friction)))

        def multipliers(friction: Array) -> Array:
            carried = units * (given - friction - C.T @ efforts(friction))
            return jnp.zeros(0) if bearing is None else -weights * (bearing.T @ carried)

        friction = directed.friction(sides, multipliers, t, q, v)
        required, f = free(units * (given - friction)), efforts(friction)
        # Relative to the single terms, since their sum may be a rounding error.
        parts = units * (loads.mass(mechanism) * jnp.abs(a) + load_sizes(mechanism, t, q, v))
        size = jnp.maximum(jnp.max(parts), scales.mass * (scales.length * scales.rate) ** 2)
        residual = jnp.max(jnp.abs(required - free((C * units).T @ f))) / jnp.where(size > 0, size, 1.0)
        return jnp.where(determined, f, jnp.nan), C @ v, residual

    return jax.vmap(at, out_axes=(1, 1, 0))(ts, q, v, a)


def _free_part(J: Float[Array, "m n"]) -> Callable[[Array], Array]:
    """Return x -> (I - J^+ J) x for vectors (n,) or columns (n, k): the projection onto J's null space; differentiable."""
    if not len(J):
        return lambda x: x
    plus = SVD(RANK_TOL).plus(J)
    return lambda x: x - plus @ (J @ x)


@cached_by_identity
def elements_of(mechanism: Mechanism, *drivers: str | Coordinate) -> tuple[Coordinate, ...]:
    """Return the coordinates of drivers, as `element_of`. Raises `SceneError`."""
    elements = tuple(element_of(mechanism, driver) for driver in drivers)
    if not all(isinstance(driver, str) for driver in drivers):
        with jax.ensure_compile_time_eval():  # a mechanism checks coordinates, however they are given
            rows = {f"value{k + 1}": element.driver() for k, element in enumerate(elements)}
            with_drivers(mechanism, rows)
    return elements
