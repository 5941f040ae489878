"""The search for changes of constraints that remove redundancy.

Candidates follow from the left null space of the Jacobian; each is then verified with the rows of the changed constraint.

With N a basis of the left null space of J and C the rows that a change of a constraint removes, as combinations of the
constraint's own rows, the change preserves the rank if C N has as many independent rows as C; it then removes as many redundant
rows. Only the constraint that changes is built anew: all other rows of J stay.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import groupby
from typing import Any

import numpy as np

from udkjax.equations.rows.dense_rows import KinematicRows
from udkjax.pinv.row_spaces import null_space
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Constraint
from udkjax.scene.mechanism import Mechanism
from udkjax.study.diagnosis.configuration import Configuration, RankedPositions, singular_values
from udkjax.study.diagnosis.dependence import DEPENDENCE_TOL, Dependency, stress_of
from udkjax.study.diagnosis.fixes import Fix, JointChange, apply_change, body_indices, changes_of

SMALLEST_PIVOT = 1e-3  # least ratio of the smallest nonzero singular values after and before a fix
COMPARED_DIGITS = 6  # by which measures of fixes are compared: further ones are rounding errors, which differ between processors


class FixSearch:
    """A search for changes of constraints that remove redundancy in all generic configurations; each is verified once.

    Args:
        mechanism: mechanism.
        positions: positions of the mechanism before all changes, with the scales of all Jacobians.
        at: generic configurations; the first determines the stress of a set.
        owners: the constraint of each row of J.
        row_unit: the scale of each row of J.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        positions: RankedPositions,
        at: Sequence[Configuration],
        owners: Sequence[str],
        row_unit: np.ndarray,
    ):
        self.mechanism, self.owners, self.at = mechanism, list(owners), sorted(at, key=lambda c: -c.smallest)
        self._positions, self._row_unit = positions, row_unit
        self._stresses: dict[tuple[int, Dependency], np.ndarray] = {}  # by configuration and set
        self._verified: dict[tuple[str, str], tuple[Fix, FixSearch] | None] = {}

    def fixes_of(self, dependency: Dependency) -> list[Fix]:
        """Return the best verified change of each constraint of a dependent set, sorted by removed rows and conditioning."""
        found = [next(self._verify_in_turn(name, dependency), None) for name in dependency.constraints] if self.at else []
        return sorted((x[0] for x in found if x), key=lambda fix: (-fix.removes, -_comparable(fix.conditioning)))

    def best(self, sets: Sequence[Dependency]) -> "tuple[Fix, FixSearch] | None":
        """Return the best fix of all sets, and the search in the mechanism after it; None if no fix helps.

        Candidates are verified one after another, the most promising first.
        """
        options = []
        for dependency in sets:
            for name in dependency.constraints:
                first = next(self._helpful_changes(name, dependency), None)
                if first is not None:
                    options.append((first[0], _comparable(first[1]), name, dependency))
        options.sort(key=lambda option: option[:2], reverse=True)
        found = (next(self._verify_in_turn(name, dependency), None) for *_, name, dependency in options)
        return next((x for x in found if x), None)

    def after(self, fix: Fix) -> "FixSearch | None":
        """Return the search in the mechanism after a fix; None if this search has not verified the fix."""
        found = self._verified.get((fix.constraint, fix.change))
        return found[1] if found else None

    @cached_property
    def _worst(self) -> Configuration:
        return self.at[-1]

    def _rows_of(self, name: str) -> list[int]:
        return [k for k, owner in enumerate(self.owners) if owner == name]

    def _helpful_changes(self, name: str, dependency: Dependency) -> Iterator[tuple[int, float, JointChange]]:
        """Iterate over the changes of a constraint that preserve the rank, the best first.

        Each comes with the number of rows that it removes, and the conditioning after it, in this order: (rows, conditioning,
        change). Changes that remove fewer rows are only examined if those that remove more do not help.
        """
        indices, places = self._rows_of(name), body_indices(self.mechanism, name)
        forces = lru_cache(lambda k: self._forces(self.at[k], indices, dependency))
        changes = changes_of(self.mechanism, name, self.at[0], lambda: forces(0))
        for count, group in groupby(changes, lambda change: len(change.removed_rows(len(indices), self.at[0].q, places))):
            options = []
            for change in group:
                if all(_preserves_rank(change.removed_rows(len(indices), c.q, places), c.left[indices]) for c in self.at):
                    slides = enumerate(self.at if change.slides else ())
                    aligned = min((change.alignment(forces(k), c.q, places) for k, c in slides), default=1.0)
                    conditioning = self._conditioning_after(self._worst, indices, places, change)
                    options.append((_comparable(aligned), _comparable(conditioning), change))
            for _, conditioning, change in sorted(options, key=lambda option: option[:2], reverse=True):
                yield count, conditioning, change

    def _forces(self, at: Configuration, indices: list[int], dependency: Dependency) -> np.ndarray:
        """Return the multipliers (rows, redundancy) of a constraint's rows in the states of self-stress of a set."""
        key = id(at), dependency
        if key not in self._stresses:
            self._stresses[key] = stress_of(at.left, self.owners, dependency.constraints)
        return self._stresses[key][indices] / self._row_unit[indices, None]

    def _conditioning_after(self, at: Configuration, indices: list[int], places: list[int | None], change: JointChange) -> float:
        others = np.delete(at.J, indices, axis=0)
        sigma = singular_values(np.concatenate([others, change.remaining_rows(at.J[indices], at.q, places)]))
        return float(sigma[at.rank - 1] / sigma[0]) if at.rank else 1.0

    def _verify_in_turn(self, name: str, dependency: Dependency) -> "Iterator[tuple[Fix, FixSearch]]":
        for removes, _, change in self._helpful_changes(name, dependency):
            key = name, change.text
            if key not in self._verified:
                self._verified[key] = self._verify(name, removes, change)
            if (found := self._verified[key]) is not None:
                yield found

    def _verify(self, name: str, removes: int, change: JointChange) -> "tuple[Fix, FixSearch] | None":
        """Return a fix and the search after it; None if the change has another effect than the Jacobian predicts.

        That is so if another element needs the constraint, or if in a generic configuration the changed constraint is not closed,
        the rank or the number of redundant rows is not the expected one, or the conditioning becomes poor.
        """
        changed = apply_change(self.mechanism, name, change)
        if changed is None:
            return None
        indices, places = self._rows_of(name), body_indices(self.mechanism, name)
        kept, scales = np.delete(np.arange(len(self.owners)), indices), self._positions.rows.scales
        unit = self._row_unit[indices][: len(indices) - removes] if change.slides else self._row_unit[indices][list(change.rows)]
        element, after = _ElementRows(changed, changed.constraints.get(name)), []
        for c in self.at:
            psi, J = element(c)
            if np.max(np.abs(psi) / unit, initial=0.0) >= self._positions.rank_tol * max(1.0, float(scales.size(c.q, np))):
                return None  # it does not close here
            J = np.concatenate([c.J[kept], J * self._positions.unit / unit[:, None]])
            combined = c.left @ null_space(change.removed_rows(len(indices), c.q, places) @ c.left[indices], DEPENDENCE_TOL).T
            left = np.concatenate([combined[kept], change.remaining_rows(combined[indices], c.q, places)])
            found = _Changed(c.t, c.q, J, self._positions.rank_tol, left)
            if found.rank != c.rank or found.redundancy != c.redundancy - removes:
                return None
            after.append(found)
        conditioning = min(c.smallest for c in after)
        if not conditioning > SMALLEST_PIVOT * min(c.smallest for c in self.at):
            return None
        owners = [self.owners[k] for k in kept] + [name] * len(unit)
        search = FixSearch(changed, self._positions, after, owners, np.concatenate([self._row_unit[kept], unit]))
        return Fix(name, change.text, removes, conditioning, changed), search


