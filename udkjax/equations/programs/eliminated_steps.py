"""Newton steps and linearizations by elimination, by machine code: many times as fast as by singular values, for small scenes.

The results are those by singular values of the same rows, up to rounding. Elimination is used only where rows are clearly
independent, and for structures that have been asked often enough: a program takes as long to write and to compile as some hundred
corrections by singular values.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from udkjax.equations.programs.scene_arrays import SceneArrays
from udkjax.equations.programs.scene_programs import programs_of_structure
from udkjax.equations.terms.rest_program import REDUCED
from udkjax.equations.terms.structure import Structure

USES_BEFORE_ELIMINATION = 100  # answers for one structure by singular values before elimination is prepared
LEAST_DISTANCE = 0.1  # smallest relative distance from dependent rows: elimination loses accuracy by the square of its reciprocal


class AlongTangent(NamedTuple):
    """The linearized equations of motion of a mechanism at rest, along a direction u that the constraints allow."""

    u: np.ndarray
    square: float  # u^T M u
    stiffness: float  # u^T K u
    damping: float  # u^T C u
    free: np.ndarray  # a_F = M^(-1) F
    multipliers: np.ndarray  # lambda of F = Psi_q^T lambda + a part along the constraints


class Eliminated:
    """Newton steps and linearizations of a mechanism with concrete numbers, by elimination.

    Args:
        kind: the structure of the mechanism.
        numbers: its numbers as a vector.
        redundant_rows: rows of Psi that are left out.
        length: radius of gyration (m) of bodies of 1 kg, which replace those of the mechanism; None: its own masses count.
    """

    def __init__(self, kind: Structure, numbers: np.ndarray, redundant_rows: tuple[int, ...], length: float | None):
        self._given, self._uses = (kind, numbers, redundant_rows, length), _uses(kind, redundant_rows)
        self._arrays: SceneArrays[np.ndarray] | None = None

    def newton_step(self, t: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return q after a Newton step to Psi = 0, the smallest in the metric of M, and Psi of all rows before the step.

        None if singular values are needed: programs are not prepared, or rows are not clearly independent.
        """
        found = (arrays := self._prepared()) and arrays.newton_step(t, q)
        return None if not found or not found[2] > LEAST_DISTANCE else found[:2]

    def linearization(self, t: float, q: np.ndarray, direction: np.ndarray) -> "AlongTangent | None":
        """Return the linearization at rest along the tangent part of a direction; None as in `newton_step`."""
        found = (arrays := self._prepared()) and arrays.linearization(t, q, direction)
        if not found or not found["distance"][0] > LEAST_DISTANCE:
            return None
        square, stiffness, damping = found[REDUCED].tolist()
        return AlongTangent(found["dq1"], square, stiffness, damping, found["dv"], -found["multipliers"])

    def _prepared(self) -> SceneArrays[np.ndarray] | None:
        """Return the programs with their arrays, or None before `USES_BEFORE_ELIMINATION` uses of this structure."""
        if self._arrays is None:
            if len(self._uses) < USES_BEFORE_ELIMINATION:
                self._uses.append(0)
                return None
            kind, numbers, redundant_rows, length = self._given
            programs = programs_of_structure(*kind, redundant_rows)
            numbers = numbers if length is None else programs.with_unit_masses(numbers, length)
            self._arrays = SceneArrays(programs, numbers, np)
        return self._arrays


@lru_cache(maxsize=64)
def _uses(kind: Structure, redundant_rows: tuple[int, ...]) -> list[int]:
    """Return the cached list with one entry for each of the first `USES_BEFORE_ELIMINATION` uses of a structure."""
    return []
