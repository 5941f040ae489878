"""Jumps and kinks of forces that the state decides, as events of their own: a step ends there, and derivatives pass through.

A force with comparisons of the state becomes a `HeldForce`: the sides of its comparisons are numbers, with which its loads are
smooth, also beyond the crossing (expressions/kinks.py). Where a condition falls through zero, its side turns.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.equations.elements import traced_loads
from udkjax.expressions import ScalarProgram, smooth_pieces
from udkjax.integrate.events.actions import Action
from udkjax.integrate.events.event import Event
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.bodies import GROUND, Frame
from udkjax.scene.element_setup import attached_bodies
from udkjax.scene.forces import ForceElement
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote

FREE = np.inf  # a side that is not held
MOST_KINKS = 256  # of a run; then sides are no longer held, as a run at rest where a force jumps would make no progress


class SmoothLoads:
    """The programs of all force elements of one structure; compared by identity, so that equal elements share compiled code."""

    def __init__(self, traced: Any, breaks: bool):
        graph, pieces = traced.graph, smooth_pieces(traced.graph, traced.loads, ("q", "v") if breaks else ("q", "v", "time"))
        self.kind, self.count, self.has_opaque = traced.kind, len(pieces.sides), pieces.has_opaque
        inputs = [*traced.inputs, *pieces.sides]
        self.loads = ScalarProgram(graph, inputs, pieces.outputs)
        self.conditions = [ScalarProgram(graph, inputs, [way.condition]) for way in pieces.ways]
        self.turns = [(way.side, way.factor, way.shift) for way in pieces.ways]
        self.renewal = ScalarProgram(graph, inputs, pieces.renewed)
        self.by_velocity = [any(map(program.uses, traced.velocities)) for program in self.conditions]

    def values(self, element: Any, sides: Any, t: Any, frames: Sequence[Frame]) -> list[Any]:
        """Return the values of the inputs."""
        numbers = [x for leaf in jax.tree.leaves(element) for x in jnp.ravel(leaf)]
        moving = [f for f, fixed in zip(frames, self.kind.ground, strict=True) if not fixed]
        q, v = ([getattr(f, x) for f in moving for x in names] for names in (("x", "y", "angle"), ("vx", "vy", "omega")))
        return [*numbers, t, *q, *(0.0 if x is None else x for x in v), *sides]


# The smooth loads of traced loads; an element with breakpoints in time has no other kinks in time.
smooth_loads = lru_cache(maxsize=256)(SmoothLoads)


class HeldForce(ForceElement):
    """A force element whose comparisons of the state have given sides."""

    element: Any
    sides: Float[Array, "k"]
    smooth: SmoothLoads = eqx.field(static=True)

    def loads(self, t, *frames):
        values = iter(self.smooth.loads(self.smooth.values(self.element, self.sides, t, frames)))
        return [(0.0, 0.0, 0.0) if fixed else (next(values), next(values), next(values)) for fixed in self.smooth.kind.ground]

    @property
    def breakpoints(self):
        return self.element.breakpoints


class Kink(eqx.Module):
    """The condition under which a comparison keeps its side: positive, and falling where it changes."""

    bodies: tuple[str, ...] = eqx.field(static=True)
    element: Any
    sides: Float[Array, "k"]
    smooth: SmoothLoads = eqx.field(static=True)
    index: int = eqx.field(static=True)

    def __call__(self, t, frames):
        found = [frames[name] for name in self.bodies]
        if self.smooth.by_velocity[self.index] and any(f.vx is None for f in found):
            raise TypeError("the condition depends on velocities")
        return self.smooth.conditions[self.index](self.smooth.values(self.element, self.sides, t, found))[0]


class TurnSide(Action):
    """Turn a side: the number `side` of all sides becomes `factor` times itself plus `shift`."""

    side: int = eqx.field(static=True)
    factor: float = eqx.field(static=True)
    shift: float = eqx.field(static=True)

    changes = False

    @property
    def turn(self):
        return self.side, self.factor, self.shift


class HeldElement(NamedTuple):
    """A force element with held sides, by index among the forces of a mechanism; hashable."""

    force: int
    smooth: SmoothLoads
    bodies: tuple[int, ...]  # indices of the bodies that move
    first: int  # index of its first side
    event: int  # index of the first of its events, counted from the first kink

    @property
    def sides(self) -> slice:
        return slice(self.first, self.first + self.smooth.count)


def with_sides(events: Sequence[Event], sides: Float[Array, "S"], held: Sequence[HeldElement]) -> tuple[Event, ...]:
    """Return events with the sides in the conditions of kinks, the last events."""
    result, first = list(events), len(events) - sum(len(x.smooth.turns) for x in held)
    for element in held:
        for k in range(first + element.event, first + element.event + len(element.smooth.turns)):
            result[k] = eqx.tree_at(lambda e: e.condition.sides, result[k], sides[element.sides])
    return tuple(result)


class FoundKinks(NamedTuple):
    """The kinks of a mechanism's forces, as far as they are known before a run."""

    are_held: bool  # whether a force has kinks that can be located
    others: tuple[str, ...]  # forces with kinks that cannot

    def remark(self, by_steps: str) -> str:
        """Return whether kinks are located, as text; empty without any. A run `by_steps` locates none."""
        if by_steps and (self.are_held or self.others):
            return f"not located {by_steps}"
        unseen = f"not located in {', '.join(map(quote, self.others))}" if self.others else ""
        return ", ".join(filter(None, ["located" if self.are_held else "", unseen]))


