"""Loads, stiffness and damping of a mechanism at rest, by NumPy on the scene's programs, without compilation."""

from typing import NamedTuple

import numpy as np

from udkjax.annotations import Time
from udkjax.equations.dense_rows import DenseTerms
from udkjax.equations.loads import mass_of
from udkjax.equations.rest_program import CURVATURE, DAMPING, LOADS, STIFFNESS
from udkjax.equations.scene_programs import scene_programs
from udkjax.scene.mechanism import Mechanism


class RestingLoads(NamedTuple):
    """Loads of a mechanism at rest, and their derivatives."""

    force: np.ndarray  # F (n,)
    sizes: np.ndarray  # (n,) the sum of the absolute loads of gravity and of each force element
    stiffness: np.ndarray  # -F_q (n, n)
    damping: np.ndarray  # -F_v (n, n)


class RestTerms(DenseTerms):
    """Psi, its derivatives, and loads at rest, of a mechanism with concrete numbers, as dense matrices."""

    def __init__(self, mechanism: Mechanism):
        super().__init__(mechanism)
        self.mass = np.asarray(mass_of(mechanism, np))
        self._weight = self.mass * np.tile([*np.asarray(mechanism.gravity, float), 0.0], self.size // 3)
        self._places = scene_programs(mechanism).at_rest.places

    def loads(self, t: Time, q: np.ndarray) -> RestingLoads:
        """Return the loads at rest in a position, and their derivatives."""
        entries = self._arrays_at(t).loads_at_rest(t, q)
        force, sizes = self._weight.copy(), np.abs(self._weight)
        if LOADS in entries:
            rows = self._places[LOADS].rows
            np.add.at(force, rows, entries[LOADS])
            np.add.at(sizes, rows, np.abs(entries[LOADS]))
        matrices = (self._matrix(name, entries[name]) if name in entries else self._zero() for name in (STIFFNESS, DAMPING))
        return RestingLoads(force, sizes, *matrices)

    def curvature(self, t: Time, q: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Return (lambda^T Psi)_qq (n, n)."""
        if not len(self._places[CURVATURE].rows):
            return self._zero()
        return self._matrix(CURVATURE, self._arrays_at(t).curvature(t, q, multipliers))

    def _zero(self) -> np.ndarray:
        return np.zeros((self.size, self.size))

    def _matrix(self, name: str, entries: np.ndarray) -> np.ndarray:
        matrix = self._zero()
        np.add.at(matrix, tuple(self._places[name]), entries)
        return matrix
