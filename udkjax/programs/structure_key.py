"""The structure of trees as a key of caches: everything except the values of their numbers."""

from collections.abc import Hashable
from typing import Any

import equinox as eqx
import jax

from udkjax.programs.deferred import ConcreteLeaf


class StructureKey:
    """A key of a cache: a tree of concrete numbers, compared by everything except the values of floating-point arrays.

    Functions among the leaves are compared by identity.
    """

    def __init__(self, tree: Any):
        leaves, form = jax.tree.flatten(tree)
        content = tuple((x.shape, x.dtype) if eqx.is_inexact_array(x) else ConcreteLeaf(x) for x in leaves)
        self._key: Hashable = form, content
        self._hash = hash(self._key)

    def __eq__(self, other: object) -> bool:
        try:
            return isinstance(other, StructureKey) and self._key == other._key
        except (TypeError, ValueError):  # of static fields that cannot be compared, such as arrays
            return False

    def __hash__(self) -> int:
        return self._hash
