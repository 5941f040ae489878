"""Phases: the mechanisms that a scene turns into as events release or add constraints, and as contacts come to rest.

All phases have the bodies of the scene, hence the same coordinates. Before the run, every event is followed from every phase to
determine which phases can be reached. Each phase has its own equations and machine code.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

from udkjax.annotations import Number
from udkjax.arrays import number
from udkjax.equations.analysis import Analysis, analyse
from udkjax.integrate.events.conditions import Frames, frames_of
from udkjax.integrate.events.event import Event
from udkjax.integrate.events.kinks import HeldElement
from udkjax.scene.bodies import GROUND, GROUND_FRAME_AT_REST
from udkjax.scene.joints import Joint
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.origin import Origin
from udkjax.wording import quote, suggestion

Added = tuple[Any, ...]  # the joints that events add, with their current numbers, and the sides of comparisons
MOST_PHASES = 32  # each is compiled


class Tables(NamedTuple):
    """Phase transitions as [phase][event]; hashable, so programs compiled for them are reused."""

    after: tuple[tuple[int, ...], ...]  # the phase that follows an event
    resting: tuple[tuple[int, ...], ...]  # the phase after a contact has come to rest
    freed: tuple[tuple[int, ...], ...]  # the phase after a contact at rest has opened
    held: tuple[tuple[int, ...], ...]  # the row of Psi that holds a contact; -1: none


class Phases(eqx.Module):
    """The mechanisms of all phases, their analyses, and the transitions between them. Runs start in the first phase."""

    mechanisms: tuple[Mechanism, ...]
    analyses: tuple[Analysis, ...]
    added: tuple[Joint, ...]  # joints of `Attach` and `Lock`, without the numbers that depend on the state at the event
    added_by: tuple[tuple[int, str], ...] = eqx.field(static=True)  # for each added joint its event and its name
    tables: Tables = eqx.field(static=True)
    held: tuple[HeldElement, ...] = eqx.field(static=True, default=())  # the forces with held sides

    def with_added(self, phase: int, added: Added) -> Mechanism:
        """Return the mechanism of a phase, with the joints that events have added and the sides of its comparisons."""
        mechanism, (*joints, sides) = self.mechanisms[phase], added
        for held in self.held:
            at = lambda m, k=held.force: m._forces[k].sides  # noqa: E731
            mechanism = eqx.tree_at(at, mechanism, sides[held.sides])
        for (_, name), joint in zip(self.added_by, joints, strict=True):
            if name in mechanism.joint_names:
                index = mechanism.joint_names.index(name)
                mechanism = eqx.tree_at(lambda m, index=index: m._joints[index], mechanism, joint)
        return mechanism

    def first_added(self) -> tuple[Joint, ...]:
        """Return the joints that events add, as they would be at the initial guess."""
        return tuple(self.joint_at(k, self.mechanisms[0].q0.ravel()) for k in range(len(self.added)))

    def with_kinks(self, mechanism: Mechanism, held: tuple[HeldElement, ...], count: int) -> "Phases":
        """Return the phases with the forces of a mechanism some of which are held, and with events at `count` kinks."""
        *transitions, rows = self.tables
        stay = [[(*row, *[phase] * count) for phase, row in enumerate(table)] for table in transitions]
        after, resting, freed = map(tuple, stay)
        tables = Tables(after, resting, freed, tuple((*row, *[-1] * count) for row in rows))
        found = replace(self, held=held, tables=tables)
        return eqx.tree_at(lambda p: [m._forces for m in p.mechanisms], found, [mechanism._forces] * len(self.mechanisms))

    def joint_at(self, k: int, q: Array) -> Joint:
        """Return the k-th joint that events add, added at q."""
        joint, frames = self.added[k], frames_of(self.mechanisms[0].body_names, q)
        return jax.tree.map(number, joint.complete(*(frames[name] for name in joint.frame_names)))


def phases_of(mechanism: Mechanism, events: Sequence[Event], analysis: Analysis) -> Phases:
    """Return the phases of a mechanism with events. Raises `ValueError` if there are too many."""
    added, added_by = _additions(mechanism, events)
    names = [name for _, name in added_by]
    known = [*mechanism.constraints, *names]
    for event in events:
        for name in sorted(event.action.removed.difference(known)):
            raise ValueError(f"event {quote(event.name)}: no joint or driver named {quote(name)}{suggestion(name, known)}")
    first: frozenset[str] = frozenset(mechanism.constraints)
    active_sets, transitions = [first], []
    for active in active_sets:  # the list grows in this loop
        rows = [_next_phases(event, active, names, added_by, k) for k, event in enumerate(events)]
        for target in (x for row in rows for x in row):
            if target not in active_sets:
                active_sets.append(target)
        if len(active_sets) > MOST_PHASES:
            raise ValueError(
                f"events: more than {MOST_PHASES} combinations of constraints can follow one another; contacts with "
                'at_rest="stop" instead of "hold" add none'
            )
        transitions.append(rows)
    index_of = {active: k for k, active in enumerate(active_sets)}
    after, resting, freed = (tuple(tuple(index_of[row[i]] for row in rows) for rows in transitions) for i in range(3))
    contacts = {_contact(event): HeldContact.of(event, mechanism) for event in events if event.action.rest == "hold"}
    extra = {**dict(zip(names, added, strict=True)), **contacts}
    mechanisms = [_with(mechanism, active, extra) for active in active_sets]
    analyses = [analysis]
    for active, phase in zip(active_sets[1:], mechanisms[1:], strict=True):
        base = _with(mechanism, active - extra.keys(), {})
        analyses.append(_analysis(phase, lambda base=base: analysis if base is mechanism else analyse(base)))
    held = tuple(
        tuple(_row(a, _contact(e)) if _contact(e) in active else -1 for e in events)
        for active, a in zip(active_sets, analyses, strict=True)
    )
    tables = Tables(after, resting, freed, held)
    return Phases(tuple(m.without_origin for m in mechanisms), tuple(analyses), tuple(added), tuple(added_by), tables)


def _additions(mechanism: Mechanism, events: Sequence[Event]) -> tuple[list[Joint], list[tuple[int, str]]]:
    joints, by = [], []
    for k, event in enumerate(events):
        addition = event.action.addition(mechanism, f"event {quote(event.name)}")
        if addition is not None:
            name, joint = addition
            joints.append(joint)
            by.append((k, name))
    for k, name in by:
        if [other for _, other in by].count(name) > 1:
            raise ValueError(f"event {quote(events[k].name)}: two events add {quote(name)}; give one of them another name")
    return joints, by


def _next_phases(
    event: Event, active: frozenset[str], names: Sequence[str], by: Sequence[tuple[int, str]], k: int
) -> tuple[frozenset[str], frozenset[str], frozenset[str]]:
    """Return the active constraints after an event, after its contact has come to rest, and after the contact has opened."""
    added = frozenset(name for i, name in by if i == k)
    contact = frozenset([_contact(event)] if event.action.rest == "hold" else [])
    return (active - event.action.removed) | added, active | contact, active - contact


def _contact(event: Event) -> str:
    return f"{event.name}.contact"


def _analysis(phase: Mechanism, analyse_scene: Callable[[], Analysis]) -> Analysis:
    """Return the analysis of a phase; constraints added with traced numbers are taken to be independent of the scene's."""
    analysis = analyse(phase)
    of_scene = analyse_scene() if analysis.redundant_rows is None else analysis
    if of_scene.redundant_rows is None or analysis.redundant_rows is not None:
        return analysis
    rows = tuple(analysis.row_names.index(row) for row in of_scene.redundant)
    return replace(analysis, redundant_rows=rows)


