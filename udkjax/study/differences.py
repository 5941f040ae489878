"""Finite differences of motions with respect to parameters, and their errors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

STEP_RATIO = 4.0  # ratio of successive steps of differences
DIFFERENCE_STEPS = 0.1 * STEP_RATIO ** -np.arange(10.0)  # changes of dimensionless unknowns, from 0.1 to 4e-7
ERROR_RATIO = STEP_RATIO**2  # ratio of the errors of successive steps, which are of second order
NEXT_STEPS = 2  # number of smaller steps to compare a step with; a single one may agree by chance
LEAST_CHANGE = 1e-2  # a step is small if values change by less than this, relative to their size
TOO_LARGE = 0.5  # a step is too large if smaller steps disagree by more than this, relative to the difference


class Differences(NamedTuple):
    """Differences R(h) at all steps except the last two, in S series, as root mean squares over each; NaN where unknown."""

    steps: Float[np.ndarray, "H"]
    size: Float[np.ndarray, "H S"]
    noise: Float[np.ndarray, "H S"]  # errors of the differences, as `DifferenceSums` explains
    truncation: Float[np.ndarray, "H S"]
    largest: Float[np.ndarray, "S"]  # largest root mean square of the values
    discrepancy: Float[np.ndarray, "H S"]  # root mean square of the differences minus the derivative
    derivative_size: Float[np.ndarray, "S"]
    worst: Float[np.ndarray, "H S 3"]  # the row with the largest discrepancy, and the derivative and the difference there


class DifferenceSums:
    """Central differences, extrapolated to fourth order, and their errors as root mean squares over each series.

        D(h) = (y(h) - y(-h)) / 2h,      R(h) = (16 D(h/4) - D(h)) / 15

    Values are added in blocks of rows, of which only sums of squares are kept: memory does not grow with the records.

    Two errors are estimated, without a derivative to compare with:

        noise        |e(h) - e(-h)| / 2h, from the integration error e. Unlike rounding, e jumps where the step controller takes
                     other steps, and changes smoothly with the parameters in between; differences therefore converge to a
                     wrong value as h decreases. For this reason e is measured at each step, by the same run at another
                     tolerance, and not estimated from the roughness of y (as by J. J. More and S. M. Wild, Estimating
                     computational noise, 2011).
        truncation   ~ h^4: the disagreement with smaller steps beyond the errors of these steps; where these errors are larger,
                     it is extrapolated from larger steps. Steps with a large relative truncation error are discarded.

    Args:
        count: the number of series.
        steps: steps, each smaller than the previous one by the factor `STEP_RATIO`.

    Source: L. F. Richardson, The approximate arithmetical solution by finite differences of physical problems, 1911.
    """

    def __init__(self, count: int, steps: np.ndarray = DIFFERENCE_STEPS):
        H, self._steps, self._rows = len(steps), steps, np.zeros(count)
        self._values, self._jumps, self._pairs = (np.zeros((*shape, count)) for shape in ((H, 2), (H,), (H - 1, H - 1)))
        self._derivative, self._off = np.zeros(count), np.zeros((H - 1, count))
        self._worst = np.zeros((H - 1, count, 3))
        self._farthest = np.full((H - 1, count), -1.0)

    def add(
        self,
        y: Float[np.ndarray, "L 2 R"],
        errors: Float[np.ndarray, "L 2 R"],
        series: Int[np.ndarray, "R"],
        derivative: Float[np.ndarray, "R"] | None = None,
        rows: Int[np.ndarray, "R"] | None = None,
    ) -> None:
        """Add R rows of values at L steps.

        Args:
            y: values at +-steps; NaN where a run has failed, which excludes its step.
            errors: integration errors of y.
            series: the series of each row.
            derivative: the derivative to compare with; by default zero.
            rows: numbers of the rows; by default from zero.
        """

        def squares(x: np.ndarray) -> np.ndarray:
            return np.bincount(series, x * x, len(self._rows))

        if not len(series):
            return
        derivative = np.zeros(len(series)) if derivative is None else derivative
        rows = np.arange(len(series)) if rows is None else rows
        D = (y[:, 0] - y[:, 1]) / (2 * self._steps[:, None])
        R = (ERROR_RATIO * D[1:] - D[:-1]) / (ERROR_RATIO - 1)
        members = {s: np.flatnonzero(series == s) for s in np.unique(series).tolist()}
        self._rows += np.bincount(series, minlength=len(self._rows))
        self._derivative += squares(derivative)
        for k, sides in enumerate(y):
            self._values[k] += [squares(side) for side in sides]
            self._jumps[k] += squares(errors[k, 0] - errors[k, 1])
        for k, values in enumerate(R):
            self._pairs[k, k] += squares(values)
            for j in range(k + 1, len(R)):
                self._pairs[k, j] += squares(values - R[j])
            off = values - derivative
            self._off[k] += squares(off)
            distance = np.nan_to_num(np.abs(off), nan=np.inf)
            for s, places in members.items():
                worst = places[np.argmax(distance[places])]
                if distance[worst] > self._farthest[k, s]:
                    self._farthest[k, s] = distance[worst]
                    self._worst[k, s] = rows[worst], derivative[worst], values[worst]

    def differences(self, failed: Bool[np.ndarray, "L 2"] | None = None) -> Differences:
        """Return the differences of all rows that were added.

        `failed` marks the steps and signs, (L, 2), whose values are excluded.
        """
        h, mean = self._steps[:, None], lambda squares: np.sqrt(squares / self._rows)
        failed = np.zeros((len(h), 2), bool) if failed is None else failed
        lost = failed.any(1)
        lost_pairs = lost[1:] | lost[:-1]
        values = mean(np.where(failed[..., None], np.nan, self._values))
        jumps = mean(np.where(lost[:, None], np.nan, self._jumps)) / 2 + np.finfo(float).eps * values[:, 0]
        distances = mean(np.where((lost_pairs[:, None] | lost_pairs)[..., None], np.nan, self._pairs))
        size = np.stack([distances[k, k] for k in range(len(distances))])
        # Errors do not decrease with the step size; smaller values at large steps are chance.
        off = np.fmax.accumulate(jumps[::-1])[::-1] / h
        noise = np.where(np.isfinite(size), (ERROR_RATIO * off[1:] + off[:-1]) / (ERROR_RATIO - 1), np.nan)
        return Differences(
            self._steps[:-2],
            size[:-1],
            noise[:-1],
            _truncation(distances, noise),
            np.fmax.reduce(values, axis=(0, 1)),
            mean(np.where(lost_pairs[:, None], np.nan, self._off))[:-1],
            mean(self._derivative),
            self._worst[:-1],
        )


def _truncation(distances: Float[np.ndarray, "H H S"], noise: Float[np.ndarray, "H S"]) -> Float[np.ndarray, "H-1 S"]:
    """Return the truncation error at all steps but the last, from distances |R(h) - R(h')|, with sizes |R(h)| on the diagonal."""
    count = len(noise) - 1
    error = np.full((count, noise.shape[1]), np.nan)
    for k in reversed(range(count)):
        near = [distances[k, j] - noise[j] for j in range(k + 1, min(k + NEXT_STEPS, count) + 1)]
        far = [distances[k, j] - noise[j] - error[j] for j in range(k + 1 + NEXT_STEPS, count)]
        excess = np.stack([*near, *far])
        error[k] = np.fmax.reduce(np.where(np.isfinite(excess), np.maximum(excess, 0.0), np.nan))
    for k in range(1, count):
        error[k] = np.where(error[k] < error[k - 1] / STEP_RATIO**4, error[k - 1] / STEP_RATIO**4, error[k])
    size = np.stack([distances[k, k] for k in range(count + 1)])
    return np.where(error > TOO_LARGE * np.fmax(size[:-1], size[1:]), np.nan, error)


def leave_out_far_steps(computed: Differences) -> Differences:
    """Return the differences without those whose steps lead to an entirely different motion: their truncation errors are NaN."""
    h = computed.steps[:, None]
    far = (h * computed.derivative_size > computed.largest) & (h * computed.size > LEAST_CHANGE * computed.largest)
    return computed._replace(truncation=np.where(far, np.nan, computed.truncation))


def best_steps(errors: Float[np.ndarray, "... H"]) -> Int[np.ndarray, "..."]:
    """Return the index of the step with the least error; -1 where no error is known."""
    finite = np.where(np.isfinite(errors), errors, np.inf)
    return np.where(np.isfinite(finite).any(-1), finite.argmin(-1), -1)
