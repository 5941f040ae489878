"""Levenberg-Marquardt steps of many trials, with the driver's values as further unknowns.

The value s_j of a position affects only its own residuals r_j(x, s_j). It is therefore eliminated: with a_j = dr_j/ds_j,

    (A - W^T H^-1 W) dx = -(b - W^T H^-1 g),    ds_j = -(g_j + w_j dx) / h_j,
    A = sum_j J_j^T J_j,  w_j = a_j^T J_j,  g_j = a_j^T r_j,  h_j = a_j^T a_j,

with a damping added to each diagonal. Limits add rows w max(0, c + u). Bounds are enforced by active sets: unknowns that would
leave their bounds are fixed.
"""

import numpy as np

from udkjax.arrays import solve_each
from udkjax.synthesis.design_problem import DesignProblem
from udkjax.synthesis.trials import TrialResiduals, Trials

LONGEST_MOVE = 0.5  # largest change of an unknown in one step, relative to its scale
ACTIVE_SETS = 5  # largest number of iterations to determine the active limits of a step
GAP_SHARE = 0.45  # largest change of a value in one step, relative to the gap to its neighbours; keeps values in order
REGULARIZATION = float(np.finfo(float).eps)  # regularization, relative to the largest diagonal entry


class StepEquations:
    """The linear least-squares problem of a step of M trials; `find` solves it, `correct` solves it for other residuals.

    Args:
        problem: the problem.
        trials: the trials.
        found: their residuals.
        multipliers: the multipliers u of limits (M, K).
        weight: the weight w of the limits of each trial (M,).
        damping: the damping of each trial (M,), relative to the diagonal.
    """

    def __init__(
        self,
        problem: DesignProblem,
        trials: Trials,
        found: TrialResiduals,
        multipliers: np.ndarray,
        weight: np.ndarray,
        damping: np.ndarray,
    ):
        self.problem, self.trials, self.found = problem, trials, found
        self.excess, self.weight, self.damping = found.limits + multipliers, weight, damping
        members, P = trials.x.shape
        J = found.by_unknowns.reshape(members, -1, P)
        self.A = J.transpose(0, 2, 1) @ J
        if found.terms.size:
            self.A += found.terms_by_unknowns.transpose(0, 2, 1) @ found.terms_by_unknowns
        self.diagonal = np.einsum("mpp->mp", self.A).copy()
        if problem.local:
            self.w = np.einsum("mjg,mjgp->mjp", found.by_value, found.by_unknowns)
            h = np.einsum("mjg,mjg->mj", found.by_value, found.by_value)
            self.h = h * (1.0 + damping[:, None]) + REGULARIZATION * problem.scale**2
            self.A = self.A - (self.w / self.h[..., None]).transpose(0, 2, 1) @ self.w

    def find(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the changes dx (M, P) of unknowns, limited in length, and ds (M, J) of the driver's values."""
        b, g = self._right_hand_side(self.found.r)
        b = b + (self.found.terms[:, None] @ self.found.terms_by_unknowns)[:, 0]
        members, P = b.shape
        slopes, low, high = self.found.limits_by_unknowns, self.trials.x <= self.problem.low, self.trials.x >= self.problem.high
        self.matrix, dx = np.empty((members, P, P)), np.empty((members, P))
        self.pressed, self.held = self.excess > 0, np.zeros((members, P), bool)
        self.size = self.diagonal.copy()
        which, places = np.arange(members), np.arange(P)
        for _ in range(ACTIVE_SETS):
            C, excess, pressed = slopes[which], self.excess[which], self.pressed[which]
            force = self.weight[which, None] ** 2 * pressed
            matrix = self.A[which] + C.transpose(0, 2, 1) @ (force[..., None] * C)
            gradient = b[which] + ((force * excess)[:, None] @ C)[:, 0]
            size = self.diagonal[which] + (force[:, None] @ C**2)[:, 0]
            steepest = np.max(size, axis=1, keepdims=True)
            matrix[:, places, places] += self.damping[which, None] * size + REGULARIZATION * (steepest + (steepest == 0))
            held = (low[which] & (gradient > 0)) | (high[which] & (gradient < 0))
            matrix = _held_out(matrix, held)
            change = -solve_each(matrix, np.where(held, 0.0, gradient))
            self.matrix[which], self.size[which], self.held[which], dx[which] = matrix, size, held, change
            now = excess + (C @ change[..., None])[..., 0] > 0
            changed = (now != pressed).any(1)
            which = which[changed]
            if not len(which):
                break
            self.pressed[which] = now[changed]
        longest = np.max(np.abs(dx[:, : self.problem.free.count]), axis=1, initial=0.0)
        dx *= np.minimum(1.0, LONGEST_MOVE * self.problem.reach / np.maximum(longest, 1e-300))[:, None]
        return dx, self._values(dx, g)

    def correct(self, r: np.ndarray, limits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the changes dx and ds that reduce other residuals r (M, J, G) and limits (M, K), with the matrices of `find`."""
        b, g = self._right_hand_side(r)
        force = self.weight[:, None] ** 2 * self.pressed * limits
        gradient = b + (force[:, None] @ self.found.limits_by_unknowns)[:, 0]
        dx = -solve_each(self.matrix, np.where(self.held, 0.0, gradient))
        return dx, self._values(dx, g)

    def length(self, dx: np.ndarray) -> np.ndarray:
        """Return the length (M,) of changes dx of unknowns, in the unit of residuals."""
        return np.sqrt(np.sum(self.size * dx**2, axis=1))

    def _right_hand_side(self, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        members, P = self.trials.x.shape
        b = (r.reshape(members, 1, -1) @ self.found.by_unknowns.reshape(members, -1, P))[:, 0]
        if not self.problem.local:
            return b, np.zeros_like(self.trials.s)
        g = np.einsum("mjg,mjg->mj", self.found.by_value, r)
        return b - ((g / self.h)[:, None] @ self.w)[:, 0], g

    def _values(self, dx: np.ndarray, g: np.ndarray) -> np.ndarray:
        if not self.problem.local:
            return np.zeros_like(self.trials.s)
        return -(g + (self.w @ dx[..., None])[..., 0]) / self.h


def _held_out(matrix: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return matrices (M, P, P) in which rows and columns of unknowns with `held` (M, P) are those of the unit matrix."""
    if not held.any():
        return matrix
    matrix = np.where(held[:, :, None] | held[:, None, :], 0.0, matrix)
    np.einsum("mpp->mp", matrix)[...] += held
    return matrix


def in_order(problem: DesignProblem, ds: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return changes of the driver's values s, shortened to preserve the cyclic order of values over the period.

    For a closed curve, the first and the last value may coincide.
    """
    if not problem.local:
        return ds
    gap = np.abs(np.diff(s, axis=1))
    period = np.inf if problem.is_closed else problem.period
    last = np.maximum(period - np.abs(s[:, -1:] - s[:, :1]), 0.0)
    gap = np.concatenate([gap, last], 1)
    longest = GAP_SHARE * np.minimum(gap, np.roll(gap, 1, axis=1))
    return np.clip(ds, -longest, longest)
