"""The one loop that closes a mechanism: damped Gauss-Newton steps, on either array library and with either linear solver.

    q <- q - s W D^+ Psi,        D = Psi_q W,

with W the metric (M^(-1/2) in assembly), D^+ truncated for small scenes and damped for large, sparse ones. s limits the length of
a step, so that the branch of the guess is kept, and is halved until the residual falls: no step makes a state worse. Numbers that
are known are closed by NumPy: nothing is compiled for it. Numbers that are traced take the same steps in JAX.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.equations.scalar_programs import scene_programs
from udkjax.equations.scales import Scales, rank_tolerance
from udkjax.equations.structure import leaves_as_scalars
from udkjax.expressions import Program
from udkjax.scene.mechanism import Mechanism

# Of the scene's scales: what counts as closed. Rounding leaves 1e-15; a scene that cannot be closed leaves what its lengths are
# wrong by.
CLOSED = 1e-9
ROUNDING = 32.0  # units of rounding of the coordinates: a residual below is not worth a step
STRIDE = 0.3  # rad, and of the characteristic length: the longest change of a coordinate in one step
ITERATIONS = 40
HALVINGS = 12


class Rows(Protocol):
    """What closing asks of the rows of Psi."""

    @property
    def scales(self) -> Scales:
        """The scene's."""
        ...

    def residual(self, t: Any, q: Any) -> Any:
        """Psi, each row over its scale."""
        ...

    def correction(self, t: Any, q: Any) -> Any:
        """-W D^+ Psi."""
        ...


def rounding(scales: Scales, q: Any, xp: Any) -> Any:
    """What rounding errors of the coordinates leave of a residual."""
    return ROUNDING * float(jnp.finfo(q.dtype).eps) * xp.maximum(1.0, scales.size(q, xp))


def is_closed(scales: Scales, q: Any, v: Any, psi: Any, psi_dot: Any, xp: Any) -> Any:
    """Whether what is left of Psi and Psi_dot is within `CLOSED` of the scene's scales, or rounding."""
    open_by = xp.maximum(CLOSED, rounding(scales, q, xp))
    rate = xp.maximum(scales.rate, scales.size(v, xp))
    return (scales.violation(psi, xp) <= open_by) & (scales.violation(psi_dot, xp) <= open_by * rate)


def limited_step(rows: Rows, t: Any, q: Any, xp: Any) -> Any:
    """A Gauss-Newton step, shortened so that no coordinate changes by more than `STRIDE`."""
    step = rows.correction(t, q)
    longest = rows.scales.size(step, xp)
    return step * xp.where(longest > STRIDE, STRIDE / xp.where(longest > STRIDE, longest, 1.0), 1.0)


def _python_loop(condition: Callable[[Any], Any], body: Callable[[Any], Any], state: Any) -> Any:
    while condition(state):
        state = body(state)
    return state


def damped_step(rows: Rows, t: Any, q: Any, xp: Any = jnp) -> tuple[Any, Any]:
    """One step, halved until the residual falls, and whether it does; no step where the residual is rounding."""
    loop, stop = (_python_loop, lambda x: x) if xp is np else (jax.lax.while_loop, jax.lax.stop_gradient)
    step = limited_step(rows, t, q, xp)
    fixed, here, ahead = stop((rows, q, step))
    size = xp.linalg.norm(fixed.residual(t, here))

    def worse(trial: Any) -> Any:
        scale, k = trial
        return (k < HALVINGS) & ~(xp.linalg.norm(fixed.residual(t, here + scale * ahead)) < size)

    scale, k = loop(worse, lambda trial: (0.5 * trial[0], trial[1] + 1), (xp.ones(()), 0))
    better = (k < HALVINGS) & (size > rounding(rows.scales, here, xp))
    return xp.where(better, q + scale * step, q), better


def close_position(rows: Rows, t: Any, q: Any, xp: Any = jnp) -> Any:
    """Steps until the residual is rounding, or none makes it smaller."""
    loop = _python_loop if xp is np else jax.lax.while_loop

    def unfinished(state: Any) -> Any:
        _, better, k = state
        return better & (k < ITERATIONS)

    return loop(unfinished, lambda state: (*damped_step(rows, t, state[0], xp), state[2] + 1), (q, xp.asarray(True), 0))[0]