def kinks_of(mechanism: Mechanism) -> FoundKinks:
    """Return which forces of a mechanism have jumps or kinks that the state decides."""
    return (_concrete_kinks if mechanism.is_concrete else _kinks)(mechanism)


def _kinks(mechanism: Mechanism) -> FoundKinks:
    are_held, others = False, []
    for name, smooth, can_be_held in _smooth_forces(mechanism):
        are_held |= can_be_held and smooth.count > 0
        if smooth.has_opaque or (smooth.count and not can_be_held):
            others.append(name)
    return FoundKinks(are_held, tuple(others))


_concrete_kinks = cached_by_identity(_kinks)


def _smooth_forces(mechanism: Mechanism) -> Iterator[tuple[str, "SmoothLoads", bool]]:
    """Return for each force that may have kinks its name, its smooth loads, and whether its sides can be held."""
    sampled = {k for section, k, _ in mechanism.samples if section == "_forces"}
    rows = mechanism.without_samples._forces if sampled else mechanism._forces
    for k, (name, element) in enumerate(mechanism.forces.items()):
        if element.may_have_kinks:
            traced = traced_loads(rows[k], attached_bodies(element, mechanism.joints))
            has_numbers = all(map(eqx.is_inexact_array, jax.tree.leaves(element)))
            yield name, smooth_loads(traced, len(element.breakpoints) > 0), k not in sampled and has_numbers


def with_held_forces(mechanism: Mechanism, first: int = 0) -> tuple[Mechanism, tuple[HeldElement, ...], tuple[Event, ...]]:
    """Return a mechanism with held forces, what these are, and the events at which their sides turn; without kinks, itself.

    `first` is the number of other sides, which come first.
    """
    if not isinstance(mechanism, Mechanism):
        return mechanism, (), ()
    elements, events, forces = [], [], list(mechanism._forces)
    for name, smooth, can_be_held in _smooth_forces(mechanism):
        if not smooth.count or not can_be_held:
            continue
        k, element = mechanism.force_names.index(name), mechanism.forces[name]
        frames = attached_bodies(element, mechanism.joints)
        nameless = jax.tree.unflatten(smooth.kind.tree, jax.tree.leaves(element))
        sides = jnp.full(smooth.count, FREE)
        forces[k] = HeldForce(bodies=tuple(frames), element=nameless, sides=sides, smooth=smooth)
        bodies = tuple(mechanism.body_names.index(b) for b in frames if b != GROUND)
        elements.append(HeldElement(k, smooth, bodies, first, len(events)))
        for i, (side, factor, shift) in enumerate(smooth.turns):
            condition = Kink(tuple(frames), nameless, sides, smooth, i)
            events.append(Event(condition, TurnSide(first + side, factor, shift), -1, f"kink {i + 1} of {name}"))
        first += smooth.count
    if not elements:
        return mechanism, (), ()
    return eqx.tree_at(lambda m: m._forces, mechanism, tuple(forces)), tuple(elements), tuple(events)


def renewed_sides(elements: Sequence[HeldElement], forces: Sequence[Any], t: Any, q: Any, v: Any, sides: Any) -> Array:
    """Return all sides at a state, with those of kinks that are not known yet or depend on others."""
    if not elements:
        return sides
    result = list(sides[: elements[0].first])
    for held in elements:
        element, q3, v3 = forces[held.force].element, jnp.reshape(q, (-1, 3)), jnp.reshape(v, (-1, 3))
        numbers = [x for leaf in jax.tree.leaves(element) for x in jnp.ravel(leaf)]
        state = [x for y in (q3, v3) for b in held.bodies for x in y[b]]
        result += held.smooth.renewal([*numbers, t, *state, *sides[held.sides]])
    return jnp.stack([jnp.asarray(s, float) for s in result])


class KinkPlaces(NamedTuple):
    """Places among the numbers of events."""

    sides: tuple[tuple[int, int], ...]  # each with the index of its side
    elements: tuple[tuple[int, ...], ...]  # of the numbers of each force, without sides


def places_of_kinks(events: Sequence[Event], held: Sequence[HeldElement]) -> KinkPlaces:
    """Return the positions of the numbers of kinks among the numbers of all events."""
    sizes = [sum(map(np.size, jax.tree.leaves(eqx.filter(e, eqx.is_inexact_array)))) for e in events]
    starts, first = np.cumsum([0, *sizes]), len(events) - sum(len(x.smooth.turns) for x in held)
    sides, elements = [], []
    for element in held:
        count = element.smooth.count
        for k in range(first + element.event, first + element.event + len(element.smooth.turns)):
            end = int(starts[k + 1])  # the sides are the last numbers of a condition
            sides += [(end - count + i, element.first + i) for i in range(count)]
        start = int(starts[first + element.event])
        elements.append(tuple(range(start, int(starts[first + element.event + 1]) - count)))
    return KinkPlaces(tuple(sides), tuple(elements))


def places_of_sides(mechanism: Mechanism, held: Sequence[Any]) -> tuple[int, ...]:
    """Return the places of all sides among all numbers of a mechanism; `held` has all forces with sides, in order."""
    sides = [np.arange(x.sides.start, x.sides.stop) + 1.0 for x in held]
    zeros = jax.tree.map(lambda x: np.zeros(np.shape(x)), mechanism)
    marked = eqx.tree_at(lambda m: [m._forces[x.force].sides for x in held], zeros, sides)
    numbers = np.concatenate([np.ravel(x) for x in jax.tree.leaves(marked)])
    return tuple(int(np.flatnonzero(numbers == k + 1.0)[0]) for k in range(int(numbers.max())))
