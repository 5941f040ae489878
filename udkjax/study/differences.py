"""Finite differences of motions with respect to parameters, and their errors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

STEP_RATIO = 4.0  # ratio of successive steps of differences
DIFFERENCE_STEPS = 0.1 * STEP_RATIO ** -np.arange(10.0)  # changes of dimensionless unknowns, from 0.1 to 4e-7
RICHARDSON = STEP_RATIO**2  # ratio of the errors of successive steps, which are of second order
NEXT_STEPS = 2  # number of smaller steps to compare a step with; a single one may agree by chance
LEAST_CHANGE = 1e-2  # a step is small if values change by less than this, relative to their size
TOO_LARGE = 0.5  # a step is too large if smaller steps disagree by more than this, relative to the difference


class Differences(NamedTuple):
    """Differences R(h) at all steps except the last two, and their errors in each of S series; NaN where unknown."""

    steps: Float[np.ndarray, "H"]
    values: Float[np.ndarray, "H R"]
    noise: Float[np.ndarray, "H S"]
    truncation: Float[np.ndarray, "H S"]
    largest: Float[np.ndarray, "S"]  # largest root mean square of the values


def differences(
    y: Float[np.ndarray, "L 2 R"],
    errors: Float[np.ndarray, "L 2 R"],
    series: Sequence[np.ndarray],
    steps: np.ndarray = DIFFERENCE_STEPS,
) -> Differences:
    """Compute central differences, extrapolated to fourth order, and their errors as root mean squares over each series.

        D(h) = (y(h) - y(-h)) / 2h,      R(h) = (16 D(h/4) - D(h)) / 15

    Two errors are estimated, without a derivative to compare with:

        noise        |e(h) - e(-h)| / 2h, from the integration error e. Unlike rounding, e jumps where the step controller takes
                     other steps, and changes smoothly with the parameters in between; differences therefore converge to a
                     wrong value as h decreases. For this reason e is measured at each step, by the same run at another
                     tolerance, and not estimated from the roughness of y (as by J. J. More and S. M. Wild, Estimating
                     computational noise, 2011).
        truncation   ~ h^4: the disagreement with smaller steps beyond the errors of these steps; where these errors are larger,
                     it is extrapolated from larger steps. Steps with a large relative truncation error are discarded.

    Args:
        y: values at +-steps; NaN where a run has failed, which excludes its step.
        errors: integration errors of y.
        series: index arrays of values that belong together.
        steps: steps, each smaller than the previous one by the factor `STEP_RATIO`.

    Source: L. F. Richardson, The approximate arithmetical solution by finite differences of physical problems, 1911.
    """
    h = steps[:, None]
    D = (y[:, 0] - y[:, 1]) / (2 * h)
    R = (RICHARDSON * D[1:] - D[:-1]) / (RICHARDSON - 1)
    rounding = np.finfo(float).eps * sizes(y[:, 0], series)
    jumps = sizes(errors[:, 0] - errors[:, 1], series) / 2 + rounding
    # Errors do not decrease with the step size; smaller values at large steps are chance.
    off = np.fmax.accumulate(jumps[::-1])[::-1] / h
    noise = (RICHARDSON * off[1:] + off[:-1]) / (RICHARDSON - 1)
    noise = np.where(np.isfinite(sizes(R, series)), noise, np.nan)
    largest = np.fmax.reduce(sizes(y, series), axis=(0, 1))
    return Differences(steps[:-2], R[:-1], noise[:-1], _truncation(R, noise, series), largest)


def _truncation(R: np.ndarray, noise: np.ndarray, series: Sequence[np.ndarray]) -> np.ndarray:
    """Return the truncation error at all steps except the last."""
    count = len(R) - 1
    error = np.full((count, len(series)), np.nan)
    for k in reversed(range(count)):
        near = [sizes(R[k] - R[j], series) - noise[j] for j in range(k + 1, min(k + NEXT_STEPS, count) + 1)]
        far = [sizes(R[k] - R[j], series) - noise[j] - error[j] for j in range(k + 1 + NEXT_STEPS, count)]
        excess = np.stack([*near, *far])
        error[k] = np.fmax.reduce(np.where(np.isfinite(excess), np.maximum(excess, 0.0), np.nan))
    for k in range(1, count):
        error[k] = np.where(error[k] < error[k - 1] / STEP_RATIO**4, error[k - 1] / STEP_RATIO**4, error[k])
    size = sizes(R, series)
    return np.where(error > TOO_LARGE * np.fmax(size[:-1], size[1:]), np.nan, error)


def leave_out_far_steps(computed: Differences, size: Float[np.ndarray, "S"], series: Sequence[np.ndarray]) -> Differences:
    """Exclude differences whose steps lead to an entirely different motion; `size` is the derivative's size in each series."""
    h = computed.steps[:, None]
    far = (h * size > computed.largest) & (h * sizes(computed.values, series) > LEAST_CHANGE * computed.largest)
    return computed._replace(truncation=np.where(far, np.nan, computed.truncation))


def best_steps(errors: Float[np.ndarray, "... H"]) -> Int[np.ndarray, "..."]:
    """Return the index of the step with the least error; -1 where no error is known."""
    finite = np.where(np.isfinite(errors), errors, np.inf)
    return np.where(np.isfinite(finite).any(-1), finite.argmin(-1), -1)


def sizes(values: Float[np.ndarray, "... R"], series: Sequence[np.ndarray]) -> Float[np.ndarray, "... S"]:
    """Return the root mean square of the values in each series."""
    return np.stack([np.sqrt(np.mean(values[..., places] ** 2, -1)) for places in series], -1)
