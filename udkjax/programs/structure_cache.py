"""Caches of results that depend on the structure of trees alone: on everything except the values of their numbers."""

from collections.abc import Callable, Hashable
from functools import lru_cache, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax

from udkjax.programs.deferred import ConcreteLeaf

CACHE_SIZE = 64  # results stored per function; the least recently used one is dropped

Result = TypeVar("Result")


class _Structure:
    """A tree of concrete numbers, compared by everything except the values of inexact arrays; functions by identity."""

    def __init__(self, tree: Any):
        leaves, form = jax.tree.flatten(tree)
        content = tuple((x.shape, x.dtype) if eqx.is_inexact_array(x) else ConcreteLeaf(x) for x in leaves)
        self.tree = tree  # until the result is stored
        self._key: Hashable = form, content
        self._hash = hash(self._key)

    def __eq__(self, other: object) -> bool:
        try:
            return isinstance(other, _Structure) and self._key == other._key
        except (TypeError, ValueError):  # of static fields that cannot be compared, such as arrays
            return False

    def __hash__(self) -> int:
        return self._hash


def cached_by_structure(function: Callable[..., Result]) -> Callable[..., Result]:
    """Cache the results of a function of trees of concrete numbers by their structure.

    The results must not depend on the values of inexact arrays. Functions among the leaves are compared by identity, and may
    close over anything: results must not depend on calling them.
    """

    @lru_cache(maxsize=CACHE_SIZE)
    def stored(structure: _Structure) -> Result:
        trees, structure.tree = structure.tree, None  # the cache needs no numbers
        return function(*trees)

    @wraps(function)
    def call(*trees: Any) -> Result:
        try:
            structure = _Structure(trees)
        except TypeError:
            return function(*trees)
        return stored(structure)

    return call