class Truncated(NamedTuple):
    """D^+ = V S^+ U^T by NumPy, as `pinv.SVD` has it."""

    u: np.ndarray
    inverse: np.ndarray
    vt: np.ndarray
    rank: int

    @classmethod
    def of(cls, D: np.ndarray, tol: float) -> "Truncated":
        """The pseudoinverse of a matrix; of one that is not finite, not a number."""
        if not np.all(np.isfinite(D)):  # of which NumPy refuses a decomposition
            D, tol = np.zeros_like(D), np.nan
        u, sigma, vt = np.linalg.svd(D, full_matrices=False)
        kept = ~(sigma <= tol * sigma[0])
        return cls(u, np.where(kept, 1 / np.where(kept, sigma, 1.0), 0.0) + 0.0 * tol, vt, int(kept.sum()))

    def __matmul__(self, b: np.ndarray) -> np.ndarray:
        return self.vt.T @ (self.inverse * (self.u.T @ b))


class DenseRows:
    """The rows of a mechanism with known numbers, evaluated by NumPy on the scene's programs. The metric is M^(-1/2)."""

    def __init__(self, mechanism: Mechanism, scales: Scales):
        self.scales = jax.tree.map(np.asarray, scales)
        self._programs = scene_programs(mechanism)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(mechanism)]
        self._constants = self._programs.prologue([*map(float, leaves_as_scalars(leaves)), 0.0, 0.0])
        self.count, self.size = self._programs.pattern.shape
        self.names = self._programs.equations.row_names
        self.root = self._run(self._programs.closure_terms, 0.0, np.zeros(self.size), np.zeros(self.size))[-self.size :]
        self.metric, self._tol = self.root, float(rank_tolerance(mechanism))

    def _run(self, program: Program, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array(program([*self._constants, t, *q.tolist(), *v.tolist()]), float)

    def violation(self, t: float, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Psi and Psi_dot."""
        return self._run(self._programs.psi, t, q, v), self._run(self._programs.psi_dot, t, q, v)

    def residual(self, t: float, q: np.ndarray) -> np.ndarray:
        return self._run(self._programs.psi, t, q, q) / self.scales.rows

    def jacobian(self, t: float, q: np.ndarray) -> np.ndarray:
        """Psi_q (m, n)."""
        values = self._run(self._programs.closure_terms, t, q, q)[: self._programs.pattern.slots]
        return self._programs.pattern.dense(values, np) / self.root

    def plus(self, t: float, q: np.ndarray) -> Truncated:
        """D^+ of weighted rows in the metric."""
        return Truncated.of(self.scales.weights[:, None] * self.jacobian(t, q) * self.metric, self._tol)

    def correction(self, t: float, q: np.ndarray) -> np.ndarray:
        return -self.metric * (self.plus(t, q) @ (self.scales.weights * self._run(self._programs.psi, t, q, q)))

    def assembled(self, t: float, q: np.ndarray, v: np.ndarray) -> tuple[Any, Any, Any, Any, int]:
        """Return q closed, v as the constraints allow it, what is left of Psi and Psi_dot, and the rank of D."""
        if not self.count:
            return q, v, *self.violation(t, q, v), 0
        q = close_position(self, t, q, np)
        plus = self.plus(t, q)
        for _ in range(2):  # the second removes the rounding errors of the first
            v = v - self.metric * (plus @ (self.scales.weights * self._run(self._programs.psi_dot, t, q, v)))
        return q, v, *self.violation(t, q, v), plus.rank


class TracedRows(NamedTuple):
    """The rows of the equations of motion of a mechanism with traced numbers."""

    equations: Any

    @property
    def scales(self) -> Scales:
        return self.equations.scales

    def residual(self, t: Any, q: Any) -> Any:
        return self.equations.violation(t, q, q)[0] / self.scales.rows

    def correction(self, t: Any, q: Any) -> Any:
        plus, psi, root = self.equations.linearized_position(t, q)
        return -root * (plus @ psi)

    def assembled(self, close: Callable[[Any, Any, Any], Any], t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Return q closed by `close`, v as the constraints allow it, what is left of Psi and Psi_dot, and the rank of D."""
        if not self.equations.constrained:
            return q, v, *self.equations.violation(t, q, v), 0
        q, rank = close(self, t, q), 0
        for _ in range(2):  # the second removes the rounding errors of the first
            plus, residual, root = self.equations.linearized_velocity(t, q, v)
            v, rank = v - root * (plus @ residual), plus.rank
        return q, v, *self.equations.violation(t, q, v), rank
