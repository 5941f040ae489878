"""The programs of a scene, unrolled and run on Python floats."""

from collections.abc import Sequence

import numpy as np

from udkjax.equations.programs.scene_programs import ScenePrograms
from udkjax.equations.programs.unrolled import Unrolled, UnrolledProgram


def run(program: UnrolledProgram, given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the outputs of a program by array, from its inputs by array; what is not given is zero."""
    values = [float(given[x][k]) if x in given else 0.0 for x, k in program.inputs]
    found: dict[str, list[float]] = {}
    for (name, _), value in zip(program.outputs, program.program(values), strict=True):
        found.setdefault(name, []).append(float(value))
    return {name: np.array(x) for name, x in found.items()}


def evaluate_programs(
    programs: ScenePrograms,
    asked: Sequence[tuple[str, ...]],
    numbers: Sequence[float],
    t: float,
    q: np.ndarray,
    v: np.ndarray,
    **more,
) -> dict[str, np.ndarray]:
    """Return the results of some programs at a state, by the outputs that each is asked for."""
    unrolled, found = Unrolled(programs, asked), {}
    given = {"constants": np.array(unrolled.prologue(list(numbers))), "t": np.array([t]), "q": np.ravel(q), "v": np.ravel(v)}
    for outputs in asked:
        found |= run(unrolled.program(*outputs), given | more)
    return found


def dense(programs: ScenePrograms, entries: np.ndarray) -> np.ndarray:
    """Return Psi_q (m, n) of its entries."""
    row, column, place, factor = programs.psi_q_entries
    found = np.zeros((programs.row_count, programs.coordinate_count))
    found[row, column] = entries[place] * factor
    return found
