"""One control interval: from a state and inputs that are held to the next state, for loops that decide as they go."""

import weakref
from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from udkjax.annotations import Numbers, Scalar
from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.quantities import equations_of
from udkjax.integrate.assembly import State
from udkjax.integrate.derivatives import differentiable
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.native_engine import reason_for_diffrax
from udkjax.integrate.outcome import usable
from udkjax.integrate.problem import Problem
from udkjax.integrate.simulate import DRIFT_PROJECTED, simulate, units_of_run
from udkjax.native.steps import LEAST_ATOL, SMALLEST_STEP
from udkjax.pinv import Auto
from udkjax.scene.arguments import checked
from udkjax.scene.checks import traced_numbers_hold
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism

POINTS = 6  # accepted steps of one interval that reverse mode has stored; of more than that it runs again
MAX_STEPS = 1_000


@checked
def step(
    mechanism: Mechanism,
    state: State,
    inputs: Mapping[str, Numbers] | None,
    dt: Scalar,
    t: Scalar = 0.0,
    rtol: Scalar = 1e-8,
    atol: Scalar = 1e-8,
    max_steps: int = MAX_STEPS,
    analysis: Analysis | None = None,
    engine: Literal["auto", "native", "diffrax"] = "auto",
) -> State:
    """Return the state one control interval later, with inputs that are held throughout it.

    For `jax.lax.scan`, jit, vmap and grad: all numbers may be traced. The integrator chooses its own steps within the interval,
    the first of which is all of it. Nothing is assembled: states stay on the constraints by projection, so begin with one of
    `assemble`. Whoever knows all inputs beforehand may give them to `simulate` as a `Held`, which takes less time.

    Args:
        mechanism: the mechanism.
        state: the state at the beginning.
        inputs: values of parameters by name, as in `with_parameters`, such as {"force.motor.value": 1.5}; None: there are none.
        dt: the length of the interval (s), greater than zero.
        t: the time at its beginning (s), for drivers and whatever else depends on time.
        rtol: relative tolerance, as in `simulate`.
        atol: absolute tolerance, as in `simulate`.
        max_steps: the largest number of steps that are tried.
        analysis: that of `analyse`, by default made here.
        engine: as in `simulate`.

    Returns:
        The `State` at t + dt; while traced, not a number where the end was not reached.

    Raises:
        SimulationError: all numbers are known, and the end was not reached.
        SceneError: `inputs` names no parameter, or a value of another shape.
    """
    values = dict(inputs or {})
    numbers = {"dt": dt, "t": t, "rtol": rtol, "atol": atol}
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((mechanism, state, values, numbers, analysis))):
        return _advance(mechanism, analysis or analyse(mechanism), state, values, numbers, max_steps, engine)
    compiled = _compiled(mechanism, analysis)
    run = _program(compiled.form, max_steps, engine)
    found = State.__new__(State)
    q, v = run(compiled.leaves, state.q, state.v, {k: np.asarray(x, float) for k, x in values.items()}, numbers)
    object.__setattr__(found, "q", q)
    object.__setattr__(found, "v", v)
    if not np.isfinite(np.asarray(q)).all():
        ts = np.asarray(t, float) + np.array([0.0, 1.0]) * np.asarray(dt, float)
        tolerances: Any = {"rtol": rtol, "atol": atol, "dt0": dt, "max_steps": max_steps}
        run = simulate(mechanism.with_parameters(values), ts, state, **tolerances, engine=engine)  # raises, with the cause
        return State(run.q[-1], run.v[-1])
    return found


def _advance(
    mechanism: Mechanism,
    analysis: Analysis,
    state: State,
    values: Mapping[str, Numbers],
    numbers: Mapping[str, Scalar],
    max_steps: int,
    engine: str,
) -> State:
    dt, t, rtol, atol = (number(numbers[name]) for name in ("dt", "t", "rtol", "atol"))
    moved = mechanism.with_parameters(values).without_origin if values else mechanism.without_origin
    known = not isinstance(t, Tracer) and not isinstance(dt, Tracer)  # and stays so while something else is traced
    ts = number(np.array([float(t), float(t) + float(dt)])) if known else jnp.stack([t, t + dt])
    equations, q, v = equations_of(moved, Auto(), analysis=analysis), jnp.ravel(state.q), jnp.ravel(state.v)
    smallest = SMALLEST_STEP * np.finfo(float).eps * jnp.max(jnp.abs(ts))
    length, rate = units_of_run(analysis, ts, v, jnp)
    problem = Problem(
        equations=equations,
        ts=ts,
        q=q,
        v=v,
        rtol=rtol,
        atol=jnp.maximum(atol, LEAST_ATOL),
        smallest=smallest,
        h=dt,
        length=length,
        rate=rate,
        solver=None,
        projected=equations.constrained,
        max_steps=max_steps,
        breakpoints=moved.breakpoints,
        points=POINTS,
    )
    why = engine == "diffrax" or reason_for_diffrax(problem)
    if engine == "native" and why:
        raise ValueError(f'engine="native" cannot: {why}. engine="auto" takes diffrax instead')
    raw = differentiable(problem, native=not why)
    good = usable(*stop_gradients((q, v, rtol, atol, number(DRIFT_PROJECTED), dt))) & traced_numbers_hold(moved.elements)
    good = stop_gradients(good & raw.reached[-1] & (jnp.max(raw.violation) <= DRIFT_PROJECTED))
    failed = jnp.where(good, 0.0, jnp.nan)  # added: a choice would be one more thing to store for reverse mode
    return State(*((y[-1] + failed).reshape(np.shape(state.q)) for y in (raw.q, raw.v)))


class Compiled(NamedTuple):
    """A mechanism and its analysis, taken apart."""

    mechanism: "weakref.ref[Mechanism]"
    analysis: Analysis | None  # that was given: while it is here no other has its identity
    form: Hashable  # all but the numbers
    leaves: list[Array]


_compiled_mechanisms: dict[tuple[int, int], Compiled] = {}


def _compiled(mechanism: Mechanism, analysis: Analysis | None) -> Compiled:
    """Return a mechanism taken apart: once, however many steps it takes."""
    key = id(mechanism), id(analysis)
    found = _compiled_mechanisms.get(key)
    if found is None or found.mechanism() is not mechanism:
        leaves, form = jax.tree.flatten((mechanism.without_origin, analysis or analyse(mechanism)))
        reference = weakref.ref(mechanism, lambda _: _compiled_mechanisms.pop(key, None))
        found = _compiled_mechanisms[key] = Compiled(reference, analysis, form, leaves)
    return found


@lru_cache(maxsize=64)
def _program(form: Any, max_steps: int, engine: str) -> Callable[..., tuple[Array, Array]]:
    """Return the step as one program for all mechanisms of a structure."""

    def run(leaves: list[Array], q: Array, v: Array, values: dict[str, Array], numbers: dict[str, Array]) -> tuple[Array, Array]:
        mechanism, analysis = jax.tree.unflatten(form, leaves)
        found = _advance(mechanism, analysis, State(q, v), values, numbers, max_steps, engine)
        return found.q, found.v  # pyright: ignore[reportReturnType]

    return jax.jit(run)
