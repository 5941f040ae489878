"""One control interval with held inputs, from one state to the next, for control loops."""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from udkjax.annotations import NumberLike, Numbers
from udkjax.argument_types import BY_NAME, COUNT, NOT_NEGATIVE, POSITIVE
from udkjax.arrays import float_type, is_traced, is_within_jit, make_module, number, stored
from udkjax.devices import on_host
from udkjax.equations.rows.analysis import Analysis, analysis_of
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.integrate.compiled_mechanism import compile_mechanism
from udkjax.integrate.derivatives import differentiable
from udkjax.integrate.prepare import AUTO, DRIFT_PROJECTED, Choices, may_stick, prepare_run
from udkjax.integrate.projection import Projection
from udkjax.integrate.simulate import simulate
from udkjax.positions.assembling.assembly import State
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity, is_concrete
from udkjax.programs.undefined import defined
from udkjax.requirements import ArgumentTypeError, describe
from udkjax.scene.arguments import checked
from udkjax.scene.elements.held import Held
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.gradients import stop_gradients

STORED_POINTS = 6  # accepted steps of an interval stored for reverse mode; with more the interval is integrated again
MOST_STEPS_OF_INTERVAL = 1_000  # default


@checked
def step(
    mechanism: Mechanism | ConstrainedSystem,
    state: State,
    inputs: Annotated[Mapping[str, Numbers], BY_NAME] | None,
    dt: Annotated[NumberLike, POSITIVE],
    t: NumberLike = 0.0,
    rtol: Annotated[NumberLike, NOT_NEGATIVE] = 1e-8,
    atol: Annotated[NumberLike, NOT_NEGATIVE] = 1e-8,
    max_steps: Annotated[int, COUNT] = MOST_STEPS_OF_INTERVAL,
    analysis: Analysis | None = None,
    engine: Literal["auto", "native", "diffrax", "jax"] = "auto",
) -> State:
    """Return the state one control interval later, with inputs held constant.

    For `jax.lax.scan`, jit, vmap and grad: all numbers may be traced. The integrator chooses its steps within the interval;
    the first step tried is the whole interval. The state is not assembled: projection keeps states on the constraints, so begin
    with a state from `assemble`. If all inputs are known beforehand, `simulate` with a `Held` is faster. With set-valued
    friction an interval is a run with events, in which joints stick and slip: it takes milliseconds, and has first derivatives,
    but none with respect to t and dt.

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
        TypeError: an input is a `Held`.
    """
    Analysis.require_masses(mechanism, "free motions")
    moved: Any = mechanism
    if isinstance(mechanism, ConstrainedSystem):
        if inputs:
            cure = "make a ConstrainedSystem of functions that hold the inputs of the interval"
            mechanism.require_bodies(f"inputs are for mechanisms: {cure}")
        moved = mechanism.traced(np.size(state.q))
    values, others = _checked_inputs(inputs), {"dt": dt, "t": t, "rtol": rtol, "atol": atol}
    if not is_concrete(moved, analysis) or is_traced((state.q, state.v, values, others)):
        if may_stick(moved):
            return _step_by_run(mechanism, state, values, dt, t, rtol, atol, max_steps, analysis, engine)
        analysis, has_fixed_times = analysis or analysis_of(moved), not is_traced((t, dt))
        if is_within_jit():
            return _advance(moved, analysis, state, values, others, max_steps, engine, has_fixed_times)
        values, others = ({name: number(x) for name, x in given.items()} for given in (values, others))
        moved = moved.without_origin_beside(tuple(values))
        return _advance_at_once(moved, analysis, state, values, others, max_steps, engine, has_fixed_times)
    steps = _steps_of(moved, analysis, *values)
    if not steps.sticks:
        q, v = steps.program(moved, values, np.shape(state.q), max_steps, engine)(state, values, others)
        if np.isfinite(np.asarray(q)).all():
            return make_module(State, q=q, v=v)
    # If the end was not reached, this run raises the error, with the cause.
    return _step_by_run(mechanism, state, values, dt, t, rtol, atol, max_steps, analysis, engine)


def _step_by_run(
    mechanism: Any,
    state: State,
    values: Mapping[str, Numbers],
    dt: NumberLike,
    t: NumberLike,
    rtol: NumberLike,
    atol: NumberLike,
    max_steps: int,
    analysis: Analysis | None,
    engine: Literal["auto", "native", "diffrax", "jax"],
) -> State:
    """Return the state after an interval by `simulate`, which locates where joints stick and slip, and explains failures."""
    given = mechanism.with_parameters(values) if values else mechanism
    xp = jnp if is_traced((t, dt)) else np
    start, length = xp.asarray(t, float), xp.asarray(dt, float)
    ts = xp.stack([start, start + length])
    tolerances: Any = {"rtol": rtol, "atol": atol, "dt0": dt, "max_steps": max_steps}
    run = simulate(given, ts, state, **tolerances, analysis=analysis, engine=engine)
    return State(run.q[-1], run.v[-1])


