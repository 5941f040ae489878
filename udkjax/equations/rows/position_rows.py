"""Rows of Psi at closed positions: which of them are redundant, and on which others a row depends.

Redundancy depends on numbers (three equal cranks) as well as on topology, and a single position does not suffice to find it: in a
singular configuration more rows are dependent than elsewhere. So the mechanism is closed and moved along a random motion, and the
rows to leave out are chosen such that the others stay independent. For a left null space N of D (N^T D = 0), the rows outside S
are independent exactly where N[S] is invertible: if an x row and a y row depend on each other with coefficients cos and sin of an
angle, only a row whose coefficient does not vanish can be left out, and the motion shows which one. Everything is NumPy on the
scene's programs, without compilation.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from udkjax.annotations import Time
from udkjax.equations.programs.scales import Scales
from udkjax.equations.rows.position_closure import CLOSURE

POSITION_SAMPLES = 24  # positions of the random motion, if the first one has dependent rows
MANY_ROWS = 300  # rows of Psi above which only a third of the positions is used, to save time
MOST_FAILURES = 3  # after this many positions in succession that cannot be closed, the drivers are contradictory
RETRY_STEP_FRACTION = 1e-3  # fraction of the drivers' time step to try next if the first positions cannot be closed
HEADING_NOISE = 0.3  # fraction of the direction of the random motion that is new at each position
NEGLIGIBLE_SHARE = 1e-6  # coefficients of unit rows up to this size are rounding errors
GENERIC_TOL = 0.05  # smallest singular value, relative to the largest, of positions that are used to choose rows


class ClosedPosition(Protocol):
    """A closed position and the rank of D at it: a `DensePosition` or a `SparsePosition`."""

    @property
    def q(self) -> np.ndarray:
        """The coordinates (n,)."""
        ...

    @property
    def rank(self) -> int:
        """The rank of D."""
        ...

    @property
    def is_clear(self) -> bool:
        """True if the rank is certain."""
        ...

    def tangent_part(self, heading: np.ndarray) -> np.ndarray:
        """Return the part of a displacement that the constraints allow."""
        ...


Position = TypeVar("Position", bound=ClosedPosition)


class PositionRows(ABC, Generic[Position]):
    """Psi and D of a mechanism with concrete numbers: `KinematicRows` or `SparseRows`."""

    count: int
    size: int
    names: list[tuple[str, int]]
    scales: Scales
    metric: np.ndarray
    driver_time_step: float

    @abstractmethod
    def at(self, t: Time, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, Any]:
        """Return Psi, the lengths of the rows of D, and D with unit rows.

        Scaling rows does not change the solutions of consistent equations.
        """

    @abstractmethod
    def dense(self, matrix: Any) -> np.ndarray:
        """Return D, a part of D or a null space of D, which may be sparse, as a NumPy array."""

    @abstractmethod
    def residual(self, t: Time, q: np.ndarray) -> np.ndarray:
        """Return Psi, each row divided by its scale."""

    @abstractmethod
    def step_size(self, step: np.ndarray) -> float:
        """Return the largest component of a step (n,), in rad or characteristic lengths."""

    @abstractmethod
    def correction(self, t: Time, q: np.ndarray) -> np.ndarray:
        """Return the Gauss-Newton step -W D^+ Psi (n,)."""

    @abstractmethod
    def close(self, t: Time, q: np.ndarray, give_up: bool = False) -> Position | None:
        """Return a closed position near q; None if none is found. `give_up`: stop early if there seems to be none."""

    @abstractmethod
    def split_rows(self, positions: list[Position]) -> Sequence[tuple[np.ndarray, Sequence[Any]]]:
        """Return sets of rows that depend on each other, as indices, each with a record of the set at each position.

        A record has the `smallest` nonzero singular value of the set, relative to the largest, and its left `null_space`.
        """

    @np.errstate(all="ignore")
    def sample(self, q: np.ndarray) -> list[Position]:
        """Return closed positions of maximum rank along a random motion from a guess q; a single one if no row is redundant.

        The list is empty if the guess cannot be closed or moved.
        """
        first = self.close(0.0, q)
        if first is None:
            return []
        positions, failures, time_step = [first], 0, self.driver_time_step
        random = np.random.default_rng(0)
        heading = random.standard_normal(self.size)
        for k in range(POSITION_SAMPLES if self.count <= MANY_ROWS else POSITION_SAMPLES // 3):
            full_rank = [p for p in positions if p.is_clear and p.rank == self.count]
            if full_rank:
                return full_rank[:1]
            if failures == MOST_FAILURES:
                if any(p.is_clear for p in positions[1:]):
                    break
                time_step = RETRY_STEP_FRACTION * self.driver_time_step
            last = positions[-1]
            heading = heading / np.linalg.norm(heading) + HEADING_NOISE * random.standard_normal(self.size) / np.sqrt(self.size)
            heading = last.tangent_part(heading)  # keep the direction, so that the motion covers the range
            step = self.metric * heading
            moved = last.q + CLOSURE.longest_step * step / max(self.step_size(step), 1e-300)
            position = self.close(time_step * (k + 1), moved, give_up=True)
            if position is None or not position.is_clear or not np.any(heading):  # stuck: jump
                heading, jump = random.standard_normal(self.size), random.uniform(-1.0, 1.0, self.size)
                position = self.close(time_step * (k + 1), first.q + CLOSURE.longest_step * self.metric * jump, give_up=True)
            failures = 0 if position is not None else failures + 1
            positions.extend([] if position is None else [position])
        positions = [p for p in positions if p.is_clear]
        if not positions or (len(positions) == 1 and positions[0] is first and first.rank < self.size):
            return []
        rank = max(p.rank for p in positions)
        return [p for p in positions if p.rank == rank]

    def redundant(self, positions: list[Position]) -> tuple[int, ...]:
        """Return the rows to leave out, such that the others stay independent at all positions of full rank."""
        if positions[0].rank == self.count:
            return ()
        chosen = []
        for members, subsets in self.split_rows(positions):
            null_spaces = [subset.null_space for subset in self.generic(subsets)]
            chosen += members[list(self.dispensable(null_spaces))].tolist()
        return tuple(sorted(chosen))

    def owners_of_row(self, t: Time, q: np.ndarray, name: str) -> set[str] | None:
        """Return the constraints on whose rows the first row of constraint `name` depends; None if it is independent."""
        D, owners = self.dense(self.at(t, q)[2]), np.array([owner for owner, _ in self.names])  # D has unit rows
        row, others = D[owners == name][0], D[owners != name]
        shares = np.linalg.lstsq(others.T, row, rcond=NEGLIGIBLE_SHARE)[0]
        if np.linalg.norm(row - others.T @ shares) > NEGLIGIBLE_SHARE:
            return None
        return set(owners[owners != name][np.abs(shares) > NEGLIGIBLE_SHARE])

    @staticmethod
    def generic(positions: Sequence[Any]) -> Sequence[Any]:
        """Return the positions that are far from singular, by their `smallest` singular values; all if none is."""
        return [position for position in positions if position.smallest > GENERIC_TOL] or positions

    @staticmethod
    def dispensable(null_spaces: list[np.ndarray]) -> tuple[int, ...]:
        """Return rows S, as many as each null space has columns, such that N[S] is as far from singular as possible for every N.

        Greedy: take the row whose smallest length over all N is largest; then project the direction of that row out of each N.
        Among equal rows the last is chosen, so that a copy is left out and its original stays.
        """
        chosen: list[int] = []
        while null_spaces[0].shape[1]:
            length = np.min([np.linalg.norm(N, axis=1) for N in null_spaces], axis=0)
            length[chosen] = -1.0
            row = int(np.flatnonzero(length >= 0.999 * length.max())[-1])
            chosen.append(row)
            null_spaces = [N @ np.linalg.svd(N[row : row + 1])[2][1:].T for N in null_spaces]
        return tuple(sorted(chosen))
