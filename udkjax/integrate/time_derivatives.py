"""Derivatives of a run along its times, for every integrator.

With the flow Phi of y' = f(t, y), the state at t_k of a run that begins at t_0 with y_0 is Phi(t_k; t_0, y_0), and

    d/dt_k = f(t_k, y_k),        d/dt_0 = -(dy_k/dy_0) f(t_0, y_0).

The run itself has fixed times: its first state and its outputs are moved along f for a time s that is zero, but has derivatives.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from udkjax.integrate.native_equations import equations_for_diffrax
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.programs.undefined import defined_along
from udkjax.programs.varying_axes import zero_of
from udkjax.transforms.gradients import stop_gradients
from udkjax.transforms.linear_map import DifferentiableFunction, Linear
from udkjax.transforms.traced_numbers import Mask, TreeOfNumbers, select, split_numbers


def run_of_times(run: Callable[[Problem], IntegratorOutput], problem: Problem) -> IntegratorOutput:
    """Return `run(problem)`, where q and v also have derivatives with respect to `problem.ts`, which those of `run` lack."""
    ts = stop_gradients(problem.ts)
    move = partial(moved, replace(problem, ts=ts))
    q, v = move(problem.ts[0], problem.q, problem.v, ts[0] - problem.ts[0])
    raw = run(replace(problem, ts=ts, q=q, v=v))
    qs, vs = jax.vmap(move)(ts, raw.q, raw.v, problem.ts - ts)
    return raw._replace(q=qs, v=vs)


def moved(
    problem: Problem, t: Float[Array, ""], q: Float[Array, "n"], v: Float[Array, "n"], s: Float[Array, ""]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Return the state (q, v) at t, moved along the motion for a time s that is zero: unchanged, but with derivatives by s."""
    problem_of, numbers = split_numbers(problem)
    # A state is batched wherever its changes are, since JAX requires that derivative rules return values with unchanged batching.
    zero = sum(map(zero_of, (s, t, *numbers)))
    q, v = _state_after(StateAfter(RatesOfState(problem_of)), [s, t, q + zero, v + zero, *numbers])
    return q, v


class Rates(eqx.Module):
    """A function that returns the rates x' of a list of arrays x."""

    @abstractmethod
    def __call__(self, x: list[Array]) -> list[Array]:
        """Return x' at x."""


class RatesOfState(Rates):
    """The rates of x = [t, q, v, *numbers]: [1, q', v', *zeros], since the numbers of a problem are constant."""

    problem: TreeOfNumbers

    def __call__(self, x: list[Array]) -> list[Array]:
        t, q, v, *numbers = x
        equations = equations_for_diffrax(self.problem(numbers))
        return [jnp.ones_like(t), *equations.rates(t, q, v), *map(jnp.zeros_like, numbers)]


class RatesOfChange(Rates):
    """The rates of [*x, *dx], where dx are small changes of x: with x' = r(x) they are [*r(x), *(dr/dx dx)]."""

    rates: Rates

    def __call__(self, x: list[Array]) -> list[Array]:
        half = len(x) // 2
        values, changes = jax.jvp(self.rates, (x[:half],), (x[half:],))
        return values + changes


class StateAfter(DifferentiableFunction):
    """The state [q, v] after a time s that is zero, as a function of [s, t, q, v, *numbers of a problem]."""

    rates: RatesOfState

    @property
    def orders(self) -> int:
        return 1

    def __call__(self, inputs: list[Array]) -> list[Array]:
        s, *x = inputs
        return _after(self.rates, x, s)[1:3]

    def shapes(self, inputs: list[Array]) -> list[tuple[int, ...]]:
        return [x.shape for x in inputs[2:4]]

    def forward(self, inputs: list[Array], active: Mask, tangents: list[Array], run: PyTree) -> list[Array]:
        del run
        remaining = iter(tangents)
        ds, _, *changes = [next(remaining) if m else None for m in active[:4]]
        changes = [jnp.zeros_like(x) if dx is None else dx for x, dx in zip(inputs[2:4], changes, strict=True)]
        if ds is None:
            return changes
        return [dx + rate * ds for dx, rate in zip(changes, self.rates(inputs[1:])[1:3], strict=True)]

    def backward(self, inputs: list[Array], active: Mask, cotangents: list[Array], run: PyTree) -> list[Array]:
        del run
        bars = [jnp.zeros_like(x) for x in inputs]
        bars[2:4] = cotangents
        if active[0]:
            bars[0] = sum((jnp.vdot(w, rate) for w, rate in zip(cotangents, self.rates(inputs[1:])[1:3], strict=True)), bars[0])
        return select(bars, active)


@eqx.filter_custom_jvp
def _state_after(function: StateAfter, inputs: list[Array]) -> list[Array]:
    del function
    return inputs[2:4]


@_state_after.def_jvp
def _(primals, tangents):
    function, inputs = primals
    active = tuple(dx is not None for dx in tangents[1])
    linear = Linear(function=function, inputs=inputs, run=(), active=active)
    values = _state_after(*primals)
    return values, defined_along(linear.applied, select(tangents[1], active), values)


@eqx.filter_custom_jvp
def _after(rates: Rates, x: list[Array], s: Float[Array, ""]) -> list[Array]:
    """Return x(s) of x' = rates(x) at s = 0: the value x, with forward-mode derivatives of x(s) of any order."""
    del rates, s
    return x


@_after.def_jvp
def _(primals, tangents):
    rates, x, s = primals
    _, dx, ds = tangents
    dx = [jnp.zeros_like(value) if d is None else d for value, d in zip(x, dx, strict=True)]
    x, change = _after(rates, x, s), _after(RatesOfChange(rates), x + dx, s)[len(x) :]
    if ds is not None:
        change = [d + rate * ds for d, rate in zip(change, rates(x), strict=True)]
    return x, change
