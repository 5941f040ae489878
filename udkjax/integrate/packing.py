"""Many small arrays as a few, for loops whose rounds XLA does not compile into one function.

There each array that a loop carries is copied by itself, and what does not wait for something else is handed to another thread,
which takes longer than to do it.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array


class Packing:
    """Of a tree of vectors and numbers: one array of all vectors of a type, one of all numbers of a type; booleans are counts."""

    def __init__(self, example: Any):
        leaves, self.tree = jax.tree.flatten(example)
        self.dtypes, self.shapes = [x.dtype for x in leaves], [x.shape for x in leaves]
        self.groups: dict[Any, list[int]] = {}
        for k, x in enumerate(leaves):
            self.groups.setdefault((self._kept_as(k), x.ndim), []).append(k)

    def _kept_as(self, k: int) -> Any:
        return jnp.result_type(int) if jnp.issubdtype(self.dtypes[k], bool) else self.dtypes[k]

    def pack(self, tree: Any) -> tuple[Array, ...]:
        """The numbers of a tree of the example's form."""
        leaves = [x.astype(self._kept_as(k)).ravel() for k, x in enumerate(jax.tree.leaves(tree))]
        return tuple(jnp.concatenate([leaves[k] for k in members]) for members in self.groups.values())

    def unpack(self, packed: Sequence[Array]) -> Any:
        """The tree again."""
        leaves: list[Any] = [None] * len(self.shapes)
        for members, x in zip(self.groups.values(), packed, strict=True):
            start = 0
            for k in members:
                end = start + (self.shapes[k][0] if self.shapes[k] else 1)
                leaves[k] = x[start:end].reshape(self.shapes[k]).astype(self.dtypes[k])
                start = end
        return self.tree.unflatten(leaves)
