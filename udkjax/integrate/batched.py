"""What a batch of problems under vmap comes to: a function of all members, whatever of them is batched or has tangents."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from udkjax.integrate.problem import Problem, Raw
from udkjax.integrate.undifferentiated import undifferentiated

CHUNKED = ("cpu",)  # devices that take a batch in chunks; others take it whole


def one_by_one(problem: Problem, single: Callable[[Problem], Raw]) -> Raw:
    """Integrate one problem by `single`; under vmap one after another, where no member waits and a branch is one."""

    def many(arrays: Any, batched: Any, static: Any, size: int) -> Raw:
        def member(k: Array) -> Raw:
            return single(eqx.combine(jax.tree.map(lambda x, b: x[k] if b else x, arrays, batched), static))

        return jax.lax.map(member, jnp.arange(size))

    return batched(problem, single, many)


def batched(problem: Problem, single: Callable[[Problem], Raw], many: Callable[..., Raw]) -> Raw:
    """Integrate one problem by `single`; under vmap `many(arrays, batched, static, size)` of them together."""
    arrays, static = eqx.partition(problem, eqx.is_array)
    leaves, tree = jax.tree.flatten(arrays)

    @jax.custom_jvp
    def run(*leaves):
        return along(map(_has_tangents, leaves), leaves)

    @partial(run.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        moves = [not isinstance(dx, SymbolicZero) and dx.dtype != jax.dtypes.float0 for dx in tangents]
        moving, dx = ([x for x, m in zip(values, moves, strict=True) if m] for values in (primals, tangents))

        def function(*moving):
            some = iter(moving)
            return along(moves, [next(some) if m else x for x, m in zip(primals, moves, strict=True)])

        return jax.jvp(function, moving, dx)

    def along(moves: Iterable[bool], leaves: Sequence[Array]) -> Raw:
        """The run, of which only those leaves have tangents that are moving. The rule of `custom_vmap` gives all of them some."""
        moves = tuple(moves)

        def problem_of(leaves: Sequence[Array]) -> Any:
            return tree.unflatten([x if m else undifferentiated(x) for x, m in zip(leaves, moves, strict=True)])

        @custom_vmap
        def one(*leaves):
            return single(eqx.combine(problem_of(leaves), static))

        @one.def_vmap
        def _(size, batched, *leaves):
            every = Raw(*[any(batched)] * len(Raw._fields))
            if not any(batched):  # only tangents are
                return single(eqx.combine(problem_of(leaves), static)), every
            if jax.default_backend() in CHUNKED:
                return many(problem_of(leaves), tree.unflatten(batched), static, size), every
            axes = [0 if b else None for b in batched]
            return jax.vmap(lambda *leaves: single(eqx.combine(problem_of(leaves), static)), axes)(*leaves), every

        moving = sum(x.ravel()[0] for x, m in zip(leaves, moves, strict=True) if m and x.size)
        return one(*[_with_its_tangent(x, moving) if _has_tangents(x) else x for x in leaves])

    return run(*leaves)


def _has_tangents(x: Array) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)


@jax.custom_jvp
def _with_its_tangent(x: Array, moving: Array) -> Array:
    """The same, whose tangent is batched wherever it is itself, if there are tangents: `moving` has one if anything has.

    The rule of `custom_vmap` gives wrong shapes where of some arguments only the values are batched, of others the tangents too.
    """
    return x


@_with_its_tangent.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    x, dx = primals[0], tangents[0]
    return x, jnp.where(x == x, dx, dx)
