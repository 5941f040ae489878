"""Mean, variance and shares of measures from their first and second differences, without samples.

With the deviations u of unit variance, independent and symmetric, f = f0 + g.u + u.H u / 2 has

    mean      f0 + sum H_ii / 2
    variance  sum g_i^2 + sum H_ii^2 (k_i - 1) / 4 + sum over i < j of H_ij^2

with k the mean of u^4. The differences have the step 3^(1/2): for a normal distribution, the points of Gauss's rule with three
nodes, which integrates polynomials of the fifth degree exactly.
"""

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

DIFFERENCE_STEP = 3.0**0.5  # of differences, in standard deviations


class Quadratic(NamedTuple):
    """G measures as quadratic functions of K deviations u: values, first and second derivatives at u = 0."""

    value: Float[np.ndarray, "G"]
    slope: Float[np.ndarray, "G K"]
    curvature: Float[np.ndarray, "G K K"]

    def __call__(self, u: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "N G"]:
        """Return the measures at N vectors of deviations."""
        return self.value + u @ self.slope.T + 0.5 * np.einsum("ni,gij,nj->ng", u, self.curvature, u)

    @property
    def mean(self) -> Float[np.ndarray, "G"]:
        """The mean of each measure over the deviations."""
        return self.value + 0.5 * np.einsum("gii->g", self.curvature)

    def parts(self, kurtosis: Float[np.ndarray, "K"]) -> tuple[Float[np.ndarray, "G K"], Float[np.ndarray, "G K K"]]:
        """Return the parts of each variance due to each deviation alone, and due to each pair, symmetric with a zero diagonal.

        `kurtosis` is the mean of u^4 of each deviation.
        """
        own = np.einsum("gii->gi", self.curvature)
        pairs = self.curvature**2 * (1.0 - np.eye(self.slope.shape[1]))
        return self.slope**2 + own**2 * (kurtosis - 1.0) / 4.0, pairs


def quadratic(function: Callable[[np.ndarray], np.ndarray], count: int) -> Quadratic:
    """Return the quadratic functions with the same first and second differences as a function at zero deviations.

    Args:
        function: returns G measures (N, G) at N vectors of deviations (N, K); it is called once.
        count: the number K of deviations.
    """
    units, pairs = DIFFERENCE_STEP * np.eye(count), list(combinations(range(count), 2))
    signs = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
    crossed = [a * units[i] + b * units[j] for i, j in pairs for a, b in signs]
    found = function(np.concatenate([np.zeros((1, count)), units, -units, np.reshape(crossed, (-1, count))]))
    middle, plus, minus, rest = np.split(found, [1, 1 + count, 1 + 2 * count])
    curvature = np.zeros((found.shape[1], count, count))
    for k in range(count):
        curvature[:, k, k] = (plus[k] - 2.0 * middle[0] + minus[k]) / DIFFERENCE_STEP**2
    for (i, j), f in zip(pairs, rest.reshape(len(pairs), 4, found.shape[1]), strict=True):
        curvature[:, i, j] = curvature[:, j, i] = (f[0] - f[1] - f[2] + f[3]) / (4.0 * DIFFERENCE_STEP**2)
    return Quadratic(middle[0], ((plus - minus) / (2.0 * DIFFERENCE_STEP)).T, curvature)
