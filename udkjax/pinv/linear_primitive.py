"""Primitives of JAX that apply an operator to a vector, and are linear in the vector."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from udkjax.programs.varying_axes import zero_of


def linear_primitive(name: str, apply: Callable, shape: Callable, derivative: Callable, transpose: Callable) -> Primitive:
    """Make a primitive from four rules for one operator and one vector; a batch maps the rules.

    `equinox.internal.create_vprim` does the same, but its transpose does not sum the cotangents of a vector shared by a batch of
    operators. Here such a vector is broadcast first, and the transpose of broadcasting is the sum.

    Args:
        name: The name in printed JAX programs.
        apply: (operator, vector) -> vector.
        shape: Returns the type of the result from the types of the operator and the vector.
        derivative: The forward-mode rule.
        transpose: The reverse-mode rule for the vector.

    Returns:
        The primitive, for `equinox.internal.filter_primitive_bind`.
    """
    rule = eqxi.filter_primitive_def(apply)

    def transpose_unless_zero(cotangents: Sequence[Any], *inputs: Any, **params: object) -> Sequence[Any]:
        # A result that nothing uses has a zero cotangent, which batches pass as None.
        if all(x is None or type(x) is ad.Zero for x in cotangents):
            return [None] * len(inputs)
        return transpose(cotangents, *inputs, **params)

    member = eqxi.create_vprim(name, rule, shape, derivative, transpose_unless_zero)

    def batch(inputs: Sequence[Array], axes: Sequence[int | None], **params: object) -> tuple[list[Array], list[int]]:
        *operator, vector = inputs
        size = next(x.shape[axis] for x, axis in zip(inputs, axes, strict=True) if axis is not None)
        if axes[-1] is None:
            vector = jnp.broadcast_to(vector + sum(map(zero_of, operator)), (size, *vector.shape))
            axes = (*axes[:-1], 0)
        result = jax.vmap(partial(member.bind, **params), in_axes=tuple(axes))(*operator, vector)
        return result, [0] * len(result)

    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(rule)
    primitive.def_abstract_eval(shape)
    ad.primitive_jvps[primitive] = derivative
    ad.primitive_transposes[primitive] = transpose_unless_zero
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(rule, multiple_results=True))
    return primitive
