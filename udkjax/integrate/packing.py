"""Numbers as machine code takes them: its inputs, all numbers of a scene in one vector, their changes and cotangents."""

from collections.abc import Mapping, Sequence
from functools import partial
from types import ModuleType
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from udkjax.equations.structure import numbers_as_vector
from udkjax.integrate.gradients import stop_gradients
from udkjax.native.operations import Operation


def pack(
    operation: Operation,
    numbers: Sequence[ArrayLike],
    ts: ArrayLike,
    q: ArrayLike,
    v: ArrayLike,
    settings: Mapping[str, ArrayLike],
    rows: ArrayLike,
    breaks: ArrayLike,
    xp: ModuleType,
    further: Sequence[ArrayLike] = (),
) -> list[Any]:
    """Pack the inputs of an operation, of one member.

    Args:
        operation: The operation.
        numbers: All numbers of the scene, and two thresholds of pivots.
        ts: Times (s).
        q: Positions (n,).
        v: Velocities (n,).
        settings: By name; those of the operation are taken.
        rows: The scales of the rows of Psi.
        breaks: Times (s) where the motion is not smooth, in their order.
        xp: jax.numpy, without derivatives, or NumPy, where all is known.
        further: Further inputs.

    Returns:
        Arrays with the member first.
    """
    as_vector = partial(np.concatenate, axis=None) if xp is np else numbers_as_vector
    values = [settings[name] for name in operation.all_settings]
    given = (as_vector(numbers), ts, q, v, as_vector(values), rows, breaks, *further)
    arrays = [xp.asarray(x, float)[None] for x in given]
    return arrays if xp is np else stop_gradients(arrays)


def active_numbers(numbers: PyTree[Array], active: PyTree[bool]) -> tuple[bool, ...]:
    """Of the numbers of a tree and two thresholds: which are marked as active, that is have derivatives."""
    leaves = zip(*(leaves_and_none(tree) for tree in (numbers, active)), strict=True)
    return (*(m is True for x, m in leaves if x is not None for _ in range(np.size(x))), False, False)


def number_tangents(numbers: PyTree[Array], active: PyTree[bool], change: PyTree[Array]) -> list[Any]:
    """The tangents of all numbers and of two thresholds, in order: zeros of those that are not active."""
    leaves = zip(*(leaves_and_none(tree) for tree in (numbers, active, change)), strict=True)
    return [*(dx if m is True else np.zeros(np.shape(x)) for x, m, dx in leaves if x is not None), np.zeros(2)]


def cotangent_tree(bars: Array, numbers: PyTree[Array], active: PyTree[bool]) -> PyTree[Array]:
    """The tree of the cotangents of what is active, from those of all numbers, in order."""
    leaves, tree = jax.tree.flatten(numbers, is_leaf=lambda x: x is None)
    parts, place = [], 0
    for x, m in zip(leaves, leaves_and_none(active), strict=True):
        size = 0 if x is None else np.size(x)
        parts.append(bars[place : place + size].reshape(np.shape(x)) if m is True else None)
        place += size
    return jax.tree.unflatten(tree, parts)


def leaves_and_none(tree: PyTree) -> list[Any]:
    """The leaves of a tree, None among them."""
    return jax.tree.leaves(tree, is_leaf=lambda x: x is None)
