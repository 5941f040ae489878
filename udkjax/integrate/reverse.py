"""Reverse-mode derivatives, whatever integrated."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from udkjax.integrate.problem import Problem, Raw


def reversible(problem: Problem, integrate: Callable[[Problem], Raw]) -> Raw:
    """`integrate(problem)`, with derivatives in reverse mode: those of the same problem by diffrax, which keeps checkpoints."""
    arrays, static = eqx.partition(problem, eqx.is_inexact_array)

    @jax.custom_vjp
    def run(arrays: Any) -> Raw:
        return integrate(eqx.combine(arrays, static))

    def again(arrays: Any) -> Any:
        from udkjax.integrate.by_diffrax import by_diffrax

        raw = by_diffrax(eqx.combine(arrays, static))
        return raw.ys, raw.y

    def backward(arrays: Any, cotangents: Raw) -> Any:
        return jax.vjp(again, arrays)[1]((cotangents.ys, cotangents.y))

    run.defvjp(lambda arrays: (run(arrays), arrays), backward)
    return run(arrays)
