"""The noise of a series of measurements, as it is seen before anything is fitted."""

import numpy as np
from jaxtyping import Float

GAUSSIAN = 1.4826  # standard deviation over median of absolute values, of Gaussian noise


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
    return float(GAUSSIAN * np.median(np.abs(values)))
