"""Comparisons and choices between scalars, by primitives of JAX."""

from collections.abc import Sequence

import jax
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.typing import ArrayLike
from numpy.typing import DTypeLike

from udkjax.expressions.scalars.graph import Scalar
from udkjax.programs.numpy_rules import exact_rule


def absolute(a: Scalar) -> Scalar:
    """Return |a|."""
    return a.graph.apply(lax.abs_p, {}, (a,), a.node.dtype, np.abs)


def floor(a: Scalar) -> Scalar:
    """Return the largest whole number that is at most a."""
    return apply(lax.floor_p, a.node.dtype, a)


def greater(a: Scalar, b: Scalar) -> Scalar:
    """Return a > b."""
    return a.graph.apply(lax.gt_p, {}, (a, b), bool, np.greater)


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """Return max(a, b)."""
    return a.graph.apply(lax.max_p, {}, (a, b), a.node.dtype, np.maximum)


def where(condition: Scalar, yes: Scalar, no: Scalar) -> Scalar:
    """Return `yes` if the condition holds, otherwise `no`."""
    if condition.constant is not None:
        return yes if condition.constant else no
    return yes.graph.apply(lax.select_n_p, {}, (condition, no, yes), yes.node.dtype, lambda c, n, y: y if c else n)


def both(a: Scalar, b: Scalar) -> Scalar:
    """Return the condition that both conditions hold."""
    return a.graph.apply(lax.and_p, {}, (a, b), bool, np.logical_and)


def either(a: Scalar, b: Scalar) -> Scalar:
    """Return the condition that at least one of two conditions holds."""
    return apply(lax.or_p, bool, a, b)


def apply(primitive: Primitive, dtype: DTypeLike, *arguments: Scalar) -> Scalar:
    """Apply a primitive of JAX that has no parameters."""
    return arguments[0].graph.apply(primitive, {}, arguments, dtype, lambda *values: fold(primitive, {}, values))


def fold(primitive: Primitive, parameters: dict, values: Sequence[ArrayLike]) -> np.ndarray:
    """Return the result of a JAX primitive for known numbers, by NumPy if that is exact: JAX would compile the operation."""
    rule = exact_rule(primitive.name)
    if rule is not None:
        found = rule(*map(np.asarray, values), **parameters)
        if found is not NotImplemented:
            return np.asarray(found)
    with jax.ensure_compile_time_eval():
        return np.asarray(primitive.bind(*map(jax.numpy.asarray, values), **parameters))
