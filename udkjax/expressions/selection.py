"""Comparisons and choices between scalars, by primitives of JAX."""

import numpy as np
from jax import lax

from udkjax.expressions.graph import Scalar


def absolute(a: Scalar) -> Scalar:
    """Return |a|."""
    return a.graph.apply(lax.abs_p, {}, (a,), a.node.dtype, np.abs)


def greater(a: Scalar, b: Scalar) -> Scalar:
    """Return a > b."""
    return a.graph.apply(lax.gt_p, {}, (a, b), bool, np.greater)


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """Return max(a, b)."""
    return a.graph.apply(lax.max_p, {}, (a, b), a.node.dtype, np.maximum)


def where(condition: Scalar, yes: Scalar, no: Scalar) -> Scalar:
    """Return one of two scalars."""
    if condition.constant is not None:
        return yes if condition.constant else no
    return yes.graph.apply(lax.select_n_p, {}, (condition, no, yes), yes.node.dtype, lambda c, n, y: y if c else n)


def both(a: Scalar, b: Scalar) -> Scalar:
    """Return True if two conditions hold."""
    return a.graph.apply(lax.and_p, {}, (a, b), bool, np.logical_and)
