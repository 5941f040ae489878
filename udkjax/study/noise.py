"""The noise of a series of measurements: its size before a fit, what is no noise, and whether residuals are white."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc, ndtri

GAUSSIAN_RATIO = 1.4826  # standard deviation over median of absolute values, of Gaussian noise
MOST_TOGETHER = 5  # wrong numbers one after another: more are no slips of a sensor
SIGNIFICANCE = 1e-3  # probability of what was seen if noise is white: below it, it is said not to be so
MAX_LAGS = 5  # at most; a model that lacks something leaves long waves, which show at the first of them
PAIRS_PER_LAG = 4  # at least: with fewer there is nothing to be said
NO_GAP = 1.5  # times the usual distance in time of k samples: pairs farther apart have a gap between them


def noise_of_differences(times: Float[np.ndarray, "N"], values: Float[np.ndarray, "N"]) -> float:
    """Estimate the standard deviation of the noise from how far each value is from the line through its neighbours.

    The median of these distances, over what each would be for unit noise, is not moved by single wrong numbers. Between samples
    the signal should be nearly straight: its curvature is taken for noise, too. Not a number where there are less than three.

    Source: T. Gasser, L. Sroka & C. Jennen-Steinmetz, Residual variance and residual pattern in nonlinear regression, 1986.
    """
    present = np.isfinite(values)
    t, y = np.asarray(times, float)[present], np.asarray(values, float)[present]
    if len(t) < 3:
        return np.nan
    part = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    distance = (1.0 - part) * y[:-2] + part * y[2:] - y[1:-1]
    return robust_deviation(distance / np.sqrt(part**2 + (1.0 - part) ** 2 + 1.0))


def robust_deviation(values: Float[np.ndarray, "N"]) -> float:
    """Return the standard deviation of Gaussian noise whose absolute values have the median of these: outliers do not move it."""
    return float(GAUSSIAN_RATIO * np.median(np.abs(values)))


def outlier_rows(values: Float[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    """Return a mask of numbers that are too large to be noise like the others: Gaussian noise has one in a thousand such series.

    More than `MOST_TOGETHER` in a row are none: there the signal is another one.
    """
    limit = ndtri(1.0 - 0.5 * SIGNIFICANCE / max(len(values), 1)) * robust_deviation(values) if len(values) else np.inf
    found = np.abs(values) > limit if limit > 0.0 else np.zeros(len(values), bool)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], found, [False]])))
    for first, end in ends.reshape(-1, 2).tolist():
        found[first:end] &= end - first <= MOST_TOGETHER
    return found


class Whiteness(NamedTuple):
    """Test of a channel's residuals for white noise."""

    lag1: float  # correlation of neighbours
    statistic: float  # Q
    lags: int
    p: float  # probability that white noise has such a Q; not a number where there are too few residuals
    samples: int

    @property
    def white(self) -> bool:
        """True if nothing speaks against white noise."""
        return not self.p < SIGNIFICANCE

    def text(self, channel: str) -> str:
        """Return a sentence about the residuals; nothing where they are white."""
        if self.white:
            return ""
        return (
            f"residuals of {channel} are not noise: neighbours have the correlation {self.lag1:.2f} (probability {self.p:.1g} "
            f"for {self.samples} samples of white noise): the model leaves something out, or the noise is "
            "coloured; standard errors are too small"
        )


def whiteness_of(
    times: Float[np.ndarray, "N"], residuals: Float[np.ndarray, "N"], projection: Float[np.ndarray, "N D"] | None = None
) -> Whiteness:
    """Test the residuals of one channel of one record for correlation in time.

    For lags k = 1, 2, ... and residuals e, over pairs of samples without a gap between them,

        z_k = sum (e_i e_(i+k) + s^2 H_(i, i+k)) / (sum e_i^2 e_(i+k)^2)^(1/2),        Q = sum z_k^2,

    which white noise makes chi^2 with as many degrees of freedom as there are lags, with whatever variances and spacing.
    H = U U^T is the hat matrix of the fit: -s^2 H is the covariance that fitting leaves in the residuals of white noise.

    Args:
        times: increasing, s; samples may be irregular and have gaps.
        residuals: not a number where nothing was measured.
        projection: the rows of U of these residuals; by default nothing was fitted.

    Source: Lobato, Nankervis & Savin, International Economic Review 42 (2001) 187.
    """
    present = np.isfinite(residuals)
    t, e = np.asarray(times, float)[present], np.asarray(residuals, float)[present]
    U = np.zeros((len(e), 0)) if projection is None else np.asarray(projection, float)[present]
    left = len(e) - float(np.sum(U**2))
    square = float(e @ e)
    if len(e) < 3 or left <= 0 or square == 0.0:
        return Whiteness(np.nan, np.nan, 0, np.nan, len(e))
    variance, usual = square / left, float(np.median(np.diff(t)))
    z, lag1 = [], np.nan
    for k in range(1, MAX_LAGS + 1):
        pairs = np.flatnonzero(t[k:] - t[:-k] <= NO_GAP * k * usual)
        if len(pairs) < PAIRS_PER_LAG * MAX_LAGS:
            break
        products = e[pairs] * e[pairs + k]
        expected = -variance * np.sum(U[pairs] * U[pairs + k])
        z.append((products.sum() - expected) / np.sqrt(np.sum(products**2)))
        if k == 1:
            lag1 = float(products.sum() / np.sqrt(np.sum(e[pairs] ** 2) * np.sum(e[pairs + 1] ** 2)))
    if not z:
        return Whiteness(lag1, np.nan, 0, np.nan, len(e))
    Q = float(np.sum(np.square(z)))
    return Whiteness(lag1, Q, len(z), float(chdtrc(len(z), Q)), len(e))
