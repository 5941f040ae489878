"""Comparisons and choices between scalars, by primitives of JAX."""

from collections.abc import Sequence

import numpy as np
from jax import lax

from udkjax.expressions.graph import Graph, Scalar


def absolute(a: Scalar) -> Scalar:
    """|a|."""
    return a.graph.apply(lax.abs_p, {}, (a,), a.node.dtype, np.abs)


def greater(a: Scalar, b: Scalar) -> Scalar:
    """a > b."""
    return a.graph.apply(lax.gt_p, {}, (a, b), bool, np.greater)


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """max(a, b)."""
    return a.graph.apply(lax.max_p, {}, (a, b), a.node.dtype, np.maximum)


def where(condition: Scalar, yes: Scalar, no: Scalar) -> Scalar:
    """One of two scalars."""
    if condition.constant is not None:
        return yes if condition.constant else no
    return yes.graph.apply(lax.select_n_p, {}, (condition, no, yes), yes.node.dtype, lambda c, n, y: y if c else n)


def all_of(conditions: Sequence[Scalar], graph: Graph) -> Scalar:
    """Whether all conditions hold."""
    result = graph.constant(True, bool)
    for c in conditions:
        if c.constant is not True:
            result = c if result.constant is True else result.graph.apply(lax.and_p, {}, (result, c), bool, np.logical_and)
    return result
