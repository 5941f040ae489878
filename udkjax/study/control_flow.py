"""Loops and branches of an algorithm that is written once: by NumPy and Python where all numbers are known, else by JAX.

What JAX compiles takes seconds before it takes its first step; NumPy begins at once.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from udkjax.equations.structure import ArrayLibrary

State = TypeVar("State")


class ControlFlow(NamedTuple):
    """An array library and its loops; `while_loop`, `cond`, `scan` and `map` are those of `jax.lax`, or take what these take."""

    xp: ArrayLibrary
    while_loop: Callable[..., Any]
    cond: Callable[..., Any]
    scan: Callable[..., Any]
    map: Callable[..., Any]
    vmap: Callable[[Callable[..., Any]], Callable[..., Any]]  # of one argument
    put: Callable[[Any, Any, Any], Any]  # an array with another value at an index; the array before is not used again


def _while_loop(condition: Callable[[State], Any], body: Callable[[State], State], state: State) -> State:
    while condition(state):
        state = body(state)
    return state


def _cond(condition: Any, if_true: Callable[[], State], if_false: Callable[[], State]) -> State:
    return if_true() if condition else if_false()


def _scan(function: Callable[[Any, Any], tuple[Any, Any]], state: Any, xs: PyTree) -> tuple[Any, PyTree]:
    found = []
    for x in _rows(xs):
        state, y = function(state, x)
        found.append(y)
    return state, _stack(found)


def _map(function: Callable[[Any], Any], xs: PyTree) -> PyTree:
    return _stack([function(x) for x in _rows(xs)])


def _vmap(function: Callable[[Any], Any]) -> Callable[[PyTree], PyTree]:
    return lambda xs: _map(function, xs)


def _rows(xs: PyTree) -> list[PyTree]:
    leaves, tree = jax.tree.flatten(xs)
    return [jax.tree.unflatten(tree, row) for row in zip(*leaves, strict=True)]


def _stack(trees: Sequence[PyTree]) -> PyTree:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def _put(array: np.ndarray, index: Any, value: Any) -> np.ndarray:
    array[index] = value
    return array


def _at(array: jax.Array, index: Any, value: Any) -> jax.Array:
    return array.at[index].set(value)


BY_JAX = ControlFlow(jnp, jax.lax.while_loop, jax.lax.cond, jax.lax.scan, jax.lax.map, jax.vmap, _at)
BY_NUMPY = ControlFlow(np, _while_loop, _cond, _scan, _map, _vmap, _put)
