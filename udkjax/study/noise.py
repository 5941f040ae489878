"""The noise of a series of measurements: as it is seen before anything is fitted, and what is no noise."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from udkjax.study.whiteness import SIGNIFICANCE

GAUSSIAN_RATIO = 1.4826  # standard deviation over median of absolute values, of Gaussian noise
MOST_TOGETHER = 5  # wrong numbers one after another: more are no slips of a sensor


def noise_of_differences(times: Float[np.ndarray, "N"], values: Float[np.ndarray, "N"]) -> float:
    """Estimate the standard deviation of the noise from how far each value is from the line through its neighbours.

    The median of these distances, over what each would be for unit noise, is not moved by single wrong numbers. Between samples
    the signal should be nearly straight: its curvature is taken for noise, too. Not a number where there are less than three.

    Source: T. Gasser, L. Sroka & C. Jennen-Steinmetz, Residual variance and residual pattern in nonlinear regression, 1986.
    """
    there = np.isfinite(values)
    t, y = np.asarray(times, float)[there], np.asarray(values, float)[there]
    if len(t) < 3:
        return np.nan
    part = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    distance = (1.0 - part) * y[:-2] + part * y[2:] - y[1:-1]
    return robust_deviation(distance / np.sqrt(part**2 + (1.0 - part) ** 2 + 1.0))


def robust_deviation(values: Float[np.ndarray, "N"]) -> float:
    """Return the standard deviation of Gaussian noise whose absolute values have the median of these: outliers do not move it."""
    return float(GAUSSIAN_RATIO * np.median(np.abs(values)))


def outlier_rows(values: Float[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    """Return which numbers are too large to be noise like the others: Gaussian noise has one in a thousand such series.

    More than `MOST_TOGETHER` in a row are none: there the signal is another one.
    """
    limit = ndtri(1.0 - 0.5 * SIGNIFICANCE / max(len(values), 1)) * robust_deviation(values) if len(values) else np.inf
    found = np.abs(values) > limit if limit > 0.0 else np.zeros(len(values), bool)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], found, [False]])))
    for first, end in ends.reshape(-1, 2).tolist():
        found[first:end] &= end - first <= MOST_TOGETHER
    return found
