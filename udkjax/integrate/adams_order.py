"""Which order and step an Adams method takes next.

As in STEP by Shampine and Gordon: while it starts, the order rises and the step doubles at every step. Then the order falls as
soon as a lower one promises no larger error, and rises after k + 1 steps of one size, when the next difference is known.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

SHARE = 0.25  # of the tolerance: the error that the next step is chosen for
RUNGS = 4.0  # a step changes by powers of 2^(1/4): the factor does not follow the rounding errors in an estimate
SMALLEST, LARGEST = 0.25, 2.0  # factors of a step
NEGLIGIBLE = 1e-4  # relative to the tolerance: estimates below are of rounding errors, and say nothing about the order
EVEN = 1e-2  # relative: two steps that differ by less count as of one size
TINY = 1e-300  # in the place of zero, where an error divides


class Errors(eqx.Module):
    """Estimated local errors of orders k - 2 to k + 1, relative to the tolerance, were all steps of one size."""

    lowest: Any
    lower: Any
    same: Any
    higher: Any


class Pace(eqx.Module):
    """What the choice of order and step remembers."""

    order: Int[Array, ""]  # of the next step
    planned: Any  # size of the next step
    even: Int[Array, ""]  # steps of equal size that were made up to here
    starting: Bool[Array, ""]  # order and step rise with every step


def begin(h: Any) -> Pace:
    """For a history of one value."""
    return Pace(jnp.array(1), jnp.asarray(h), jnp.array(1), jnp.array(True))


def after_step(pace: Pace, h: Any, points: Any, e: Errors, lowest: int, highest: int) -> tuple[Pace, Any]:
    """After an accepted step of size h that has made `points` values known: the pace, and by which factor the step grows.

    The order is kept between `lowest` and `highest`.
    """
    k = pace.order
    even = jnp.where(jnp.abs(h - pace.planned) < EVEN * h, pace.even + 1, 1)
    falling = jnp.where(k > 2, jnp.maximum(e.lower, e.lowest) <= e.same, (k == 2) & (e.lower <= 0.5 * e.same))
    falling = falling & (e.same > NEGLIGIBLE)
    shrunk = (h < (1 - EVEN) * pace.planned) & (points > 2)  # it was rejected; the first step is only a guess
    starting = pace.starting & ~shrunk & ~falling & (k < highest)

    judged = (even > k) & (points >= k + 2)
    down = falling | (judged & (k > 1) & (e.lower <= jnp.minimum(e.same, e.higher)))
    up = judged & ~down & (e.higher < jnp.where(k > 1, 1.0, 0.5) * e.same)
    up = (up | starting | (k < lowest)) & (k < highest) & (k < points)
    down = down & ~up & (k > lowest)
    order = k + up - down
    error = jnp.where(down, e.lower, jnp.where(up & judged, e.higher, e.same))
    growth = jnp.where(starting, LARGEST, jnp.maximum(factor(error, order), 1.0))
    return Pace(order, h * growth, even, starting), growth


def factor(error: Any, order: Any) -> Any:
    """Of a step with this error, of a method of this order."""
    wanted = (SHARE / jnp.maximum(error, TINY)) ** (1 / (order + 1))
    return 2 ** (jnp.floor(RUNGS * jnp.log2(jnp.clip(wanted, SMALLEST, LARGEST))) / RUNGS)