class _ElementRows:
    """Psi of one constraint, and its rows of Psi_q (., n), as a function of a configuration; both empty for no constraint."""

    def __init__(self, mechanism: Mechanism, element: Constraint | None):
        self._alone = None
        if element is not None:
            names = [name for name in dict.fromkeys(mechanism.frames_of(element)) if name != GROUND]
            self._columns = [3 * mechanism.body_names.index(name) + k for name in names for k in range(3)]
            joints: dict[str, Any] = {"alone": element}  # a driver is only removed, and never changed
            self._alone = KinematicRows(Mechanism({name: mechanism.bodies[name] for name in names}, joints))

    def __call__(self, at: Configuration) -> tuple[np.ndarray, np.ndarray]:
        if self._alone is None:
            return np.zeros(0), np.zeros((0, len(at.q)))
        J, q = np.zeros((self._alone.count, len(at.q))), at.q[self._columns]
        J[:, self._columns] = self._alone.jacobian(at.t, q)
        return self._alone.psi(at.t, q), J


class _Changed(Configuration):
    """A configuration after a change, with a guess of its left null space, which saves a decomposition if it is right."""

    def __init__(self, t: float, q: np.ndarray, J: np.ndarray, rank_tol: float, guess: np.ndarray):
        super().__init__(t, q, J, rank_tol)
        self._guess = guess

    @cached_property
    def left(self) -> np.ndarray:  # pyright: ignore[reportIncompatibleVariableOverride]
        is_right = np.max(np.abs(self._guess.T @ self.J), initial=0.0) <= self._rank_tol * self.largest
        return self._guess if is_right and self._guess.shape[1] == self.redundancy else super().left


def _preserves_rank(removed: np.ndarray, N: np.ndarray) -> bool:
    """Return True if the rank stays the same without the rows `removed`, which are combinations (., rows) of a constraint's rows.

    N has the constraint's rows (rows, k) of the basis of the left null space: the rank stays if `removed` N has independent rows.
    """
    part = removed @ N
    return part.shape[0] <= part.shape[1] and bool(np.all(np.linalg.svd(part, compute_uv=False) > DEPENDENCE_TOL))


def _comparable(measure: float) -> float:
    """Return a measure of a fix without the digits that rounding errors change, so that equal fixes keep their order."""
    return float(f"{measure:.{COMPARED_DIGITS}g}")
