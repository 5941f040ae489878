"""The data of a failed run, from which its cause is found."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from udkjax.equations import constraints
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.rows.position_rows import PositionRows
from udkjax.equations.rows.redundancy import kinematic_rows
from udkjax.integrate.solution import Result
from udkjax.positions.assembling.open_rows import name_open_rows
from udkjax.scene.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class FailedRun:
    """The data of a failed run of one mechanism (not a batch) with concrete numbers."""

    mechanism: Mechanism
    analysis: Analysis
    result: Result
    time: float  # end of the run (s)
    ts: np.ndarray  # output times (T,)
    q: np.ndarray  # (T, n); NaN at times that were not reached
    v: np.ndarray  # (T, n), likewise NaN there
    end: tuple[float, np.ndarray, np.ndarray] | None  # the last state of the integrator, if available
    steps: int  # number of steps tried
    rtol: float
    atol: float
    drift_tol: float
    stabilization: str  # Projection, Baumgarte or NoneType
    is_explicit: bool  # whether the solver is explicit
    drops_rows: bool  # whether the method leaves out rows that are redundant by the analysis
    formulation: str

    @property
    def is_projected(self) -> bool:
        """True if states are projected."""
        return self.stabilization == "Projection"

    @cached_property
    def rows(self) -> PositionRows:
        """The rows of the mechanism, which evaluate Psi and D at positions."""
        return kinematic_rows(self.mechanism)

    @property
    def row_scales(self) -> np.ndarray:
        """The scale of each row of Psi."""
        return np.asarray(self.rows.scales.rows, float)

    @cached_property
    def states(self) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """The usable states (t, q, v), latest first: the last one of the integrator, then the outputs before the failure."""
        finite = np.isfinite(self.q).all(1) & np.isfinite(self.v).all(1)
        good = [k for k in range(len(self.ts)) if finite[k] and (self.ts[k] < self.time or not self._has_drifted(k))]
        listed = [(float(self.ts[k]), self.q[k], self.v[k]) for k in reversed(good)]
        if self.end is None or self.result == Result.drift or not all(np.all(np.isfinite(x)) for x in self.end):
            return listed
        return [self.end, *listed]

    def _has_drifted(self, k: int) -> bool:
        """Return True if the run ended by drift, and output k is later than its end or violates Psi by more than `drift_tol`."""
        if self.result != Result.drift or self.ts[k] > self.time:
            return self.result == Result.drift
        return not np.max(np.abs(self.psi(self.ts[k], self.q[k])) / self.row_scales, initial=0.0) <= self.drift_tol

    def psi(self, t: float, q: np.ndarray) -> np.ndarray:
        """Return Psi (m,), in m or rad."""
        return self.rows.at(t, q)[0]

    def psi_dot(self, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return Psi_dot (m,), in m/s or rad/s."""
        return np.asarray(constraints.psi_dot(self.mechanism.without_origin, t, q, v))

    def decomposed(self, t: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the left singular vectors and the singular values of D with rows of length one; NaN if D is not finite."""
        D = self.rows.dense(self.rows.at(t, q)[2])
        return np.linalg.svd(D, full_matrices=False)[:2] if np.all(np.isfinite(D)) else (D, np.full(len(D), np.nan))

    def mobility(self, t: float, q: np.ndarray) -> np.ndarray | None:
        """Return the projection (n, n) onto the motions that the constraints allow, in the mass metric; None for a D with NaN."""
        D = self.rows.dense(self.rows.at(t, q)[2]) if self.rows.count else np.zeros((0, len(q)))
        if not np.all(np.isfinite(D)):
            return None
        mass = np.ravel([[b.mass, b.mass, b.inertia] for b in self.mechanism.bodies.values()]).astype(float)
        D = D / self.rows.metric / np.sqrt(mass / mass.max())
        _, sigma, right = np.linalg.svd(D / np.linalg.norm(D, axis=1, keepdims=True), full_matrices=False)
        span = right[: self.analysis.rank] if self.analysis.rank is not None else right[sigma > 0]
        return np.eye(len(q)) - span.T @ span

    def open_rows(self, t: float, q: np.ndarray) -> str:
        """Name the open constraints at a position, the largest residual first, each with its residual (m, rad)."""
        return name_open_rows([name for name, _ in self.rows.names], self.psi(t, q), self.row_scales, self.drift_tol)
