"""Losses: what residuals count, so that a few wrong ones do not decide a fit.

A loss rho is minimized as a least-squares problem in s = sign(r) sqrt(rho(r)), whose Jacobian is ds/dr J: half of the sum of s^2
is half of the sum of rho, with its exact gradient. Huber's is rho(r) = r^2 up to |r| = c, and 2 c |r| - c^2 beyond (P. J. Huber,
Robust estimation of a location parameter, 1964).
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.problem import Evaluated

HUBER = 1.345  # standard deviations: of noise that is Gaussian after all, estimates lose a twentieth of their precision

Loss = Callable[[Evaluated], Evaluated] | None


def loss_of(given: str, residuals: int) -> Loss:
    """The loss of a name, for the first `residuals` of a problem: priors are not outliers. None: squares."""
    if given == "least_squares":
        return None
    if given == "huber":
        return partial(huber, residuals=residuals)
    raise IdentificationError([f"loss must be 'least_squares' or 'huber', is {given!r}"])


def huber(found: Evaluated, residuals: int, c: float = HUBER) -> Evaluated:
    """Residuals and Jacobian of Huber's loss."""
    r = found.r[:, :residuals]
    size = np.abs(r)
    far = size > c
    root = np.sqrt(np.where(far, 2.0 * c * size - c**2, 1.0))
    s, slope = np.where(far, np.sign(r) * root, r), np.where(far, c / root, 1.0)
    rest = found.r[:, residuals:], found.J[:, residuals:]
    return Evaluated(
        np.concatenate([s, rest[0]], 1), np.concatenate([slope[..., None] * found.J[:, :residuals], rest[1]], 1), found.code
    )
