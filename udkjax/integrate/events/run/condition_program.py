"""Conditions of events as programs of scalars, for machine code."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import lru_cache
from types import FunctionType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.expressions import Graph, ScalarProgram, cotangents, read_jaxpr, tangents
from udkjax.integrate.events.law.conditions import BodyCondition, frames_of, sees_velocity
from udkjax.integrate.events.law.event import Event
from udkjax.integrate.events.law.kinks import Kink
from udkjax.integrate.events.law.phases import Switches
from udkjax.integrate.events.law.sticking_joints import forces_of
from udkjax.native.language.program import UnsupportedError, vector_function
from udkjax.native.watching.conditions import Conditions
from udkjax.programs.identity_cache import cached_by_identity, cached_by_size, is_concrete
from udkjax.requirements import tracing
from udkjax.wording import quote


def condition_numbers(events: Sequence[Event]) -> list[Array]:
    """Return the numbers of all events, in the order of the inputs of programs."""
    return jax.tree.leaves(eqx.filter(tuple(events), eqx.is_inexact_array))


def watched_conditions(events: Sequence[Event], mechanism: Any) -> Conditions | None:
    """Return the conditions of the events of a mechanism as programs; None if machine code lacks one of their operations."""
    return (_concrete_conditions if is_concrete(mechanism, *events) else _conditions)(mechanism, *events)


def _conditions(mechanism: Any, *events: Event) -> Conditions | None:
    names, by_velocity = mechanism.body_names, tuple(sees_velocity(e.condition, mechanism) for e in events)
    arrays, rest = eqx.partition(events, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)
    n, graph = mechanism.coordinate_count, Graph()

    def evaluate(t: Array, q: Any, v: Any, *numbers: Array) -> Array:
        return conditions_of(eqx.combine(jax.tree.unflatten(tree, numbers), rest), names, t, q, v)

    shapes = [(), (n,), (n,), *(np.shape(x) for x in leaves)]
    arguments = [input_array(graph, k, shape) for k, shape in enumerate(shapes)]
    g = list(trace_scalars(graph, evaluate, arguments, (1, 2) if names else ())[0].flat)
    (t,), q, v = (list(x.flat) for x in arguments[:3])
    a, numbers = list(input_array(graph, -1, (n,)).flat), [x for array in arguments[3:] for x in array.flat]
    one, zero = graph.constant(1.0), graph.constant(0.0)
    along = {t: one, **dict(zip((*q, *v), (*v, *a), strict=True))}
    rates = tangents(graph, g, along)
    second = [zero if no else x for no, x in zip(by_velocity, tangents(graph, rates, along), strict=True)]
    by_state = np.array([cotangents(graph, [x], [one], [t, *q, *v]) for x in g], object)
    parts = g, rates, second, by_state[:, 0], by_state[:, 1 : n + 1].flat, by_state[:, n + 1 :].flat
    inputs = [t, *q, *v, *a, *numbers]
    watched, at_state = (
        ScalarProgram(graph, inputs, [*g, *rates]),
        ScalarProgram(graph, inputs, [x for part in parts for x in part]),
    )
    try:
        text = "".join(_text(program) for program in (watched, at_state))
    except UnsupportedError:
        return None
    return Conditions(text, watched, at_state, len(numbers), by_velocity)


def _bytes_of(conditions: Conditions | None) -> int:
    """Return an estimate of the memory (bytes) of conditions, from the number of operations of their programs."""
    return 0 if conditions is None else 500 * (len(conditions.program.order) + len(conditions.at_state.order))


_conditions_for_structure = cached_by_size(_bytes_of, by_structure=True)(_conditions)


@cached_by_identity
def _concrete_conditions(mechanism: Any, *events: Event) -> Conditions | None:
    # Other conditions are functions, which may read anything: they are traced for each new event.
    if mechanism.has_bodies and all(isinstance(e.condition, BodyCondition | Kink) for e in events):
        return _conditions_for_structure(mechanism.without_origin, *events)
    return _conditions(mechanism, *events)


def with_forces(conditions: Conditions, events: Sequence[Event], switches: Switches, m: int) -> Conditions:
    """Return the conditions with a program for the forces of all contacts and joints that switches hold.

    The conditions are returned unchanged if there are none.

    Args:
        conditions: The conditions.
        events: All events.
        switches: The switches.
        m: The number of rows of Psi of the mechanism.
    """
    if max(switches.rows, default=-1) < 0:
        return conditions
    arrays, rest = eqx.partition(tuple(events), eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)
    graph = Graph()

    def evaluate(multipliers: list[Array], *numbers: Array) -> Array:
        found = eqx.combine(jax.tree.unflatten(tree, numbers), rest)
        return jnp.stack(list(forces_of(found, switches.rows, switches.joint_rows, multipliers).values()))

    shapes = [(m,), *(np.shape(x) for x in leaves)]
    arguments = [input_array(graph, k, shape) for k, shape in enumerate(shapes)]
    outputs = list(trace_scalars(graph, evaluate, arguments, (0,))[0].flat)
    multipliers, *numbers = (list(array.flat) for array in arguments)
    program = ScalarProgram(graph, [x for array in (*numbers, multipliers) for x in array], outputs)
    return replace(conditions, forces=program, force_key=_text(program))


class _Functions:
    """The conditions of events that are plain functions, None for other conditions; a key of a cache.

    Two lists are equal if their functions compute the same values, now and in later calls: they have equal programs and code, and
    refer to equal numbers and strings, or to identical objects.
    """

    def __init__(self, events: Sequence[Event], programs: Conditions):
        self.functions = [e.condition if isinstance(e.condition, FunctionType) else None for e in events]
        self._key = programs, tuple(f and _reference(f) for f in self.functions)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Functions) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def _reference(function: FunctionType) -> Hashable:
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    values = (*cells, *(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values())
    is_plain = [isinstance(x, int | float | str) for x in values]
    return (
        function.__code__,
        id(function.__globals__),
        *(x if plain else id(x) for x, plain in zip(values, is_plain, strict=True)),
    )


@lru_cache(maxsize=64)
def _first_of_equals(functions: _Functions) -> _Functions:
    return functions


def with_cached_functions(events: Sequence[Event], programs: Conditions) -> tuple[Event, ...]:
    """Return the events with condition functions replaced by equal ones of earlier calls, whose compiled code is then reused.

    A function defined within another is a new object in each call.
    """
    return (_share_concrete_functions if is_concrete(*events) else _share_functions)(programs, *events)


def _share_functions(programs: Conditions, *events: Event) -> tuple[Event, ...]:
    first = _first_of_equals(_Functions(events, programs)).functions
    return tuple(
        e if f is None or f is e.condition else eqx.tree_at(lambda e: e.condition, e, f)
        for e, f in zip(events, first, strict=True)
    )


_share_concrete_functions = cached_by_identity(_share_functions)


def input_array(graph: Graph, k: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return the k-th input of a graph, an array of scalars of this shape."""
    array = np.empty(shape, object)
    for index in np.ndindex(*shape):
        array[index] = graph.input((k, index), "condition")
    return array


