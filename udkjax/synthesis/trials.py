"""Batches of trials of a design, their residuals, and their turns."""

from typing import NamedTuple

import numpy as np


class Trials(NamedTuple):
    """M trials: unknowns x (M, P), and at each position of the goal the driver's value s (M, J) and coordinates q (M, J, n)."""

    x: np.ndarray
    s: np.ndarray
    q: np.ndarray

    def take(self, which: np.ndarray) -> "Trials":
        """Return the trials that `which`, a mask or indices, selects."""
        return Trials(*(a[which] for a in self))


class TrialResiduals(NamedTuple):
    """Residuals of M trials with their derivatives.

    Attributes:
        q: positions (M, J, n).
        r: residuals (M, J, G).
        by_value: derivatives of r with respect to s (M, J, G).
        by_unknowns: derivatives of r with respect to x (M, J, G, P).
        terms: residuals of motion goals (M, T).
        terms_by_unknowns: derivatives of terms with respect to x (M, T, P).
        transmission: transmission at each position (M, J), with the sign of the branch.
        limits: rows (M, K) that must not exceed zero, in the unit of residuals.
        limits_by_unknowns: derivatives of limits with respect to x (M, K, P).
        rest: parts of the losses that are not squares of residuals (M,).
        exists: whether all positions of a trial exist (M,).
    """

    q: np.ndarray
    r: np.ndarray
    by_value: np.ndarray
    by_unknowns: np.ndarray
    terms: np.ndarray
    terms_by_unknowns: np.ndarray
    transmission: np.ndarray
    limits: np.ndarray
    limits_by_unknowns: np.ndarray
    rest: np.ndarray
    exists: np.ndarray

    def take(self, which: np.ndarray) -> "TrialResiduals":
        """Return the trials that `which`, a mask or indices, selects."""
        return TrialResiduals(*(a[which] for a in self))


class Turn(NamedTuple):
    """A turn of the driver of M trials at K values.

    Attributes:
        s: the driver's values (M, K).
        measures: measures of the goal (M, K, G).
        q: positions (M, K, n).
        transmission: the transmission (M, K), with the sign of the branch.
        reached: whether each value is reached (M, K).
    """

    s: np.ndarray
    measures: np.ndarray
    q: np.ndarray
    transmission: np.ndarray
    reached: np.ndarray
