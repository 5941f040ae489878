"""Numbers that are held between samples as machine code takes them: one row of samples for each interval between breakpoints."""

from types import ModuleType
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PyTree

from udkjax.scene.held import Held, make_held


def breakpoints_of(problem: Any, xp: ModuleType) -> Any:
    """Return the breakpoints of a problem in their order: by NumPy where they are known."""
    if problem.breakpoints is None:
        return np.zeros(0)
    return xp.sort(problem.breakpoints) if isinstance(problem.breakpoints, Tracer) else np.sort(np.asarray(problem.breakpoints))


def first_rows(tree: PyTree) -> PyTree:
    """Return a tree with the first sample in place of each `Held`: of numbers, of their changes, or of marks."""
    return jax.tree.map(lambda x: x.first if isinstance(x, Held) else x, tree, is_leaf=_is_held)


def sampled_places(numbers: PyTree) -> tuple[int, ...]:
    """Return where the numbers that have samples are among all numbers of a tree with the first samples."""
    found, place = [], 0
    for x in jax.tree.leaves(first_rows(numbers), is_leaf=_is_held):
        size = int(np.size(x.values if isinstance(x, Held) else x))
        if isinstance(x, Held):
            found += range(place, place + size)
        place += size
    return tuple(found)


def rows_of(numbers: PyTree, samples: PyTree, breakpoints: Float[Array, "K"], xp: ModuleType) -> Float[Array, "K+1 R"]:
    """Return the samples that hold in each interval, or their changes.

    Args:
        numbers: the numbers of a run.
        samples: the same tree, perhaps with other values in each `Held`; None stands for zeros.
        breakpoints: in their order (s).
        xp: NumPy or jax.numpy.
    """
    columns = []
    for held, x in zip(_helds(numbers), _helds(samples), strict=True):
        count, size = len(held.values), int(np.prod(held.values.shape[1:]))
        if x.values is None:
            columns.append(xp.zeros((len(breakpoints) + 1, size)))
        else:
            values, index = xp.reshape(xp.asarray(x.values), (count, size)), _sample_in_each(held, breakpoints, xp)
            columns.append(values if index is None else values[index])
    return xp.concatenate(columns, axis=1)


def with_cotangents(
    bars: PyTree,
    numbers: PyTree,
    active: PyTree[bool],
    rows: Float[Array, "K+1 R"],
    breakpoints: Float[Array, "K"],
    xp: ModuleType,
) -> PyTree:
    """Return cotangents of numbers, with those of the samples from those of the rows that hold in each interval."""
    start, found = 0, iter(_helds(numbers))

    def replaced(bar: Any, mark: Any) -> Any:
        nonlocal start
        if not _is_held(bar):
            return bar
        held = next(found)
        size = int(np.prod(held.values.shape[1:]))
        mine, start = rows[:, start : start + size], start + size
        if mark.values is not True:
            return make_held(None)
        index = _sample_in_each(held, breakpoints, xp)
        total = mine if index is None else xp.zeros((len(held.values), size)).at[index].add(mine)
        return make_held(xp.reshape(total, held.values.shape))

    return jax.tree.map(replaced, bars, active, is_leaf=lambda x: x is None or _is_held(x))


def _sample_in_each(held: Held, breakpoints: Float[Array, "K"], xp: ModuleType) -> Int[Array, "K+1"] | None:
    """Return the index of the sample that holds in each interval; None where there is one interval for each."""
    own = held.breakpoints
    if isinstance(breakpoints, Tracer):
        return xp.searchsorted(xp.asarray(own), xp.concatenate([xp.full(1, -np.inf), breakpoints]), side="right")
    if np.array_equal(own, breakpoints):
        return None
    return np.searchsorted(own, np.append(-np.inf, breakpoints), side="right")  # pyright: ignore[reportReturnType]


def _helds(tree: PyTree) -> list[Held]:
    return [x for x in jax.tree.leaves(tree, is_leaf=_is_held) if _is_held(x)]


def _is_held(x: object) -> bool:
    return isinstance(x, Held)
