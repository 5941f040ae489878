"""Reverse-mode derivatives, whatever integrated."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero

from udkjax.integrate.explicit import march
from udkjax.integrate.lanes import Lanes, number_of, raw_of, serves, solve, task_of
from udkjax.integrate.problem import Problem, Raw
from udkjax.integrate.record import Record
from udkjax.integrate.replay import walked_back


def reversible(problem: Problem, integrate: Callable[[Problem], Raw]) -> Raw:
    """`integrate(problem)`, with derivatives in reverse mode.

    Where our own engine serves, its steps are recorded and walked back (replay.py); under vmap each member's are recorded when it
    is walked back, not to keep them all. Else the derivatives are those of the same problem by diffrax, which keeps checkpoints.
    None are taken along numbers that do not depend on what is differentiated.
    """
    arrays, rest = eqx.partition(problem, eqx.is_inexact_array)
    # Counts and answers, such as whether a pivot of numbers alone is small, may be traced as well: no closure must hold them.
    discrete, static = eqx.partition(rest, eqx.is_array)
    replayed = serves(problem)

    @jax.custom_vjp
    def run(arrays: Any, discrete: Any) -> Raw:
        return integrate(eqx.combine(arrays, discrete, static))

    def forward(inputs: Any, others: Any) -> Any:
        values, discrete = (jax.tree.map(lambda x: x.value, given) for given in (inputs, others))
        # In shapes, not in the tree: JAX may take the residual of one call apart by the tree of another.
        moves = jax.tree.map(lambda x: jnp.zeros(int(x.perturbed)), inputs)
        problem = eqx.combine(values, discrete, static)
        raw, record = _recorded(problem) if replayed else (integrate(problem), None)
        return raw, (values, discrete, moves, raw, record)

    def backward(residual: Any, cotangents: Raw) -> Any:
        values, discrete, moves, raw, record = residual
        moving = eqx.filter(values, jax.tree.map(lambda x: x.size > 0, moves))
        problem = eqx.combine(values, discrete, static)
        q, v, y = (_instantiated(x) for x in (cotangents.q, cotangents.v, cotangents.y))
        if replayed:
            found = _pulled(problem, moving, raw, record, jnp.concatenate([q, v], axis=1), y)
        else:
            again = lambda moving: _by_diffrax(eqx.combine(moving, problem))  # noqa: E731
            found = jax.vjp(again, moving)[1]((q, v, y))[0]
        return eqx.combine(found, jax.tree.map(jnp.zeros_like, values)), None

    run.defvjp(forward, backward, symbolic_zeros=True)
    return run(arrays, discrete)


def _by_diffrax(problem: Problem) -> Any:
    from udkjax.integrate.by_diffrax import by_diffrax

    raw = by_diffrax(problem)
    return raw.q, raw.v, raw.y


def _instantiated(x: Any) -> Any:
    return jnp.zeros(x.shape) if isinstance(x, SymbolicZero) else x


def _marched(problem: Problem) -> tuple[Raw, Record]:
    lanes = Lanes(problem.equations)
    m = march(task_of(problem, lanes, recorded=True), problem.q, problem.v, number_of(problem.equations))
    assert m.record is not None
    return raw_of(problem, lanes, m), m.record


def _recorded(problem: Problem) -> tuple[Raw, Record]:
    """A run and its record; under vmap records are left blank, not to fill the memory: `_pulled` makes each where it needs it."""
    arrays, static = eqx.partition(problem, eqx.is_array)

    def single(arrays: Any) -> tuple[Raw, Record]:
        return _marched(eqx.combine(arrays, static))

    one = custom_vmap(single)

    @one.def_vmap
    def _(size, batched, arrays):
        del size
        found = jax.eval_shape(single, jax.tree.map(lambda x, b: x[0] if b else x, arrays, batched[0]))
        every = jax.tree.map(lambda _: any(jax.tree.leaves(batched)), found[0])
        if not any(jax.tree.leaves(batched)):  # only tangents are
            return single(arrays), (every, jax.tree.map(lambda _: False, found[1]))
        raw = jax.vmap(lambda arrays: solve(eqx.combine(arrays, static)), (_axes(batched[0]),))(arrays)
        blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), found[1])
        return (raw, blank), (every, jax.tree.map(lambda _: False, blank))

    return one(arrays)


def _pulled(problem: Problem, moving: Problem, raw: Raw, record: Record, ys: Any, y: Any) -> Problem:
    """The cotangents of what is `moving`."""
    arrays, static = eqx.partition(problem, eqx.is_array)
    moves = jax.tree.map(lambda x: x is not None, moving, is_leaf=lambda x: x is None)

    def single(arrays: Any, raw: Raw, record: Record, bars: Any) -> Problem:
        return walked_back(eqx.combine(arrays, static), eqx.filter(arrays, moves), raw, record, *bars)

    def again(arrays: Any, bars: Any) -> Problem:
        return single(arrays, *_marched(eqx.combine(arrays, static)), bars)

    return _of_members(single, again)(arrays, raw, record, (ys, y))


def _of_members(single: Callable, again: Callable) -> Callable:
    """`single(arrays, raw, record, bars)`; under vmap, where problems differ, `again(arrays, bars)` of one after another."""
    pulled = custom_vmap(lambda arrays, raw, record, bars: single(arrays, raw, record, bars))

    @pulled.def_vmap
    def _(size, batched, *inputs):
        if any(jax.tree.leaves(batched[0])):

            def member(k: Any) -> Problem:
                arrays, _, _, bars = jax.tree.map(lambda x, b: x[k] if b else x, inputs, tuple(batched))
                return again(arrays, bars)

            found = jax.lax.map(member, jnp.arange(size))
        elif any(jax.tree.leaves(batched[3])):  # of one problem; of one in a batch, if that of problems is the outer one
            axes = _axes(batched[3])
            found = _of_members(jax.vmap(single, (None, None, None, axes)), jax.vmap(again, (None, axes)))(*inputs)
        else:  # only tangents are
            found = single(*inputs)
        return found, jax.tree.map(lambda _: any(jax.tree.leaves(batched)), found)

    return pulled


def _axes(batched: Any) -> Any:
    return jax.tree.map(lambda b: 0 if b else None, batched)
