"""Jumps and kinks of forces that the state decides, as events of their own: a step ends there, and derivatives pass through.

A force with comparisons of the state becomes a `HeldForce`: the sides of its comparisons are numbers, with which its loads are
smooth, also beyond the crossing (expressions/scalars/kinks.py). Where the condition of a comparison falls through zero, its side
turns: it takes another value. The loads of a user-defined system are held in the same way, all together: the sides are the last
of its numbers.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.equations.systems.smooth_loads import SmoothLoads
from udkjax.expressions import has_kinks
from udkjax.integrate.events.law.actions import Action
from udkjax.integrate.events.law.event import Event
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.element_setup import attached_bodies
from udkjax.wording import quote

FREE_SIDE = np.inf  # a side that is not held
MOST_KINKS = 256  # of a run; then sides are no longer held, as a run at rest where a force jumps would make no progress


class HeldForce(ForceElement):
    """A force element with given sides of its comparisons of the state."""

    element: Any  # the original element
    sides: Float[Array, "k"]
    smooth: SmoothLoads = eqx.field(static=True)

    def loads(self, t, *frames):
        kind, values = self.smooth.kind, iter(self.smooth.loads(self.element, self.sides, t, *self.smooth.state(frames)))
        assert kind is not None  # loads of an element
        return [(0.0, 0.0, 0.0) if fixed else (next(values), next(values), next(values)) for fixed in kind.ground]

    @property
    def breakpoints(self):
        return self.element.breakpoints


class Kink(eqx.Module):
    """The condition under which a comparison in a force keeps its side: positive, falling through zero where the side turns."""

    bodies: tuple[str, ...] | None = eqx.field(static=True)  # None: of a system, whose conditions see q and v
    element: Any  # the force element, or the numbers of a system
    sides: Float[Array, "k"]
    smooth: SmoothLoads = eqx.field(static=True)
    index: int = eqx.field(static=True)  # of the condition in `smooth`

    def __call__(self, t, *state):
        if self.bodies is None:
            (q, v), is_moving = state, state[1] is not None
            v = v if is_moving else jnp.zeros_like(q)
        else:
            found = [state[0][name] for name in self.bodies]
            (q, v), is_moving = self.smooth.state(found), not any(f.vx is None for f in found)
        if self.smooth.by_velocity[self.index] and not is_moving:
            raise TypeError("the condition depends on velocities")
        return self.smooth.condition(self.index, self.element, self.sides, t, q, v)


class TurnSide(Action):
    """The action that turns a side: the one of index `side` among all sides becomes `factor` times itself plus `shift`."""

    side: int = eqx.field(static=True)
    factor: float = eqx.field(static=True)
    shift: float = eqx.field(static=True)

    changes = False

    @property
    def turn(self):
        return self.side, self.factor, self.shift


class HeldElement(NamedTuple):
    """The static description of loads with held sides, of a force element or of a system; hashable."""

    force: int | None  # index of the element among the forces of a mechanism; None for the loads of a system
    smooth: SmoothLoads
    coordinates: tuple[int, ...]  # indices of the coordinates on which the loads may depend
    first: int  # index of its first side among all sides
    event: int  # index of the first of its events, counted from the first kink

    @property
    def sides(self) -> slice:
        return slice(self.first, self.first + self.smooth.count)

    def renewed(self, numbers: Sequence[Any], t: Any, q: Any, v: Any, sides: Any) -> list[Any]:
        """Return the inputs of `smooth.renewal`, from numbers and `sides` of the loads, and the state of the whole mechanism."""
        at = np.array(self.coordinates, int)
        return self.smooth.inputs(numbers, t, q[at], v[at], sides)


def with_sides(events: Sequence[Event], sides: Float[Array, "S"], held: Sequence[HeldElement]) -> tuple[Event, ...]:
    """Return the events with all `sides` put into the conditions of kinks, which are the last events."""
    result, first = list(events), len(events) - sum(len(x.smooth.turns) for x in held)
    for element in held:
        for k in range(first + element.event, first + element.event + len(element.smooth.turns)):
            result[k] = eqx.tree_at(lambda e: e.condition.sides, result[k], sides[element.sides])
    return tuple(result)


class FoundKinks(NamedTuple):
    """The forces of a model with kinks, as far as they are known before a run."""

    held: tuple[str, ...]  # forces, or functions of a system, with kinks that can be located
    others: tuple[str, ...]  # forces, or functions of a system, with kinks that cannot

    @property
    def are_held(self) -> bool:
        """True if a force has kinks that can be located."""
        return bool(self.held)

    def remark(self, by_steps: str) -> str:
        """Return a remark whether kinks are located; "" if there are none.

        Args:
            by_steps: the reason why a run locates no kinks, such as "with a progress meter"; "" if it locates them.
        """
        if by_steps and (self.are_held or self.others):
            return f"not located {by_steps}"
        unseen = f"not located in {', '.join(map(quote, self.others))}" if self.others else ""
        return ", ".join(filter(None, ["located" if self.are_held else "", unseen]))


def kinks_of(model: Any) -> FoundKinks:
    """Return the forces of a mechanism, or the functions of a system, that have jumps or kinks which the state decides."""
    if not model.has_bodies:
        return _kinks_of_functions(model.functions, model.breakpoints is not None)
    return (_concrete_kinks if model.is_concrete else _kinks)(model)


@lru_cache(maxsize=64)
def _kinks_of_functions(functions: Any, breaks: bool) -> FoundKinks:
    """Return the kinks of the `SystemFunctions` of a system: only those of its loads are located."""
    smooth, moving = SmoothLoads.of_functions(functions, breaks), functions.moving(breaks)
    others = [] if not smooth.has_opaque else ["force"]
    others += [name for name, terms in functions.other_terms.items() if has_kinks(functions.graph, terms, moving)]
    return FoundKinks(("force",) if smooth.count else (), tuple(others))


def _kinks(mechanism: Mechanism) -> FoundKinks:
    held, others = [], []
    for name, smooth, can_be_held in _smooth_forces(mechanism):
        if can_be_held and smooth.count:
            held.append(name)
        if smooth.has_opaque or (smooth.count and not can_be_held):
            others.append(name)
    return FoundKinks(tuple(held), tuple(others))


_concrete_kinks = cached_by_identity(_kinks)


def _smooth_forces(mechanism: Mechanism) -> Iterator[tuple[str, SmoothLoads, bool]]:
    """Yield, for each force that may have kinks, its name, its smooth loads, and whether its sides can be held."""
    sampled = {k for section, k, _ in mechanism.samples if section == "_forces"}
    rows = mechanism.without_samples._forces if sampled else mechanism._forces
    for k, (name, element) in enumerate(mechanism.forces.items()):
        if element.may_have_kinks:
            smooth = SmoothLoads.of_element(rows[k], attached_bodies(element, mechanism.joints), len(element.breakpoints) > 0)
            has_numbers = all(map(eqx.is_inexact_array, jax.tree.leaves(element)))
            yield name, smooth, k not in sampled and has_numbers


def with_held_forces(model: Any, first: int = 0) -> tuple[Any, tuple[HeldElement, ...], tuple[Event, ...]]:
    """Return a model with held loads, the held elements, and the events at which their sides turn.

    A model without kinks is returned with two empty tuples. `first` is the number of other sides, which come first.
    """
    return _with_held_elements(model, first) if model.has_bodies else _with_held_loads(model)


def _with_held_loads(system: Any) -> tuple[Any, tuple[HeldElement, ...], tuple[Event, ...]]:
    smooth = SmoothLoads.of_functions(system.functions, system.breakpoints is not None)
    if not smooth.count:
        return system, (), ()
    sides = jnp.full(smooth.count, FREE_SIDE)
    found = HeldElement(None, smooth, tuple(range(system.functions.n)), 0, 0)
    return (
        system.with_functions(smooth.held(system.functions), sides),
        (found,),
        tuple(_turn(Kink(None, system.numbers, sides, smooth, i), 0, i, "force") for i in range(len(smooth.turns))),
    )


def _turn(condition: Kink, first: int, index: int, name: str) -> Event:
    """Return the event at which the condition with this index turns a side of the force `name`, whose first side is `first`."""
    side, factor, shift = condition.smooth.turns[index]
    return Event(condition, TurnSide(first + side, factor, shift), -1, f"kink {index + 1} of {name}")


def _with_held_elements(mechanism: Mechanism, first: int) -> tuple[Mechanism, tuple[HeldElement, ...], tuple[Event, ...]]:
    mechanism = mechanism.without_origin  # elements that follow from a drawing or a guess are no leaves
    elements, events, forces = [], [], list(mechanism._forces)
    for name, smooth, can_be_held in _smooth_forces(mechanism):
        if not smooth.count or not can_be_held:
            continue
        k, element = mechanism.force_names.index(name), mechanism.forces[name]
        frames = attached_bodies(element, mechanism.joints)
        assert smooth.kind is not None  # loads of an element
        nameless = jax.tree.unflatten(smooth.kind.tree, jax.tree.leaves(element))
        sides = jnp.full(smooth.count, FREE_SIDE)
        forces[k] = HeldForce(bodies=tuple(frames), element=nameless, sides=sides, smooth=smooth)
        bodies = (mechanism.body_names.index(b) for b in frames if b != GROUND)
        elements.append(HeldElement(k, smooth, tuple(3 * b + i for b in bodies for i in range(3)), first, len(events)))
        kinks = (Kink(tuple(frames), nameless, sides, smooth, i) for i in range(len(smooth.turns)))
        events += [_turn(kink, first, i, name) for i, kink in enumerate(kinks)]
        first += smooth.count
    if not elements:
        return mechanism, (), ()
    return eqx.tree_at(lambda m: m._forces, mechanism, tuple(forces)), tuple(elements), tuple(events)


def sides_in(model: Any, force: int | None) -> Float[Array, "k"]:
    """Return the sides of the force with the index `force` of a mechanism, or, if it is None, of the loads of a system."""
    return model.numbers[-1] if force is None else model._forces[force].sides


def has_sides(model: Any, force: int | None) -> bool:
    """Return True if a model has the force with this index: the mechanism of the scene lacks the friction of contacts."""
    return force is None or force < len(model._forces)


def renewed_sides(elements: Sequence[HeldElement], model: Any, t: Any, q: Any, v: Any, sides: Any) -> Array:
    """Return all sides at a state; unknown sides (FREE_SIDE), and those that depend on others, are determined from the state."""
    if not elements:
        return sides
    result = list(sides[: elements[0].first])
    for held in elements:
        numbers = SmoothLoads.numbers(model.numbers[:-1] if held.force is None else model._forces[held.force].element)
        result += held.smooth.renewal(held.renewed(numbers, t, jnp.ravel(q), jnp.ravel(v), sides[held.sides]))
    return jnp.stack([jnp.asarray(s, float) for s in result])


class KinkPlaces(NamedTuple):
    """Indices of the numbers of kinks among the numbers of all events."""

    sides: tuple[tuple[int, int], ...]  # place of each number that is a side, with the index of the side
    elements: tuple[tuple[int, ...], ...]  # places of the numbers of each held force, without sides


def places_of_kinks(events: Sequence[Event], held: Sequence[HeldElement]) -> KinkPlaces:
    """Return the indices of the numbers of kinks among the numbers of all events."""
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


def places_of_sides(model: Any, held: Sequence[Any]) -> tuple[int, ...]:
    """Return the places of all sides among all numbers of a model, -1 for those of forces that it lacks.

    `held` has all loads with sides, in order.
    """
    here, count = [x for x in held if has_sides(model, x.force)], max(x.sides.stop for x in held)
    sides = [np.arange(x.sides.start, x.sides.stop) + 1.0 for x in here]
    zeros = jax.tree.map(lambda x: np.zeros(np.shape(x)), model)
    marked = eqx.tree_at(lambda m: [sides_in(m, x.force) for x in here], zeros, sides) if here else zeros
    numbers = np.concatenate([np.ravel(x) for x in jax.tree.leaves(marked)])
    places = {int(x) - 1: int(place) for place, x in enumerate(numbers) if x}
    return tuple(places.get(k, -1) for k in range(count))