def _checked_inputs(inputs: Any) -> dict[str, Any]:
    """Return the inputs of an interval as a dict; raise `ArgumentTypeError` if they are no mapping, or one varies as a `Held`."""
    if not inputs:
        return {}
    if not isinstance(inputs, Mapping):
        raise ArgumentTypeError(f"inputs must map names of parameters to numbers, {describe(inputs)}")
    for name, value in inputs.items():
        if isinstance(value, Held):
            raise ArgumentTypeError(f"inputs[{name!r}] is a Held, and an input is constant: give its value, or use udk.simulate")
    return dict(inputs)


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
    good = stop_gradients(run.is_usable & raw.reached[-1] & jnp.isinf(raw.first_drifted))
    failed = jnp.where(good, 0.0, jnp.nan)  # added, since `where` would store one more array for reverse mode
    return State(*(defined(jnp.add)(y[-1], failed).reshape(np.shape(state.q)) for y in (raw.q, raw.v)))


_advance_at_once = deferred(_advance)


class _Steps:
    """Programs that integrate one interval of a concrete mechanism, one for each form of inputs and states met so far.

    A program takes two arrays, the numbers of the mechanism and everything else, since each array costs microseconds in a call.
    """

    def __init__(self, mechanism: Any, analysis: Analysis | None):
        self.sticks = may_stick(mechanism)
        leaves, self._form = jax.tree.flatten((mechanism, analysis))
        leaves = [np.asarray(x) for x in leaves]
        self._kinds = tuple((x.shape, x.dtype) for x in leaves)
        parts = [np.zeros(0, float_type()), *(x.ravel().astype(float_type()) for x in leaves)]  # a system may have no numbers
        self._numbers = stored(np.concatenate(parts))
        self._programs: dict[Hashable, Callable[..., tuple[Array, Array]]] = {}

    def program(
        self, mechanism: Any, values: Mapping[str, Any], shape: tuple[int, ...], max_steps: int, engine: str
    ) -> Callable[..., tuple[Array, Array]]:
        """Return a function (state, values, others) -> (q, v) for states and inputs of these shapes.

        Inputs that do not fit the mechanism raise an error.
        """
        shapes = tuple((name, np.shape(x)) for name, x in values.items())
        key = shapes, shape, max_steps, engine
        if key not in self._programs:
            if values:
                mechanism.with_parameters(values)  # raises the error here, and not while JAX traces
            program, numbers = _program(self._form, self._kinds, *key), self._numbers

            def run(state: State, values: Mapping[str, Any], others: Mapping[str, Any]) -> tuple[Array, Array]:
                given = (state.q, state.v, *others.values(), *values.values())
                return program(numbers, np.concatenate([np.asarray(x, float).ravel() for x in given]))

            self._programs[key] = run
        return self._programs[key]


@cached_by_identity
def _steps_of(mechanism: Any, analysis: Analysis | None, *names: str) -> _Steps:
    """Return the programs of a mechanism with inputs of these names; all steps of the mechanism share one object."""
    return _Steps(mechanism.without_origin_beside(names), analysis or analysis_of(mechanism))


@lru_cache(maxsize=64)
def _program(
    form: Any,
    kinds: tuple[tuple[tuple[int, ...], np.dtype], ...],
    inputs: tuple[tuple[str, tuple[int, ...]], ...],
    shape: tuple[int, ...],
    max_steps: int,
    engine: str,
) -> Callable[..., tuple[Array, Array]]:
    """Return the program (numbers, given) -> (q, v) of an interval, for all mechanisms of one structure.

    Args:
        form: the tree structure of the mechanism and its analysis.
        kinds: the shapes and types of their leaves, which are concatenated in `numbers`.
        inputs: the names and shapes of the inputs.
        shape: the shape of q and v.
        max_steps: the largest number of steps tried.
        engine: as in `simulate`.
    """

    def run(numbers: Array, given: Array) -> tuple[Array, Array]:
        shapes = [shape, shape, *4 * [()], *(x for _, x in inputs)]
        q, v, dt, t, rtol, atol, *values = split_array(given, shapes)
        leaves = [x.astype(kind) for x, (_, kind) in zip(split_array(numbers, [x for x, _ in kinds]), kinds, strict=True)]
        mechanism, analysis = jax.tree.unflatten(form, leaves)
        others = {"dt": dt, "t": t, "rtol": rtol, "atol": atol}
        named = {name: value for (name, _), value in zip(inputs, values, strict=True)}
        end = _advance(mechanism, analysis, State(q, v), named, others, max_steps, engine, has_fixed_times=False)
        return end.q, end.v  # pyright: ignore[reportReturnType]

    return on_host(jax.jit(run))


def split_array(array: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Return consecutive parts of a vector as arrays of these shapes."""
    ends = np.cumsum([math.prod(shape) for shape in shapes], dtype=int)
    return [x.reshape(shape) for x, shape in zip(jnp.split(array, ends)[:-1], shapes, strict=True)]
