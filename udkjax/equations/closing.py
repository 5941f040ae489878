"""Closing a mechanism by damped Gauss-Newton steps in the mass metric, on either array library.

Numbers that are known are closed by NumPy, on the graph's programs: nothing is compiled for it. Numbers that are traced take the
same steps in JAX (assembly.py).
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.equations.code import code, scalars
from udkjax.equations.programs import rank_tolerance
from udkjax.scene.mechanism import Mechanism

STRIDE = 0.3  # rad and m: the longest change of a coordinate in one Gauss-Newton step
ITERATIONS = 40
HALVINGS = 12


def direction(equations: Any, t: Any, q: Any) -> Any:
    """-M^(-1/2) D^+ Psi."""
    plus, psi, root = equations.linearized("closure", t, q, q)
    return -root * (plus @ psi)


def limited(step: Any, xp: Any) -> Any:
    """The step, shortened so that no coordinate changes by more than `STRIDE`."""
    longest = xp.max(xp.abs(step))
    return step * xp.where(longest > STRIDE, STRIDE / xp.where(longest > STRIDE, longest, 1.0), 1.0)


def assembled(equations: Any, closed: Any, t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Return q, v, Psi, Psi_dot and the rank of D, with q closed by `closed` and v by projection."""
    rank = 0
    if equations.constrained:
        q = closed(equations, t, q)
        for _ in range(2):  # the second removes the rounding errors of the first
            plus, residual, root = equations.linearized("rate", t, q, v)
            v, rank = v - root * (plus @ residual), plus.rank
    return q, v, *equations.violation(t, q, v), rank


def closed_by_numpy(equations: "Known", t: float, q: np.ndarray) -> np.ndarray:
    """Steps, each halved until the residual falls, until none makes it smaller."""
    for _ in range(ITERATIONS):
        step, size = limited(direction(equations, t, q), np), equations.size(t, q)
        trials = (q + 0.5**k * step for k in range(HALVINGS))
        q, ahead = next((x for x in trials if equations.size(t, x) < size), q), q
        if q is ahead:
            break
    return q


@np.errstate(all="ignore")  # what is not finite does not close
def assembled_by_numpy(mechanism: Mechanism, t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
    """As `assembled`, of a mechanism whose numbers are known."""
    q, v = (np.asarray(x, float).ravel() for x in (q, v))
    return assembled(Known(mechanism), closed_by_numpy, float(t), q, v)


@np.errstate(all="ignore")
def assembled_by_scipy(mechanism: Mechanism, t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
    """As `assembled_by_numpy`, of a large mechanism: by sparse arithmetic, damped instead of truncated."""
    from udkjax.equations.sparse_rows import SparseRows

    return SparseRows(mechanism).assembled(float(t), np.asarray(q, float).ravel(), np.asarray(v, float).ravel())


class Known:
    """What closing asks of the equations of motion, for a mechanism with known numbers: evaluated on floats."""

    def __init__(self, mechanism: Mechanism):
        self._code = code(mechanism, (), False, None)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(mechanism)]
        self._constants = self._code.prologue([*map(float, scalars(leaves)), 0.0])
        self._tol = float(rank_tolerance(mechanism))
        self.constrained = bool(self._code.pattern.shape[0])

    def _run(self, name: str, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array(self._code.program(name)([*self._constants, t, *q.tolist(), *v.tolist()]), float)

    def violation(self, t: float, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Psi and Psi_dot."""
        return self._run("psi", t, q, v), self._run("psi_dot", t, q, v)

    def size(self, t: float, q: np.ndarray) -> float:
        """The length of Psi."""
        return float(np.linalg.norm(self._run("psi", t, q, q)))

    def linearized(self, name: str, t: float, q: np.ndarray, v: np.ndarray) -> tuple["Truncated", np.ndarray, np.ndarray]:
        """D^+, the residual of the program `name`, and M^(-1/2)."""
        slots, rows = self._code.pattern.slots, self._code.pattern.shape[0]
        values, residual, root = np.split(self._run(name, t, q, v), [slots, slots + rows])
        return Truncated.of(self._code.pattern.dense(values, np), self._tol), residual, root


class Truncated(NamedTuple):
    """D^+ = V S^+ U^T, as `pinv.SVD` has it."""

    u: np.ndarray
    inverse: np.ndarray
    vt: np.ndarray
    rank: int

    @classmethod
    def of(cls, D: np.ndarray, tol: float) -> "Truncated":
        if not np.all(np.isfinite(D)):  # of which NumPy refuses a decomposition
            D = np.zeros_like(D)
            tol = np.nan
        u, sigma, vt = np.linalg.svd(D, full_matrices=False)
        kept = ~(sigma <= tol * sigma[0])
        return cls(u, np.where(kept, 1 / np.where(kept, sigma, 1.0), 0.0) + 0.0 * tol, vt, int(kept.sum()))

    def __matmul__(self, b: np.ndarray) -> np.ndarray:
        return self.vt.T @ (self.inverse * (self.u.T @ b))
