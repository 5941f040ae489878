"""The scales of a scene (scales.py) as loops over its bodies, its rows of Psi, and the pairs of a row and a body that it meets.

    scales    length, arm, rate, mass, rank_tol, and then the scale of each row; of the array `numbers` alone

A row changes by `moved` as a body moves by a metre, and by `turned` as it turns by a radian.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from udkjax.equations.element_programs import VELOCITY_INPUTS
from udkjax.equations.scene_layout import BODY_COORDINATES, ROW, ConstraintGroup
from udkjax.equations.scene_terms import SceneTerms
from udkjax.expressions import Scalar, ScalarProgram, trace
from udkjax.expressions.loop_program import MAXIMUM, KernelLoop, KernelWriter, LoopProgram, Reset
from udkjax.scene.fields import ROUNDING
from udkjax.scene.mechanism import Mechanism

# Relative to the largest singular value of D: far above rounding and drift, far below the singular values of a mechanism in
# ordinary positions. With the states returned to the constraint manifold, 1e-2 to 1e-5 cross the same singular configurations.
RANK_TOL = 1e-4
ORDINARY_MASS_RATIO = 100.0  # up to which that holds: see `Scales.rank_tol`

LENGTH, ARM, RATE, MASS, THRESHOLD, ROWS = range(6)  # places in the array `scales`
RADIUS, MOVED, CHANGE, YIELD, LARGEST = range(5)  # places of maxima, and their number
PAIR, PAIR_ROW, PAIR_MASS, PAIR_INERTIA = range(4)  # columns of the table of pairs


class ScaleProgram(NamedTuple):
    """The program, and the sizes of its arrays besides those of the scene."""

    program: LoopProgram
    sizes: dict[str, int]


def write_scales(terms: SceneTerms, places: Mechanism, number_count: int, prologue: LoopProgram) -> ScaleProgram:
    """Write the program.

    Args:
        terms: The terms of the scene.
        places: The scene, with the place of each number in `numbers` instead of the number.
        number_count: Number of numbers of the scene.
        prologue: The program of the constants.
    """
    layout, bodies = terms.layout, list(places.bodies.values())
    masses = np.array([[int(body.mass), int(body.inertia)] for body in bodies])
    at_guess = [[int(np.ravel(x)[0]) for x in (b.position, b.angle, b.velocity, b.angular_velocity)] for b in bodies]
    body_table = np.concatenate([layout.body_table[:, [BODY_COORDINATES]], masses, np.array(at_guess)], 1)
    row_table, pair_table = np.arange(layout.row_count)[:, None], np.zeros((0, 4), int)
    elements = []
    for group in layout.constraints:
        meets = _meets(group)
        first = len(pair_table) + len(meets) * np.arange(len(group.table))
        elements.append(_over_elements(terms, group, meets, first))
        for k, (row, body) in enumerate(meets):
            columns = first + k, group.table[:, ROW] + row, *masses[group.bodies[body]].T
            pair_table = np.concatenate([pair_table, np.stack(columns, 1)])
    parts = [
        *(Reset("scales", 0, ROWS), Reset("largest", 0, LARGEST), Reset("change", 0, layout.row_count), Reset("t", 0, 1)),
        KernelLoop(_kernel(_write_finite), np.arange(number_count)[:, None]),
        KernelLoop(_kernel(_write_guess), body_table),
        *(*prologue.parts, terms.sincos(), *terms.free_accelerations("v"), *elements),
        KernelLoop(_kernel(_write_arm), pair_table),
        KernelLoop(_kernel(_write_length), np.zeros((1, 1), int)),
        KernelLoop(_kernel(_write_change), pair_table),
        KernelLoop(_kernel(_write_largest_change), row_table),
        KernelLoop(_kernel(_write_row), row_table),
        KernelLoop(_kernel(_write_yield), pair_table),
        terms.over_bodies("scale of rates", lambda w: _write_rate(w, [terms.read_free(w, k) for k in range(3)])),
        KernelLoop(_kernel(_write_threshold), np.zeros((1, 1), int)),
    ]
    rows, pairs = layout.row_count, len(pair_table)
    sizes = {"scales": ROWS + rows, "largest": LARGEST, "change": rows, "psi_t": rows, "gamma": rows}
    sizes |= {"moved": pairs, "turned": pairs, "constants": layout.constant_count, "t": 1}
    return ScaleProgram(LoopProgram(parts), sizes | dict.fromkeys("qv", layout.coordinate_count))


def _meets(group: ConstraintGroup) -> list[tuple[int, int]]:
    """Return the rows of an element, each with the bodies that it meets."""
    entries = _entries(group)
    return [(r, b) for r, b in np.ndindex(entries.shape[:2]) if not all(s.is_zero for s in entries[r, b])]


def _entries(group: ConstraintGroup) -> np.ndarray:
    """Return the entries of Psi_q of an element, (rows, bodies, 3)."""
    return np.array(group.programs.outputs["psi_q"], object).reshape(group.programs.row_count, len(group.bodies), 3)


def _over_elements(terms: SceneTerms, group: ConstraintGroup, meets: list[tuple[int, int]], first: np.ndarray) -> KernelLoop:
    """Compute `moved` and `turned` of the pairs, the first of which are given, and psi_t and gamma of the rows."""
    programs, base = group.programs, group.table.shape[1]

    def write(w: KernelWriter):
        entries = _entries(group)
        for k, (row, body) in enumerate(meets):
            x, y, angle = entries[row, body]
            moved = w.graph.sqrt(x * x + y * y)
            w.write(moved, "moved", base, k)
            w.write(_apply(w, jnp.abs, angle)[0], "turned", base, k)
            w.write(moved, "largest", None, MOVED, MAXIMUM)
        for row, (rate, gamma) in enumerate(zip(_psi_t(group), programs.outputs["gamma"], strict=True)):
            w.write(rate, "psi_t", ROW, row)
            w.write(gamma, "gamma", ROW, row)

    part = terms.over_group("scales", group, write)
    return part._replace(table=np.concatenate([group.table, first[:, None]], 1))


def _psi_t(group: ConstraintGroup) -> list[Scalar]:
    """Return Psi_t of an element: Psi_dot at rest."""
    programs, graph = group.programs, group.programs.graph
    known = {s.index: Scalar(graph, s.index) for s in (*programs.constants, programs.t, *(s for *_, s in programs.state))}
    known |= {s.index: graph.constant(0.0) for name, _, s in programs.state if name in VELOCITY_INPUTS}
    rate = ScalarProgram(graph, [Scalar(graph, k) for k in known], programs.outputs["psi_dot"])
    return graph.copy(rate, known)


# --- kernels that all scenes share


@lru_cache(maxsize=64)
def _kernel(write: Callable[[KernelWriter], None]) -> Any:
    w = KernelWriter()
    write(w)
    return w.kernel()


@lru_cache(maxsize=64)
def _traced(function: Callable[..., Any], count: int) -> Callable[..., list[np.ndarray]]:
    return trace(function, *[0.0] * count)


def _apply(w: KernelWriter, function: Callable[..., Any], *arguments: Scalar) -> list[Scalar]:
    """Return a function's results for scalars."""
    found = _traced(function, len(arguments))(w.graph, *(np.asarray(s, object) for s in arguments))
    return [x.item() for x in found]