def trace_scalars(
    graph: Graph, function: Callable[..., Any], arguments: Sequence[np.ndarray], listed: Sequence[int]
) -> list[np.ndarray]:
    """Return the outputs of a function of arrays, traced into a graph, as arrays of its scalars.

    Args:
        graph: The graph.
        function: The function.
        arguments: Its arguments, arrays of scalars of the graph.
        listed: The positions of arguments that the function receives as lists of numbers, whose entries take no operations.
    """
    given = [[np.asarray(x, object) for x in array] if k in listed else array for k, array in enumerate(arguments)]
    closed = jax.make_jaxpr(function)(*jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, float), given))
    return read_jaxpr(graph, closed, jax.tree.leaves(given))


def _text(program: ScalarProgram) -> str:
    return vector_function(program, "conditions", "in", "out").text()


def conditions_of(events: Sequence[Event], names: tuple[str, ...], t: Array, q: Any, v: Any) -> Float[Array, "E"]:
    """Return the values of the conditions of all events at a state; `names` are those of the bodies, () for a system."""
    arguments = (frames_of(names, q, v),) if names else (q, v)
    found = []
    for event in events:
        with tracing(f"the condition of the event {quote(event.name)}"):
            found.append(jnp.asarray(event.condition(t, *arguments), float))
    return jnp.stack(found)
