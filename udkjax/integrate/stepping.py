"""One control interval with held inputs, from one state to the next, for control loops."""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from udkjax.annotations import NumberLike, Numbers
from udkjax.arrays import is_traced, is_within_jit, make_module, number
from udkjax.devices import on_host
from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.general import ConstrainedSystem
from udkjax.integrate.compiled_mechanism import compile_mechanism
from udkjax.integrate.derivatives import differentiable
from udkjax.integrate.prepare import AUTO, DRIFT_PROJECTED, Choices, prepare_run
from udkjax.integrate.projection import Projection
from udkjax.integrate.simulate import simulate
from udkjax.positions.assembly import State
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.gradients import stop_gradients

STORED_POINTS = 6  # accepted steps of an interval stored for reverse mode; with more the interval is integrated again
MOST_STEPS_OF_INTERVAL = 1_000  # default


@checked
def step(
    mechanism: Mechanism | ConstrainedSystem,
    state: State,
    inputs: Mapping[str, Numbers] | None,
    dt: NumberLike,
    t: NumberLike = 0.0,
    rtol: NumberLike = 1e-8,
    atol: NumberLike = 1e-8,
    max_steps: int = MOST_STEPS_OF_INTERVAL,
    analysis: Analysis | None = None,
    engine: Literal["auto", "native", "diffrax", "jax"] = "auto",
) -> State:
    """Return the state one control interval later, with inputs held constant.

    For `jax.lax.scan`, jit, vmap and grad: all numbers may be traced. The integrator chooses its steps within the interval;
    the first step tried is the whole interval. The state is not assembled: projection keeps states on the constraints, so begin
    with a state from `assemble`. If all inputs are known beforehand, `simulate` with a `Held` is faster.

    Args:
        mechanism: the mechanism, or a `ConstrainedSystem`, whose functions hold the inputs.
        state: the state at the beginning.
        inputs: values of parameters by name, as in `with_parameters`, such as {"force.motor.value": 1.5}; None: no inputs.
        dt: the length of the interval (s), greater than zero.
        t: the time at its beginning (s), for drivers and everything else that depends on time.
        rtol: relative tolerance, as in `simulate`.
        atol: absolute tolerance, as in `simulate`.
        max_steps: the largest number of steps tried.
        analysis: the mechanism's `Analysis`; by default computed here.
        engine: engine, as in `simulate`.

    Returns:
        The `State` at t + dt; in a traced call NaN if the end was not reached.

    Raises:
        SimulationError: all numbers are concrete, and the end was not reached.
        SceneError: a name in `inputs` is not a parameter, or a value has another shape.
        ValueError: there are inputs for a `ConstrainedSystem`.
    """
    if inputs and isinstance(mechanism, ConstrainedSystem):
        raise ValueError("inputs are for mechanisms: make a ConstrainedSystem of functions that hold the inputs of the interval")
    moved: Any = mechanism.traced(np.size(state.q)) if isinstance(mechanism, ConstrainedSystem) else mechanism
    values, has_fixed_times = dict(inputs or {}), not (isinstance(t, Tracer) or isinstance(dt, Tracer))
    numbers = {"dt": dt, "t": t, "rtol": rtol, "atol": atol}
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((moved, state, values, numbers, analysis))):
        analysis = analysis or _analysis_of(moved)
        if is_within_jit():
            return _advance(moved, analysis, state, values, numbers, max_steps, engine, has_fixed_times)
        values, numbers = ({name: number(x) for name, x in given.items()} for given in (values, numbers))
        return _advance_at_once(moved.without_origin, analysis, state, values, numbers, max_steps, engine, has_fixed_times)
    split = _parts(moved, analysis)
    run = _program(split.form, max_steps, engine)
    q, v = run(split.leaves, state.q, state.v, {k: np.asarray(x, float) for k, x in values.items()}, numbers)
    if not np.isfinite(np.asarray(q)).all():
        ts = np.asarray(t, float) + np.array([0.0, 1.0]) * np.asarray(dt, float)
        tolerances: Any = {"rtol": rtol, "atol": atol, "dt0": dt, "max_steps": max_steps}
        given = moved.with_parameters(values) if values else mechanism
        run = simulate(given, ts, state, **tolerances, engine=engine)  # raises, with the cause
        return State(run.q[-1], run.v[-1])
    return make_module(State, q=q, v=v)


def _advance(
    mechanism: Any,
    analysis: Analysis | None,
    state: State,
    values: Mapping[str, Numbers],
    numbers: Mapping[str, NumberLike],
    max_steps: int,
    engine: str,
    has_fixed_times: bool,
) -> State:
    dt, t, rtol, atol = (number(numbers[name]) for name in ("dt", "t", "rtol", "atol"))
    moved = mechanism.with_parameters(values).without_origin if values else mechanism.without_origin
    is_concrete = not isinstance(t, Tracer) and not isinstance(dt, Tracer)  # concrete even while something else is traced
    ts = number(np.array([float(t), float(t) + float(dt)])) if is_concrete else jnp.stack([t, t + dt])
    choices = Choices(rtol, atol, DRIFT_PROJECTED, dt, AUTO, Projection(), max_steps=max_steps, engine=engine)
    compiled = compile_mechanism(moved, analysis, *choices.of_mechanism)
    run = prepare_run(compiled, analysis, ts, state, None, choices)
    raw = differentiable(replace(run.problem, points=STORED_POINTS), has_fixed_times)
    good = stop_gradients(run.is_usable & raw.reached[-1] & jnp.isinf(raw.lost))
    failed = jnp.where(good, 0.0, jnp.nan)  # added, since `where` would store one more array for reverse mode
    return State(*((y[-1] + failed).reshape(np.shape(state.q)) for y in (raw.q, raw.v)))


_advance_at_once = deferred(_advance)


def _analysis_of(mechanism: Any) -> Analysis | None:
    """Return the analysis of a mechanism; a user-defined system has none."""
    return analyse(mechanism) if isinstance(mechanism, Mechanism) else None


class MechanismParts(NamedTuple):
    """A mechanism and its analysis, split into structure and numbers."""

    form: Hashable  # the tree structure
    leaves: list[Any]  # arrays


@cached_by_identity
def _parts(mechanism: Any, analysis: Analysis | None) -> MechanismParts:
    """Return the parts of a mechanism, cached for all of its steps."""
    leaves, form = jax.tree.flatten((mechanism.without_origin, analysis or _analysis_of(mechanism)))
    return MechanismParts(form, leaves if is_traced(leaves) else [np.asarray(x) for x in leaves])


@lru_cache(maxsize=64)
def _program(form: Any, max_steps: int, engine: str) -> Callable[..., tuple[Array, Array]]:
    """Return the step as a program for all mechanisms with one structure."""

    def run(leaves: list[Array], q: Array, v: Array, values: dict[str, Array], numbers: dict[str, Array]) -> tuple[Array, Array]:
        mechanism, analysis = jax.tree.unflatten(form, leaves)
        end = _advance(mechanism, analysis, State(q, v), values, numbers, max_steps, engine, has_fixed_times=False)
        return end.q, end.v  # pyright: ignore[reportReturnType]

    return on_host(jax.jit(run))