def _finite(x: Any) -> Any:
    """Return a number that is finite; zero for others."""
    return jnp.where(jnp.abs(x) < jnp.inf, x, 0.0)


def _swing(acceleration: Any) -> Any:
    """Return the rate that belongs to an acceleration, over a length: a pendulum swings to and fro in pi sqrt(L / a) each."""
    return jnp.sqrt(jnp.abs(_finite(acceleration))) / math.pi


def _write_finite(w: KernelWriter) -> None:
    """Leave NaN as the mass where a number is not finite."""
    found = _apply(w, lambda x: jnp.where(jnp.abs(x) < jnp.inf, 0.0, jnp.nan), w.read("numbers", 0))
    w.write(found[0], "scales", None, MASS, MAXIMUM)


def _write_guess(w: KernelWriter) -> None:
    """Compute q and v, the largest radius of gyration, and the largest mass."""
    mass, inertia = w.read("numbers", 1), w.read("numbers", 2)
    w.write(w.graph.sqrt(inertia / mass), "largest", None, RADIUS, MAXIMUM)
    w.write(mass, "scales", None, MASS, MAXIMUM)
    for k in range(3):
        for array, base in (("q", 3), ("v", 5)):
            w.write(w.read("numbers", base + k // 2, k % 2), array, 0, k)


def _write_arm(w: KernelWriter) -> None:
    """Compute the longest arm of all pairs, 0 where none of them has one."""

    def arm(moved: Any, turned: Any, largest: Any) -> Any:
        by_place = moved > ROUNDING * largest
        return _finite(jnp.where(by_place, turned / jnp.where(by_place, moved, 1.0), 0.0))

    given = w.read("moved", PAIR), w.read("turned", PAIR), w.read("largest", None, MOVED)
    w.write(_apply(w, arm, *given)[0], "scales", None, ARM, MAXIMUM)


def _write_length(w: KernelWriter) -> None:
    def lengths(radius: Any, arm: Any) -> Any:
        arm = jnp.where(arm > ROUNDING * radius, arm, radius)
        return jnp.maximum(radius, arm), arm

    found = _apply(w, lengths, w.read("largest", None, RADIUS), w.read("scales", None, ARM))
    for place, s in zip((LENGTH, ARM), found, strict=True):
        w.write(s, "scales", None, place)


def _write_change(w: KernelWriter) -> None:
    """Compute what a displacement of L or a turn of one radian changes in each row."""
    moved = w.read("moved", PAIR) * w.read("scales", None, LENGTH)
    w.write(_apply(w, jnp.maximum, moved, w.read("turned", PAIR))[0], "change", PAIR_ROW, 0, MAXIMUM)


def _write_largest_change(w: KernelWriter) -> None:
    w.write(_apply(w, _finite, w.read("change", 0))[0], "largest", None, CHANGE, MAXIMUM)


def _write_row(w: KernelWriter) -> None:
    """Compute the scale of each row, and the rates at which rows change."""

    def scale_and_rate(change: Any, largest: Any, length: Any, psi_t: Any, gamma: Any) -> Any:
        moves = _finite(change) > ROUNDING * largest
        scale = jnp.where(moves, change, length)  # a row that nothing moves here: as if in metres
        return scale, jnp.maximum(jnp.abs(_finite(psi_t / scale)), _swing(gamma / scale))

    given = w.read("change", 0), w.read("largest", None, CHANGE), w.read("scales", None, LENGTH)
    scale, rate = _apply(w, scale_and_rate, *given, w.read("psi_t", 0), w.read("gamma", 0))
    w.write(scale, "scales", 0, ROWS)
    w.write(rate, "scales", None, RATE, MAXIMUM)


def _write_yield(w: KernelWriter) -> None:
    """Compute the largest entry (1/kg) of a weighted row of D D^T of one body."""

    def entry(moved: Any, turned: Any, mass: Any, inertia: Any, length: Any, scale: Any) -> Any:
        return jnp.abs(_finite((moved**2 / mass + turned**2 / inertia) * (length / scale) ** 2))

    given = *(w.read(x, PAIR) for x in ("moved", "turned")), *(w.read("numbers", k) for k in (PAIR_MASS, PAIR_INERTIA))
    found = _apply(w, entry, *given, w.read("scales", None, LENGTH), w.read("scales", PAIR_ROW, ROWS))
    w.write(found[0], "largest", None, YIELD, MAXIMUM)


def _write_rate(w: KernelWriter, free: list[Scalar]) -> None:
    """Compute the rates at which velocities and free accelerations move and turn bodies."""
    velocity = [w.read("v", BODY_COORDINATES, k) for k in range(3)]
    for s in _apply(w, _rates, w.read("scales", None, LENGTH), *velocity, *free):
        w.write(s, "scales", None, RATE, MAXIMUM)


def _rates(length: Any, vx: Any, vy: Any, omega: Any, fx: Any, fy: Any, fangle: Any) -> list[Any]:
    moves = [jnp.abs(_finite(x)) for x in (vx / length, vy / length, omega)]
    return [*moves, *(_swing(x) for x in (fx / length, fy / length, fangle))]


def _write_threshold(w: KernelWriter) -> None:
    def threshold(most: Any, mass: Any) -> Any:
        return RANK_TOL / jnp.sqrt(jnp.maximum(1.0, most * mass / ORDINARY_MASS_RATIO))

    found = _apply(w, threshold, w.read("largest", None, YIELD), w.read("scales", None, MASS))
    w.write(found[0], "scales", None, THRESHOLD)
