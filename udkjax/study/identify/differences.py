"""Differences of motions by their parameters, and how far off they are.

With y(t) what is seen a step t along a direction, central differences at the steps h of a ladder, extrapolated to fourth order
(L. F. Richardson, The approximate arithmetical solution by finite differences of physical problems, 1911),

    D(h) = (y(h) - y(-h)) / 2h,      R(h) = (16 D(h/4) - D(h)) / 15,

are off by two errors, neither of which needs a derivative to compare with:

    noise        |e(h) - e(-h)| / 2h, of what the integration leaves. Such errors e are not like rounding: where step control
                 takes other steps they jump, and in between they move with the parameters, so that differences settle at ever
                 smaller h, on a wrong value. So e is measured at each step, by the same run at another tolerance, not guessed
                 from how rough y is (as by J. J. More and S. M. Wild, Estimating computational noise, 2011).
    truncation   ~ h^4: by how much smaller steps say otherwise, beyond their own errors; where these hide it, what is expected
                 from larger steps. Steps at which that is much of the whole are too large to tell anything.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

RATIO = 4.0  # from one step to the next
STEPS = 0.1 * RATIO ** -np.arange(10.0)  # 0.1 to 4e-7
RICHARDSON = RATIO**2
# Smaller steps whose truncation does not count beside that of one; two, since one may be near by chance.
NEXT = 2
SETTLED = 0.5  # of a difference: where smaller steps say otherwise by more, a step is too large


class Differences(NamedTuple):
    """R(h) at all steps but the last two (H,), of values (R,), and its errors in each of S sets of them; nan: not known.

    `largest` is the largest size of what was seen.
    """

    steps: Float[np.ndarray, "H"]
    values: Float[np.ndarray, "H R"]
    noise: Float[np.ndarray, "H S"]
    truncation: Float[np.ndarray, "H S"]
    largest: Float[np.ndarray, "S"]


def differences(
    y: Float[np.ndarray, "L 2 R"], errors: Float[np.ndarray, "L 2 R"], series: Sequence[np.ndarray], steps: np.ndarray = STEPS
) -> Differences:
    """Differences of what is seen at +-steps, and their errors, root mean squares over the values of each of some series.

    Values that are not numbers, of runs that have failed, leave their steps out.
    """
    h = steps[:, None]
    D = (y[:, 0] - y[:, 1]) / (2 * h)
    R = (RICHARDSON * D[1:] - D[:-1]) / (RICHARDSON - 1)
    rounding = np.finfo(float).eps * sizes(y[:, 0], series)
    jumps = sizes(errors[:, 0] - errors[:, 1], series) / 2 + rounding
    # No smaller than at smaller steps, where it is only by chance.
    off = np.fmax.accumulate(jumps[::-1])[::-1] / h
    noise = (RICHARDSON * off[1:] + off[:-1]) / (RICHARDSON - 1)
    noise = np.where(np.isfinite(sizes(R, series)), noise, np.nan)
    largest = np.fmax.reduce(sizes(y, series), axis=(0, 1))
    return Differences(steps[:-2], R[:-1], noise[:-1], _truncation(R, noise, series), largest)


def _truncation(R: np.ndarray, noise: np.ndarray, series: Sequence[np.ndarray]) -> np.ndarray:
    """The truncation at all steps but the last."""
    count = len(R) - 1
    found = np.full((count, len(series)), np.nan)
    for k in reversed(range(count)):
        near = [sizes(R[k] - R[j], series) - noise[j] for j in range(k + 1, min(k + NEXT, count) + 1)]
        far = [sizes(R[k] - R[j], series) - noise[j] - found[j] for j in range(k + 1 + NEXT, count)]
        apart = np.stack([*near, *far])
        found[k] = np.fmax.reduce(np.where(np.isfinite(apart), np.maximum(apart, 0.0), np.nan))
    for k in range(1, count):
        found[k] = np.where(found[k] < found[k - 1] / RATIO**4, found[k - 1] / RATIO**4, found[k])
    whole = sizes(R, series)
    return np.where(found > SETTLED * np.fmax(whole[:-1], whole[1:]), np.nan, found)


def sizes(values: Float[np.ndarray, "... R"], series: Sequence[np.ndarray]) -> Float[np.ndarray, "... S"]:
    """The root mean square of values in each of some series."""
    return np.stack([np.sqrt(np.mean(values[..., places] ** 2, -1)) for places in series], -1)
