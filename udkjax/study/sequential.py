"""Batches of functions that take as many steps as they need: one member after another."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
from jaxtyping import PyTree

T = TypeVar("T")


def sequential(function: Callable[..., T], *arguments: PyTree) -> T:
    """Return function(*arguments), pytrees of arrays and choices; under `vmap`, of one member after another.

    Side by side, all members of a loop would take as many steps as the slowest. Without derivatives.
    """
    arrays, choices = eqx.partition(arguments, eqx.is_array)

    @jax.custom_batching.custom_vmap
    def each(arrays: PyTree) -> T:
        return function(*eqx.combine(arrays, choices))

    @each.def_vmap
    def _(axis_size: int, batched: PyTree, arrays: PyTree) -> tuple[T, PyTree]:
        del axis_size
        moving, shared = eqx.partition(arrays, batched[0])
        found = jax.lax.map(lambda moving: each(eqx.combine(moving, shared)), moving)
        return found, jax.tree.map(lambda _: True, found)

    return each(arrays)
