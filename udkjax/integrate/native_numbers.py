"""Numbers of a scene as machine code takes them: in one vector, and those with derivatives among them."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PyTree


def active_numbers(numbers: PyTree[Array], active: PyTree[bool]) -> tuple[bool, ...]:
    """Of the numbers of a tree and two thresholds: which are marked as active, that is have derivatives."""
    leaves = zip(*(leaves_and_none(tree) for tree in (numbers, active)), strict=True)
    return (*(m is True for x, m in leaves if x is not None for _ in range(np.size(x))), False, False)


def active_tangents(numbers: PyTree[Array], active: PyTree[bool], change: PyTree[Array], wanted: Sequence[bool]) -> list[Any]:
    """The tangents of the numbers that are `wanted`, in order: zeros of those that are not active."""
    found, place = [], 0
    for x, m, dx in zip(*(leaves_and_none(tree) for tree in (numbers, active, change)), strict=True):
        if x is not None:
            if m is True:
                found.append(dx)
            elif wanted[place]:
                found.append(np.zeros(np.shape(x)))
            place += np.size(x)
    return [*found, np.zeros(sum(wanted[place:]))]


def cotangent_tree(bars: Array, numbers: PyTree[Array], active: PyTree[bool], wanted: Sequence[bool]) -> PyTree[Array]:
    """The tree of the cotangents of what is active, from those of the numbers that are `wanted`, in order."""
    leaves, tree = jax.tree.flatten(numbers, is_leaf=lambda x: x is None)
    parts, place, found = [], 0, 0
    for x, m in zip(leaves, leaves_and_none(active), strict=True):
        size = 0 if x is None else np.size(x)
        count = sum(wanted[place : place + size])
        parts.append(bars[found : found + count].reshape(np.shape(x)) if m is True else None)
        place, found = place + size, found + count
    return jax.tree.unflatten(tree, parts)


def leaves_and_none(tree: PyTree) -> list[Any]:
    """The leaves of a tree, None among them."""
    return jax.tree.leaves(tree, is_leaf=lambda x: x is None)
