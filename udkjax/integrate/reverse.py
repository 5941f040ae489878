"""Reverse-mode derivatives of a march."""

from typing import Any

import diffrax
import equinox as eqx
import jax

from udkjax.integrate.by_diffrax import by_diffrax
from udkjax.integrate.lanes import solve
from udkjax.integrate.problem import Problem, Raw


def reversible(problem: Problem) -> Raw:
    """As `solve`, with derivatives in reverse mode."""
    arrays, static = eqx.partition(problem, eqx.is_inexact_array)

    @jax.custom_vjp
    def run(arrays: Any) -> Raw:
        return solve(eqx.combine(arrays, static))

    def again(arrays: Any) -> Any:
        raw = by_diffrax(eqx.combine(arrays, static), diffrax.RecursiveCheckpointAdjoint(), diffrax.NoProgressMeter())
        return raw.ys, raw.y

    def backward(arrays: Any, cotangents: Raw) -> Any:
        return jax.vjp(again, arrays)[1]((cotangents.ys, cotangents.y))

    run.defvjp(lambda arrays: (run(arrays), arrays), backward)
    return run(arrays)