def _row(analysis: Analysis, name: str) -> int:
    return [n for n, _ in analysis.row_names].index(name)


def _with(mechanism: Mechanism, active: frozenset[str], extra: dict[str, Joint]) -> Mechanism:
    """Return the mechanism with only the active constraints, from its own and from `extra`."""
    if active == frozenset(mechanism.constraints):
        return mechanism
    joints = {name: joint for name, joint in mechanism.joints.items() if name in active}
    added = {name: joint for name, joint in extra.items() if name in active}
    drivers = {name: driver for name, driver in mechanism.drivers.items() if name in active}
    parts = (joints | added, drivers, mechanism.forces, mechanism.gravity, mechanism.name)
    is_concrete = not any(isinstance(x, Tracer) for x in jax.tree.leaves(list(added.values())))
    if mechanism.is_concrete and is_concrete:
        with jax.ensure_compile_time_eval():  # numbers taken from the guess stay concrete even under tracing
            return Mechanism(mechanism.bodies, *parts)
    origin = None
    if mechanism.origin is not None and is_concrete:
        origin = Origin(_with(mechanism.origin.mechanism, active, extra))
    return Mechanism(mechanism.bodies, *parts, origin)


class HeldContact(Joint):
    """A contact at rest: its condition stays zero. 1 row, in the condition's unit."""

    labels: tuple[str, ...] = eqx.field(static=True)  # the names of the bodies in the condition
    condition: Callable[[Number, Frames], ArrayLike]

    @classmethod
    def of(cls, event: Event, mechanism: Mechanism) -> "HeldContact":
        """Return the contact of an event; its bodies are all, or those in the attribute `bodies` of the condition."""
        bodies = getattr(event.condition, "bodies", mechanism.body_names)
        return cls(bodies=bodies, labels=tuple(bodies), condition=event.condition)

    def residual(self, t, *frames):
        return [self.condition(t, {GROUND: GROUND_FRAME_AT_REST, **dict(zip(self.labels, frames, strict=True))})]
