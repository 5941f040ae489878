"""Efforts of drivers for a prescribed motion, as inverse_dynamics.py derives them: by JAX, or by NumPy for concrete numbers."""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
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
from udkjax.positions.assembling.coordinates import Coordinate, element_of, value_of
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.elements.bodies import GROUND
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
        motion: q, v and a of the prescribed motion.

    Returns:
        Efforts (N m, N) and rates (rad/s, m/s), each (k, T), and the part of M a - F that nothing exerts, relative to M a and the
        loads.
    """
    found = None
    if joints.is_concrete and not is_traced(values):
        found = efforts_by_numpy(joints, _slopes_of(values, joints.body_names), analysis, weights, ts, motion)
    return found or _by_jax(joints.without_origin, analysis, values, jnp.asarray(weights), ts, *map(jnp.asarray, motion))


@deferred
def _by_jax(
    mechanism: Mechanism, analysis: Analysis, values: Sequence[Coordinate], w: Array, ts: Array, q: States, v: States, a: States
) -> Efforts:
    scales = analysis.scales
    units, share, weights = analysis.coordinate_units, 1 / jnp.sqrt(w), scales.length / analysis.row_units
    coordinates = [value_of(mechanism, element) for element in values]
    directed = DirectedFriction.put_in(mechanism)
    fastest, quickest = (jax.lax.stop_gradient(scales.size(jnp.where(jnp.isfinite(x), x, 0.0))) for x in (v, a))

    def at(t: Array, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        q, v, a = q.ravel(), v.ravel(), a.ravel()
        speed, rate = jax.jvp(directed.sliding_speeds, (q, v), (v, a))
        least = AT_REST.closed * directed.units(scales.length)
        moves, starts = jnp.abs(speed) > least * fastest, jnp.abs(rate) > least * quickest
        way = jnp.where(moves, jnp.sign(speed), jnp.where(starts, jnp.sign(rate), 0.0))  # from rest, that of the acceleration
        sides = jax.lax.stop_gradient(jnp.stack([way, jnp.zeros(len(speed))], axis=-1))
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


def _slopes_of(elements: Sequence[Coordinate], body_names: Sequence[str]) -> Callable[[np.ndarray], np.ndarray]:
    """Return a NumPy function of q (n, T) that returns the derivatives C (k, n, T) of k coordinates with respect to q.

    With p the vectors from the origins of the bodies to their points, n the direction of the coordinate, and d from point 1 to
    point 2, the coordinate changes by n . (dx2 + p2' dtheta2 - dx1 - p1' dtheta1), where ' is a quarter turn. If n turns with
    body 1, the coordinate also changes by n' . d dtheta1.
    """
    places = [[None if body == GROUND else body_names.index(body) for body in element.bodies] for element in elements]

    def slopes(q: np.ndarray) -> np.ndarray:
        C = np.zeros((len(elements), *q.shape))
        for k, (element, bodies) in enumerate(zip(elements, places, strict=True)):
            for sign, body, values in zip((-1, 1), bodies, _slopes_of_one(element, bodies, q), strict=True):
                if body is not None:
                    C[k, 3 * body : 3 * body + 3] = sign * values
        return C

    return slopes


def _slopes_of_one(element: Coordinate, bodies: Sequence[int | None], q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return minus the derivatives (3, T) of a coordinate by x, y and angle of body 1, and its derivatives by those of body 2."""
    if element.coordinate == "angle":
        return np.array([[0.0], [0.0], [1.0]]), np.array([[0.0], [0.0], [1.0]])
    poses = [np.zeros((3, q.shape[1])) if k is None else q[3 * k : 3 * k + 3] for k in bodies]
    points = [0j, 0j] if element.points is None else [complex(x, y) for x, y in np.asarray(element.points).tolist()]
    p1, p2 = (point * np.exp(1j * pose[2]) for point, pose in zip(points, poses, strict=True))
    o1, o2 = (pose[0] + 1j * pose[1] for pose in poses)
    d = o2 + p2 - o1 - p1
    if element.coordinate == "distance":
        n, turns = d / np.abs(d), 0.0
    else:
        axis = 0.0 if element.axis is None else float(element.axis)
        n = np.exp(1j * (poses[0][2] + axis)) * (1.0 if element.coordinate == "x" else 1j)
        turns = (np.conj(1j * n) * d).real
    first, second = (np.stack([n.real, n.imag, (np.conj(n) * 1j * p).real - more]) for p, more in ((p1, turns), (p2, 0.0)))
    return first, second


@cached_by_identity
def elements_of(mechanism: Mechanism, *drivers: str | Coordinate) -> tuple[Coordinate, ...]:
    """Return the `Coordinate` of each driver, which is given as the name of a driver or coordinate, or as a `Coordinate`.

    Raises:
        SceneError: a name is neither a driver nor a coordinate, or a coordinate does not fit the mechanism.
    """
    elements = tuple(element_of(mechanism, driver) for driver in drivers)
    if not all(isinstance(driver, str) for driver in drivers):
        with jax.ensure_compile_time_eval():  # a mechanism checks coordinates, however they are given
            rows = {f"value{k + 1}": element.driver() for k, element in enumerate(elements)}
            mechanism.with_elements(mechanism.groups | {"driver": rows})
    return elements
