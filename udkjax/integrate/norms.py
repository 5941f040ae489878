"""What is asked of all coordinates (n, *lanes) at once: the largest of them, or whether all are finite."""

from collections.abc import Callable
from functools import reduce

import jax.numpy as jnp
from jaxtyping import Array, Bool

from udkjax.straightline import cut


def largest(x: Array) -> Array:
    """The largest of n numbers, in each lane."""
    return _over_all(jnp.maximum, jnp.max, x)


def all_finite(x: Array) -> Bool[Array, "*lanes"]:
    """Whether all of n numbers are finite, in each lane."""
    return _over_all(jnp.logical_and, jnp.all, jnp.isfinite(x))


def _over_all(pair: Callable, every: Callable, x: Array) -> Array:
    """In lanes one after another: XLA writes a loop over lanes for `every` that does not vectorize.

    Of 4,096 numbers and more it asks a library, and then makes no function of the loop that it is in (straightline/fusion.py).
    """
    return cut([reduce(pair, cut(list(x)))])[0] if x.ndim > 1 else every(x)
