"""Conditions of events as programs of scalars, for machine code."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.expressions import Graph, ScalarProgram, read_jaxpr
from udkjax.integrate.events.conditions import frames_of
from udkjax.integrate.events.event import Event
from udkjax.native.conditions import Conditions
from udkjax.native.program import UnsupportedError, consecutive, write
from udkjax.scene.identity_cache import cached_by_identity


class ConditionPrograms(NamedTuple):
    """The programs of the conditions of some events."""

    watched: Conditions  # and their rates, for machine code
    derivatives: ScalarProgram  # each condition, then its derivatives by t, q and v, of t, q, v and the numbers of the events


def condition_numbers(events: Sequence[Event]) -> list[Array]:
    """Return the numbers of all events, in the order in which programs take them."""
    return jax.tree.leaves(eqx.filter(tuple(events), eqx.is_inexact_array))


def condition_programs(events: Sequence[Event], names: Sequence[str]) -> ConditionPrograms | None:
    """Return the programs of the conditions of events of bodies; None where machine code has no instruction for one."""
    known = not any(isinstance(x, Tracer) for x in condition_numbers(events))
    return _known_programs(tuple(names), *events) if known else _programs(tuple(names), *events)


def _programs(names: tuple[str, ...], *events: Event) -> ConditionPrograms | None:
    arrays, rest = eqx.partition(events, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)
    n = 3 * len(names)

    def of(numbers: Sequence[Array]) -> Callable[..., Array]:
        given = eqx.combine(jax.tree.unflatten(tree, numbers), rest)
        return lambda t, q, v: conditions_of(given, names, t, q, v)

    def with_rates(t: Array, q: Array, v: Array, a: Array, *numbers: Array) -> Array:
        return jnp.stack(jax.jvp(of(numbers), (t, q, v), (jnp.ones(()), v, a)))

    def with_derivatives(t: Array, q: Array, v: Array, *numbers: Array) -> Array:
        along = lambda d: jax.jvp(of(numbers), (t, q, v), (d[0], d[1 : n + 1], d[n + 1 :]))[1]  # noqa: E731
        return jnp.concatenate([of(numbers)(t, q, v)[:, None], jax.vmap(along)(np.eye(1 + 2 * n)).T], axis=1)

    state, shapes = [(), (n,), (n,)], [np.shape(x) for x in leaves]
    watched = _scalar_program(with_rates, [*state, (n,), *shapes])
    places = consecutive("in", len(watched.inputs)), consecutive("out", len(watched.outputs))
    try:
        text = write(watched, "conditions", 1, ("in", "out"), *places).text()
    except UnsupportedError:
        return None
    count = len(watched.inputs) - 1 - 3 * n
    return ConditionPrograms(Conditions(text, watched, len(events), count), _scalar_program(with_derivatives, [*state, *shapes]))


_known_programs = cached_by_identity(_programs)


def _scalar_program(function: Callable[..., Array], shapes: Sequence[tuple[int, ...]]) -> ScalarProgram:
    """Return a function of arrays of some shapes as a program of all their entries, one after another."""
    closed, graph, inputs = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(shape, float) for shape in shapes)), Graph(), []
    for k, shape in enumerate(shapes):
        array = np.empty(shape, object)
        for place in np.ndindex(*shape):
            array[place] = graph.input((k, place), "condition")
        inputs.append(array)
    return ScalarProgram(graph, [x for array in inputs for x in array.flat], list(read_jaxpr(graph, closed, inputs)[0].flat))


def conditions_of(events: Sequence[Event], names: Sequence[str], t: Array, q: Array, v: Array) -> Float[Array, "E"]:
    """Return the conditions of all events at a state."""
    frames = frames_of(names, q, v)
    return jnp.stack([jnp.asarray(e.condition(t, frames), float) for e in events])
