"""Branches of a program, of which members of a batch take each its own.

`jax.lax.switch` then becomes a choice of each of its arguments, for each branch, and of each result: thousands of operations, of
the dozens of arrays of a run. Here all branches are evaluated as they are, and only results are chosen.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

T = TypeVar("T")


def branch(index: Int[Array, ""], functions: Sequence[Callable[..., T] | None], *operands: Any) -> T:
    """Return the result of one of some functions, which take traced numbers from the operands alone. None: any value.

    It has no derivatives.
    """
    dynamic, static = eqx.partition(operands, eqx.is_array)
    leaves, tree = jax.tree.flatten(dynamic)

    def as_flat(function: Callable[..., T]) -> Callable[..., T]:
        return jax.jit(lambda *leaves: function(*eqx.combine(jax.tree.unflatten(tree, leaves), static)))  # traced once

    known = [None if function is None else as_flat(function) for function in functions]
    shapes = jax.eval_shape(next(filter(None, known)), *leaves)
    zeros = lambda *_: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)  # noqa: E731

    @jax.custom_batching.custom_vmap
    def choose(index: Array, *leaves: Array) -> Any:
        return jax.lax.switch(index, [function or zeros for function in known], *leaves)

    @choose.def_vmap
    def _(size: int, batched: Sequence[bool], index: Array, *leaves: Array) -> Any:
        axes = [0 if is_batched else None for is_batched in batched[1:]]
        if not batched[0]:
            found = jax.lax.switch(index, [jax.vmap(f or zeros, axes, axis_size=size) for f in known], *leaves)
            return found, jax.tree.map(lambda _: True, found)
        results = {k: jax.vmap(f, axes, axis_size=size)(*leaves) for k, f in enumerate(known) if f is not None}
        *others, found = results.items()
        found = found[1]
        for k, result in others:
            found = jax.tree.map(lambda x, y, k=k: jnp.where((index == k).reshape(-1, *[1] * (x.ndim - 1)), x, y), result, found)
        return found, jax.tree.map(lambda _: True, found)

    return choose(index, *leaves)
