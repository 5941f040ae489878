"""Noise of a series of measurements: standard deviation before a fit, outliers, and a test of residuals for whiteness."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc, ndtri

NOISE_FLOOR = 1e-6  # least noise of measurements, relative to the scale of their channel; records may fit exactly
GAUSSIAN_RATIO = 1.4826  # ratio of standard deviation to median absolute value of Gaussian noise
MOST_TOGETHER = 5  # largest number of consecutive outliers; longer series are not errors of a sensor
SIGNIFICANCE = 1e-3  # p-value below which residuals are reported as not white
MAX_LAGS = 5  # residuals of an incomplete model have slow waves, which the first lags detect
PAIRS_PER_LAG = 4  # least number of pairs for the test, per lag
NO_GAP = 1.5  # pairs farther apart than this, relative to the usual duration of k samples, have a gap between them


def noise_of_differences(times: Float[np.ndarray, "N"], values: Float[np.ndarray, "N"]) -> float:
    """Estimate the standard deviation of the noise from the distances between values and the lines through their neighbours.

    The median of these distances, scaled to unit noise, is insensitive to outliers. The signal should be nearly straight between
    samples, since its curvature counts as noise. The estimate is NaN if there are fewer than three values.

    Source: T. Gasser, L. Sroka & C. Jennen-Steinmetz, Residual variance and residual pattern in nonlinear regression, 1986.
    """
    present = np.isfinite(values)
    t, y = np.asarray(times, float)[present], np.asarray(values, float)[present]
    if len(t) < 3:
        return np.nan
    fraction = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    distance = (1.0 - fraction) * y[:-2] + fraction * y[2:] - y[1:-1]
    return robust_deviation(distance / np.sqrt(fraction**2 + (1.0 - fraction) ** 2 + 1.0))


def robust_deviation(values: Float[np.ndarray, "N"]) -> float:
    """Return the standard deviation of Gaussian noise with the same median absolute value, which is insensitive to outliers."""
    return float(GAUSSIAN_RATIO * np.median(np.abs(values)))


def outlier_rows(values: Float[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    """Return a mask of the values that are too large to be noise; one of a thousand series of Gaussian noise has such values.

    More than `MOST_TOGETHER` such values in succession are not outliers, but part of the signal.
    """
    limit = ndtri(1.0 - 0.5 * SIGNIFICANCE / max(len(values), 1)) * robust_deviation(values) if len(values) else np.inf
    mask = np.abs(values) > limit if limit > 0.0 else np.zeros(len(values), bool)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    for first, end in ends.reshape(-1, 2).tolist():
        mask[first:end] &= end - first <= MOST_TOGETHER
    return mask


class Whiteness(NamedTuple):
    """Test of a channel's residuals for white noise."""

    lag1: float  # correlation of neighbouring residuals
    statistic: float  # Q
    lags: int
    p: float  # probability of an equal or larger Q for white noise; NaN if there are too few residuals
    samples: int

    @property
    def white(self) -> bool:
        """True if the residuals are consistent with white noise."""
        return not self.p < SIGNIFICANCE

    def text(self, channel: str) -> str:
        """Return a sentence about residuals that are not white; "" if they are."""
        if self.white:
            return ""
        return (
            f"residuals of {channel} are not white noise: neighbours have a correlation of {self.lag1:.2f} (p = {self.p:.1g}, "
            f"{self.samples} samples); the model omits something, or the noise is coloured, and standard errors are too small"
        )


def whiteness_of(
    times: Float[np.ndarray, "N"], residuals: Float[np.ndarray, "N"], hat: Float[np.ndarray, "L N"] | None = None
) -> Whiteness:
    """Test the residuals of one channel of one record for correlation in time.

    For lags k = 1, 2, ... and residuals e, over pairs of samples without a gap between them,

        z_k = sum (e_i e_(i+k) + s^2 H_(i, i+k)) / (sum e_i^2 e_(i+k)^2)^(1/2),        Q = sum z_k^2,

    For white noise of any variances and spacing, Q is chi^2-distributed with one degree of freedom per lag. H = U U^T is the hat
    matrix of the fit; off the diagonal, -s^2 H is the covariance of the residuals that a fit to white noise causes.

    Args:
        times: increasing, s; samples may be irregular and have gaps.
        residuals: residuals; NaN where nothing was measured.
        hat: the `hat_bands` of those residuals that are not NaN, N entries or fewer; by default there was no fit.

    Source: Lobato, Nankervis & Savin, International Economic Review 42 (2001) 187.
    """
    present = np.isfinite(residuals)
    t, e = np.asarray(times, float)[present], np.asarray(residuals, float)[present]
    H = np.zeros((MAX_LAGS + 1, len(e))) if hat is None else hat
    left = len(e) - float(np.sum(H[0]))
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
        expected = -variance * np.sum(H[k, pairs])
        z.append((products.sum() - expected) / np.sqrt(np.sum(products**2)))
        if k == 1:
            lag1 = float(products.sum() / np.sqrt(np.sum(e[pairs] ** 2) * np.sum(e[pairs + 1] ** 2)))
    if not z:
        return Whiteness(lag1, np.nan, 0, np.nan, len(e))
    Q = float(np.sum(np.square(z)))
    return Whiteness(lag1, Q, len(z), float(chdtrc(len(z), Q)), len(e))


class HatBands:
    """The diagonal and the first upper diagonals of H = U U^T, from rows of U that come in sequence.

    `values[k, i]`, of shape (1 + MAX_LAGS, N), is H_(i, i+k); it is zero if there is no row i + k.
    """

    def __init__(self, count: int, columns: int):
        """Prepare for `count` rows of U, which has D = `columns` columns."""
        self.values = np.zeros((MAX_LAGS + 1, count))
        self._latest, self._next = np.zeros((0, columns)), 0  # the latest rows, and the index of the next

    def add(self, U: Float[np.ndarray, "n D"]) -> None:
        """Add the next n rows of U."""
        rows, before = np.concatenate([self._latest, U]), len(self._latest)
        first, self._next = self._next - before, self._next + len(U)
        for k in range(min(MAX_LAGS + 1, len(rows))):
            begin = max(before - k, 0)
            products = np.einsum("ij,ij->i", rows[begin : len(rows) - k], rows[begin + k :])
            self.values[k, first + begin : first + len(rows) - k] = products
        self._latest = rows[-MAX_LAGS:]
