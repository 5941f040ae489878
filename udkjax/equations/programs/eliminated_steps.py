"""Newton steps to Psi = 0 by elimination, by machine code: three times as fast as by singular values, for small scenes.

The steps are the smallest in units of the scene's coordinates, as those by singular values of the same rows. Elimination is used
only where rows are clearly independent, and for structures that have been corrected often enough: its program takes as long to
write and to compile as some hundred corrections by singular values.
"""

from functools import lru_cache

import numpy as np

from udkjax.equations.programs.scene_arrays import SceneArrays
from udkjax.equations.programs.scene_programs import programs_of_structure
from udkjax.equations.terms.structure import Structure

WORTH = 100  # corrections of one structure by singular values before elimination is prepared
CLEAR = 0.1  # smallest relative distance from dependent rows: elimination loses accuracy by the square of its reciprocal


class EliminatedSteps:
    """Newton steps of a mechanism of concrete numbers.

    Args:
        kind: the structure of the mechanism.
        numbers: its numbers as a vector.
        redundant_rows: rows of Psi that are left out.
        length: the unit of coordinates that are lengths (m); angles are in rad.
    """

    def __init__(self, kind: Structure, numbers: np.ndarray, redundant_rows: tuple[int, ...], length: float):
        self._given, self._uses = (kind, numbers, redundant_rows, length), _uses(kind, redundant_rows)
        self._arrays: SceneArrays[np.ndarray] | None = None

    def __call__(self, t: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return q after a step, and Psi of all rows before it; None if another method is needed."""
        if self._arrays is None:
            if len(self._uses) < WORTH:
                self._uses.append(0)
                return None
            self._arrays = self._make_arrays(*self._given)
        found = self._arrays.newton_step(t, q)
        return None if found is None or not found[2] > CLEAR else found[:2]

    @staticmethod
    def _make_arrays(
        kind: Structure, numbers: np.ndarray, redundant_rows: tuple[int, ...], length: float
    ) -> SceneArrays[np.ndarray]:
        programs = programs_of_structure(*kind, redundant_rows)
        return SceneArrays(programs, programs.with_unit_masses(numbers, length), np)


@lru_cache(maxsize=64)
def _uses(kind: Structure, redundant_rows: tuple[int, ...]) -> list[int]:
    """Return a list with an entry for each correction so far, up to `WORTH`, of mechanisms with this structure and these rows."""
    return []
