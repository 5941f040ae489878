"""Loops and branches of algorithms that are written once, and run by NumPy if all numbers are concrete, otherwise by JAX.

JAX compiles for seconds before the first step; NumPy begins at once.
"""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import cache
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, PyTree

from udkjax.arrays import ArrayLibrary, Module, is_traced, is_within_jit, put_arrays
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.programs.undefined import defined

Carry = TypeVar("Carry")
Result = TypeVar("Result")


class ControlFlow(NamedTuple):
    """An array library and its loops; `while_loop`, `cond`, `scan` and `map` have the signatures of `jax.lax`."""

    xp: ArrayLibrary
    while_loop: Callable[..., Any]
    cond: Callable[..., Any]
    scan: Callable[..., Any]
    map: Callable[..., Any]
    vmap: Callable[[Callable[..., Any]], Callable[..., Any]]  # for functions of one argument
    put: Callable[[Any, Any, Any], Any]  # set an element of an array; the old array must not be used again
    call: Callable[..., Any]  # call a function written for JAX


def _while_loop(condition: Callable[[Carry], Any], body: Callable[[Carry], Carry], state: Carry) -> Carry:
    while condition(state):
        state = body(state)
    return state


def _cond(condition: Any, if_true: Callable[[], Carry], if_false: Callable[[], Carry]) -> Carry:
    return if_true() if condition else if_false()


def _scan(function: Callable[[Any, Any], tuple[Any, Any]], state: Any, xs: PyTree) -> tuple[Any, PyTree]:
    outputs = []
    for x in _rows(xs):
        state, y = function(state, x)
        outputs.append(y)
    return state, _stack(outputs)


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


@deferred
def _compiled(function: Callable[..., Result], *arguments: Any) -> Result:
    return function(*arguments)


def _call(function: Callable[..., Result], *arguments: Any) -> Result:
    return function(*arguments)


def _call_compiled(function: Callable[..., Result], *arguments: Any) -> Result:
    return jax.tree.map(np.asarray, _compiled(function, *arguments))


BY_JAX = ControlFlow(jnp, jax.lax.while_loop, jax.lax.cond, jax.lax.scan, jax.lax.map, jax.vmap, _at, _call)
BY_NUMPY = ControlFlow(np, _while_loop, _cond, _scan, _map, _vmap, _put, _call_compiled)


def solve(function: Callable[..., Result], *arguments: Any, put: bool = True) -> Result:
    """Return function(*arguments, flow), where `flow` is a `ControlFlow`.

    `flow` is `BY_NUMPY` if all numbers of the arguments are concrete; otherwise `BY_JAX`, and the call is one JAX program. If
    `put`, results of NumPy are converted to JAX arrays.
    """
    leaves, tree = jax.tree.flatten(arguments, is_leaf=lambda x: _is_of_modules(type(x)))
    is_module = [_is_of_modules(type(x)) for x in leaves]
    if any(_is_traced_module(x) if m else isinstance(x, Tracer) for x, m in zip(leaves, is_module, strict=True)):
        return _compiled(_by_jax, function, *arguments)
    with jax.ensure_compile_time_eval() if is_within_jit() else nullcontext(), np.errstate(all="ignore"):
        concrete = [_by_numpy(x, m) for x, m in zip(leaves, is_module, strict=True)]
        found = function(*jax.tree.unflatten(tree, concrete), BY_NUMPY)
        return put_arrays(found) if put else found


@cache  # `isinstance` of an Equinox module takes a microsecond
def _is_of_modules(kind: type) -> bool:
    return issubclass(kind, eqx.Module)


_is_traced_module = cached_by_identity(is_traced)


class ConvertsItself:
    """A base class of Equinox modules that `solve` passes to a function unchanged, without converting their arrays to NumPy.

    Their methods convert numbers themselves, and cache results by the identity of the module, which a conversion would change.
    """


def _by_numpy(x: Any, is_module: bool = False) -> Any:
    if is_module:
        return x if isinstance(x, ConvertsItself) else by_numpy_arrays(x)
    return np.asarray(x) if isinstance(x, jax.Array) else x


@cached_by_identity  # the same object for the same module, so that what is computed from it is found again
def by_numpy_arrays(module: Module) -> Module:
    """Return a module of concrete numbers with NumPy arrays in place of JAX arrays; cached by the identity of the module."""
    return jax.tree.map(_by_numpy, module)


@defined
def _by_jax(function: Callable[..., Result], *arguments: Any) -> Result:
    return function(*arguments, BY_JAX)  # compared by identity: as an argument of a compiled function it would be a copy


@jax.custom_batching.custom_vmap
def _any_member(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """Return the condition; in a batch, True if it holds for any member."""
    return condition


@_any_member.def_vmap
def _(axis_size: int, batched: Any, condition: Bool[Array, "B"]) -> tuple[Bool[Array, ""], bool]:
    del axis_size, batched
    return jnp.any(condition), False


def cond_of_batch(condition: Bool[Array, ""], function: Callable[[], Result], otherwise: Callable[[], Result]) -> Result:
    """Return function() if the condition holds, else otherwise(), which should be cheap.

    A batch evaluates `function` only if the condition holds for at least one member. With `jax.lax.cond` alone, a batch would
    always evaluate both.
    """

    def selected() -> Result:
        return jax.tree.map(lambda x, y: jnp.where(condition, x, y), function(), otherwise())

    return jax.lax.cond(_any_member(condition), selected, otherwise)


def sequential(function: Callable[..., Result], *arguments: PyTree) -> Result:
    """Return function(*arguments) for pytrees of arrays and static values; under `vmap`, members are computed one after another.

    If loops were batched, all members would take as many iterations as the slowest one. The result has no derivatives.
    """
    arrays, choices = eqx.partition(arguments, eqx.is_array)

    @jax.custom_batching.custom_vmap
    def each(arrays: PyTree) -> Result:
        return function(*eqx.combine(arrays, choices))

    @each.def_vmap
    def _(axis_size: int, batched: PyTree, arrays: PyTree) -> tuple[Result, PyTree]:
        del axis_size
        moving, shared = eqx.partition(arrays, batched[0])
        results = jax.lax.map(lambda moving: each(eqx.combine(moving, shared)), moving)
        return results, jax.tree.map(lambda _: True, results)

    return each(arrays)
