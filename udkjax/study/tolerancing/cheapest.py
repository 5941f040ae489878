"""The tolerances of least cost with a given yield, the share of samples within all limits.

With the tolerances times t, a quadratic function of the deviations (second_order.py) says which samples are within all limits.
The cost, the sum of c_k / t_k, is minimized with this yield by SLSQP, with the edges of the limits smoothed. Then all tolerances
are multiplied by a common factor, so that samples of the mechanism itself have the yield.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.synthesis.ranges.second_order import Quadratic

SMOOTHING_WIDTH = 0.05  # width of the edges of limits, in standard deviations of the measure
MOST_SCALE = 100.0  # largest factor of a tolerance: beyond, it does not matter, and the quadratic function does not hold
HALVINGS = 20  # of the interval of the common factor


class Limits(NamedTuple):
    """The limits of L measures."""

    which: np.ndarray  # (L,): indices of these measures
    low: np.ndarray
    high: np.ndarray

    def holds(self, measured: Float[np.ndarray, "N G"]) -> np.ndarray:
        """Return a mask (N, L) of the limits that each sample satisfies; a measure without a value (NaN) satisfies none."""
        values = measured[:, self.which]
        return (values >= self.low) & (values <= self.high)


def optimal_scales(
    model: Quadratic, limits: Limits, u: Float[np.ndarray, "N K"], wanted: float, costs: Float[np.ndarray, "K"]
) -> Float[np.ndarray, "K"]:
    """Return the factors t of the tolerances of least cost whose smoothed yield is `wanted`.

    Args:
        model: the measures as quadratic functions of the deviations.
        limits: the limits of measures.
        u: samples of deviations.
        wanted: the yield.
        costs: cost c of each given tolerance; t times the tolerance costs c / t.
    """
    from scipy.optimize import minimize

    slope, curvature = model.slope[limits.which], model.curvature[limits.which]
    width = SMOOTHING_WIDTH * np.sqrt((slope**2).sum(1) + (curvature**2).sum((1, 2)) / 2.0) + 1e-300

    def smoothed(logs: np.ndarray) -> tuple[float, np.ndarray]:
        t = np.exp(logs)
        moved = u * t
        bent = np.einsum("nj,gij->ngi", moved, curvature)
        F = model.value[limits.which] + moved @ slope.T + 0.5 * np.einsum("ngi,ni->ng", bent, moved)
        slopes = (slope + bent) * moved[:, None, :]  # by log t
        above, below = _sigmoid((limits.high - F) / width), _sigmoid((F - limits.low) / width)
        inside = np.prod(above * below, axis=1)
        by_F = inside[:, None] * ((1.0 - below) - (1.0 - above)) / width
        return float(inside.mean()), np.einsum("ng,ngi->i", by_F, slopes) / len(u)

    def cost(logs: np.ndarray) -> tuple[float, np.ndarray]:
        terms = costs * np.exp(-logs)
        return float(terms.sum() / costs.sum()), -terms / costs.sum()

    start = np.zeros(len(costs))
    while smoothed(start)[0] < wanted and start[0] > -np.log(MOST_SCALE):
        start = start - 0.1
    bound = np.log(MOST_SCALE)
    found = minimize(
        cost, start, jac=True, method="SLSQP", bounds=[(-bound, bound)] * len(costs), options={"maxiter": 200, "ftol": 1e-9},
        constraints={"type": "ineq", "fun": lambda x: smoothed(x)[0] - wanted, "jac": lambda x: smoothed(x)[1]},
    )  # fmt: skip
    return np.exp(found.x if smoothed(found.x)[0] > wanted - 0.05 else start)


def common_factor(yield_of: Callable[[float], float], wanted: float) -> float:
    """Return the largest common factor of tolerances with which the yield is at least `wanted`.

    `yield_of` returns the yield for a factor; it must fall as the factor grows.
    """
    low, high = 1.0, 1.0
    while yield_of(low) < wanted and low > 1.0 / MOST_SCALE:
        low, high = low / 1.5, low
    while low == high:
        high = low * 1.5 if yield_of(low * 1.5) < wanted else low
        if high == low:
            low = high = low * 1.5
            if low > MOST_SCALE:
                return low
    for _ in range(HALVINGS):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if yield_of(middle) >= wanted else (low, middle)
    return low


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1.0 + np.tanh(0.5 * x))
