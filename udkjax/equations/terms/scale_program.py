"""The scales of a scene (scales.py) as loops over its bodies, its rows of Psi, and the pairs of a row and one of its bodies.

    scales    length, arm, rate, mass, rank_tol, and then the scale of each row, computed from the array `numbers`

A row changes by `moved` if a body moves by a metre, and by `turned` if it turns by a radian.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from udkjax.arrays import ROUNDING
from udkjax.equations.terms.element_programs import VELOCITY_INPUTS
from udkjax.equations.terms.scene_layout import BODY_COORDINATES, ROW, ConstraintGroup
from udkjax.equations.terms.scene_terms import SceneTerms
from udkjax.expressions import Scalar, ScalarProgram
from udkjax.expressions.loops.loop_program import MAXIMUM, Kernel, KernelLoop, KernelWriter, LoopProgram, Reset
from udkjax.expressions.scalars.selection import absolute, greater, maximum, where
from udkjax.scene.mechanism import Mechanism

# Rank tolerance relative to the largest singular value of D: well above rounding errors and drift, well below the singular values
# in generic configurations. With projection, runs with any value from 1e-2 to 1e-5 cross the same singular configurations.
RANK_TOL = 1e-4
MAX_MASS_RATIO = 100.0  # for larger ratios the tolerance is lowered: see `Scales`

LENGTH, ARM, RATE, MASS, THRESHOLD, ROWS = range(6)  # indices in the array `scales`
RADIUS, MOVED, CHANGE, INVERSE_MASS, LARGEST = range(5)  # indices in the array `largest`, and its size
PAIR, PAIR_ROW, PAIR_MASS, PAIR_INERTIA = range(4)  # columns of the table of pairs


class ScaleProgram(NamedTuple):
    """The program, and the sizes of the arrays that only it uses."""

    program: LoopProgram
    sizes: dict[str, int]


def write_scales(terms: SceneTerms, places: Mechanism, number_count: int, prologue: LoopProgram) -> ScaleProgram:
    """Write the program that computes the scales.

    Args:
        terms: The terms of the scene.
        places: The scene, with each number replaced by its index in `numbers`.
        number_count: Number of numbers of the scene.
        prologue: The program that computes the constants of the scene.

    Returns:
        The program, and the sizes of its own arrays.
    """
    layout, bodies = terms.layout, list(places.bodies.values())
    masses = np.array([[int(body.mass), int(body.inertia)] for body in bodies])
    at_guess = [[int(np.ravel(x)[0]) for x in (b.position, b.angle, b.velocity, b.angular_velocity)] for b in bodies]
    body_table = np.concatenate([layout.body_table[:, [BODY_COORDINATES]], masses, np.array(at_guess)], 1)
    row_table, pair_table = np.arange(layout.row_count)[:, None], np.zeros((0, 4), int)
    elements = []
    for group in layout.constraints:
        row_bodies = _row_body_pairs(group)
        first = len(pair_table) + len(row_bodies) * np.arange(len(group.table))
        elements.append(_over_elements(terms, group, row_bodies, first))
        for k, (row, body) in enumerate(row_bodies):
            columns = first + k, group.table[:, ROW] + row, *masses[group.bodies[body]].T
            pair_table = np.concatenate([pair_table, np.stack(columns, 1)])
    loops = [
        *(Reset("scales", 0, ROWS), Reset("largest", 0, LARGEST), Reset("change", 0, layout.row_count), Reset("t", 0, 1)),
        KernelLoop(_kernel(_write_finite), np.arange(number_count)[:, None]),
        KernelLoop(_kernel(_write_guess), body_table),
        *(*prologue.parts, terms.sincos(), *terms.free_accelerations("v"), *elements),
        KernelLoop(_kernel(_write_arm), pair_table),
        KernelLoop(_kernel(_write_length), np.zeros((1, 1), int)),
        KernelLoop(_kernel(_write_change), pair_table),
        KernelLoop(_kernel(_write_largest_change), row_table),
        KernelLoop(_kernel(_write_row), row_table),
        KernelLoop(_kernel(_write_inverse_mass), pair_table),
        terms.over_bodies("scale of rates", lambda w: _write_rate(w, [terms.read_free(w, k) for k in range(3)])),
        KernelLoop(_kernel(_write_threshold), np.zeros((1, 1), int)),
    ]
    rows, pairs = layout.row_count, len(pair_table)
    sizes = {"scales": ROWS + rows, "largest": LARGEST, "change": rows, "psi_t": rows, "gamma": rows}
    sizes |= {"moved": pairs, "turned": pairs, "constants": layout.constant_count, "t": 1}
    return ScaleProgram(LoopProgram(loops), sizes | dict.fromkeys("qv", layout.coordinate_count))


def _row_body_pairs(group: ConstraintGroup) -> list[tuple[int, int]]:
    """Return the pairs (row, body) of an element for which Psi_q has entries that are not zero by structure."""
    entries = _entries(group)
    return [(r, b) for r, b in np.ndindex(entries.shape[:2]) if not all(s.is_zero for s in entries[r, b])]


def _entries(group: ConstraintGroup) -> np.ndarray:
    """Return the entries of Psi_q of an element, (rows, bodies, 3)."""
    return np.array(group.programs.outputs["psi_q"], object).reshape(group.programs.row_count, len(group.bodies), 3)


def _over_elements(terms: SceneTerms, group: ConstraintGroup, row_bodies: list[tuple[int, int]], first: np.ndarray) -> KernelLoop:
    """Return the loop that computes `moved` and `turned` of the pairs, and psi_t and gamma of the rows.

    `first` is the index of each element's first pair in the table of pairs.
    """
    programs, base = group.programs, group.table.shape[1]

    def write(w: KernelWriter):
        entries = _entries(group)
        for k, (row, body) in enumerate(row_bodies):
            x, y, angle = entries[row, body]
            moved = w.graph.sqrt(x * x + y * y)
            w.write(moved, "moved", base, k)
            w.write(absolute(angle), "turned", base, k)
            w.write(moved, "largest", None, MOVED, MAXIMUM)
        for row, (rate, gamma) in enumerate(zip(_psi_t(group), programs.outputs["gamma"], strict=True)):
            w.write(rate, "psi_t", ROW, row)
            w.write(gamma, "gamma", ROW, row)

    loop = terms.over_group("scales", group, write)
    return loop._replace(table=np.concatenate([group.table, first[:, None]], 1))


def _psi_t(group: ConstraintGroup) -> list[Scalar]:
    """Return Psi_t of an element: Psi_dot at rest."""
    programs, graph = group.programs, group.programs.graph
    values = {s.index: Scalar(graph, s.index) for s in (*programs.constants, programs.t, *(s for *_, s in programs.state))}
    values |= {s.index: graph.constant(0.0) for name, _, s in programs.state if name in VELOCITY_INPUTS}
    rate = ScalarProgram(graph, [Scalar(graph, k) for k in values], programs.outputs["psi_dot"])
    return graph.copy(rate, values)


# --- kernels; numbers may be NaN or infinite


@lru_cache(maxsize=64)
def _kernel(write: Callable[[KernelWriter], None]) -> Kernel:
    """Return the kernel that `write` writes; it is made once, and all scenes share it."""
    w = KernelWriter()
    write(w)
    return w.kernel()


def _is_finite(x: Scalar) -> Scalar:
    return greater(x.graph.constant(math.inf), absolute(x))


def _finite(x: Scalar) -> Scalar:
    """Return x, or zero if it is not finite."""
    return where(_is_finite(x), x, x.graph.constant(0.0))


def _swing(acceleration: Scalar) -> Scalar:
    """Return the rate (1/s) of an acceleration a in units of L: one over half the period of a pendulum, pi sqrt(L / a)."""
    return acceleration.graph.sqrt(absolute(_finite(acceleration))) / math.pi


def _write_finite(w: KernelWriter) -> None:
    """Write code that makes the mass NaN if a number of the scene is not finite."""
    w.write(
        where(_is_finite(w.read("numbers", 0)), w.graph.constant(0.0), w.graph.constant(math.nan)), "scales", None, MASS, MAXIMUM
    )


def _write_guess(w: KernelWriter) -> None:
    """Write code that copies q and v of the initial guess, and finds the largest radius of gyration and the largest mass."""
    mass, inertia = w.read("numbers", 1), w.read("numbers", 2)
    w.write(w.graph.sqrt(inertia / mass), "largest", None, RADIUS, MAXIMUM)
    w.write(mass, "scales", None, MASS, MAXIMUM)
    for k in range(3):
        for array, base in (("q", 3), ("v", 5)):
            w.write(w.read("numbers", base + k // 2, k % 2), array, 0, k)


def _write_arm(w: KernelWriter) -> None:
    """Write code that finds the longest lever arm of all pairs of a row and a body; it stays 0 without pairs."""
    moved, turned = w.read("moved", PAIR), w.read("turned", PAIR)
    is_moved = greater(moved, w.read("largest", None, MOVED) * ROUNDING)
    arm = where(is_moved, turned / where(is_moved, moved, w.graph.constant(1.0)), w.graph.constant(0.0))
    w.write(_finite(arm), "scales", None, ARM, MAXIMUM)


def _write_length(w: KernelWriter) -> None:
    radius, arm = w.read("largest", None, RADIUS), w.read("scales", None, ARM)
    arm = where(greater(arm, radius * ROUNDING), arm, radius)
    w.write(maximum(radius, arm), "scales", None, LENGTH)
    w.write(arm, "scales", None, ARM)


def _write_change(w: KernelWriter) -> None:
    """Write code that finds the largest change of each row by a displacement of L or a turn of one radian of a body."""
    moved = w.read("moved", PAIR) * w.read("scales", None, LENGTH)
    w.write(maximum(moved, w.read("turned", PAIR)), "change", PAIR_ROW, 0, MAXIMUM)


def _write_largest_change(w: KernelWriter) -> None:
    w.write(_finite(w.read("change", 0)), "largest", None, CHANGE, MAXIMUM)


def _write_row(w: KernelWriter) -> None:
    """Write code that computes the scale of each row, and the largest rate at which rows change."""
    change = _finite(w.read("change", 0))
    moves = greater(change, w.read("largest", None, CHANGE) * ROUNDING)
    scale = where(moves, change, w.read("scales", None, LENGTH))  # L if no body moves the row at the guess
    w.write(scale, "scales", 0, ROWS)
    for rate in (absolute(_finite(w.read("psi_t", 0) / scale)), _swing(w.read("gamma", 0) / scale)):
        w.write(rate, "scales", None, RATE, MAXIMUM)


def _write_inverse_mass(w: KernelWriter) -> None:
    """Write code that finds the largest contribution (1/kg) of a single body to a diagonal entry of the weighted D D^T."""
    moved, turned = w.read("moved", PAIR), w.read("turned", PAIR)
    weight = w.read("scales", None, LENGTH) / w.read("scales", PAIR_ROW, ROWS)
    entry = moved * moved / w.read("numbers", PAIR_MASS) + turned * turned / w.read("numbers", PAIR_INERTIA)
    w.write(absolute(_finite(entry * (weight * weight))), "largest", None, INVERSE_MASS, MAXIMUM)


def _write_rate(w: KernelWriter, free: list[Scalar]) -> None:
    """Write code that finds the largest rate at which velocities and free accelerations move and turn bodies."""
    length = w.read("scales", None, LENGTH)
    for k, unit in enumerate((length, length, w.graph.constant(1.0))):
        for rate in (absolute(_finite(w.read("v", BODY_COORDINATES, k) / unit)), _swing(free[k] / unit)):
            w.write(rate, "scales", None, RATE, MAXIMUM)


def _write_threshold(w: KernelWriter) -> None:
    ratio = w.read("largest", None, INVERSE_MASS) * w.read("scales", None, MASS) / MAX_MASS_RATIO
    w.write(RANK_TOL / w.graph.sqrt(maximum(w.graph.constant(1.0), ratio)), "scales", None, THRESHOLD)
