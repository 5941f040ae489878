"""The events of a run that are listed for the user: no kinks, but joints that stick, slip or reverse, each by its name."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.events.instant.runs import RECORD_FIELDS, EventRun
from udkjax.integrate.events.law.event import Event
from udkjax.integrate.events.law.kinks import MOST_KINKS
from udkjax.integrate.events.law.phases import Phases

TRANSITIONS = ("sticks", "slips", "turns round")
STICKS, SLIPS, TURNS = range(3)


class Kinks(NamedTuple):
    """The kinks of forces that a run has located."""

    count: Int[Array, ""]
    unlocated: Float[Array, ""]  # the time (s) from which kinks are not located; infinite if all are


class Listing(NamedTuple):
    """A run with its listed events, its kinks, and the joints that stick."""

    run: EventRun  # `event_index` is an index of the names of events
    kinks: Kinks | None  # None if no forces have kinks
    sticking: dict[str, Bool[Array, "T"]] | None  # by joint, at the output times; None without set-valued friction


def names_of_events(events: Sequence[Event], phases: Phases) -> tuple[str, ...]:
    """Return the names of all events that may be listed, in the order of their indices.

    Each event of the user has an index; then each has one for "lets go" and one for "rests", with the name "" unless it is a
    contact; the transitions of joints that may stick follow.

    Args:
        events: All events: those of the user, of joints that may stick, and at kinks.
        phases: The phases.
    """
    own = events[: _own_count(events, phases)]
    others = (f"{e.name} {text}" if e.action.is_impact else "" for text in ("lets go", "rests") for e in own)
    return (*(e.name for e in own), *others, *(f"{x.name} {text}" for x in phases.sticking for text in TRANSITIONS))


def _own_count(events: Sequence[Event], phases: Phases) -> int:
    return len(events) - 2 * len(phases.sticking) - sum(e.action.turn is not None for e in events)


def listing(
    found: EventRun, ts: Float[Any, "T"], events: Sequence[Event], phases: Phases, max_events: int, xp: ModuleType
) -> Listing:
    """Return a run with only those events that are listed for the user, its kinks, and the joints that stick.

    Args:
        found: The run.
        ts: The output times (s).
        events: All events.
        phases: The phases.
        max_events: The largest number of events that are listed.
        xp: jax.numpy, or NumPy.
    """
    E, own, F = len(events), _own_count(events, phases), len(phases.sticking)
    if own == E:
        return Listing(found, None, None)
    k, kind, event = xp.arange(len(found.event_index)), found.event_index // E, found.event_index % E
    is_event = k < found.count
    is_kink, is_hidden = is_event & (event >= own + 2 * F), is_event & (event >= own + 2 * F)
    index, sticking, also = kind * own + event, None, xp.zeros((len(k), 0), bool)
    if F:
        after, first = (_stick(phases, x, y, xp) for x, y in ((found.event_phase, found.sides), _first(found)))
        i, of_joint = xp.clip((event - own) // 2, 0, F - 1), (event >= own) & (event < own + 2 * F)
        stays = after[k, i]
        began = xp.concatenate([first, after[:-1]])[k, i]
        transition = xp.where((kind == 1) | (began & ~stays), SLIPS, xp.where(stays, STICKS, TURNS))
        index = xp.where(of_joint, 3 * own + len(TRANSITIONS) * i + transition, index)
        is_hidden = is_hidden | (is_event & of_joint & (kind == 1) & stays)  # another joint holds it now
        # Joints that move together also stop together: the decision at one joint's event covers every joint at rest.
        also = (is_event & of_joint)[:, None] & (np.arange(F) != i[:, None]) & _turn(phases, found, ~after, xp)
        last = xp.searchsorted(found.event_time, ts, side="right") - 1
        held = xp.where((last >= 0)[:, None], after[xp.maximum(last, 0)], first[0])
        sticking = {x.name: held[:, j] for j, x in enumerate(phases.sticking)}
    listed = xp.concatenate([(is_event & ~is_hidden)[:, None], also], axis=1)
    indices = xp.concatenate([index[:, None], 0 * index[:, None] + 3 * own + len(TRANSITIONS) * np.arange(F) + TURNS], axis=1)
    order = xp.argsort(~listed.ravel(), stable=True)[:max_events]
    rows = order // (1 + F)
    run = found._replace(
        **{name: getattr(found, name)[rows] for name in RECORD_FIELDS} | {"event_index": indices.ravel()[order]},
        count=xp.minimum(xp.sum(listed), max_events),
        unresolved=found.unresolved[:own],
        undefined=found.undefined[:own],
    )
    if own + 2 * F == E:
        return Listing(run, None, sticking)
    count, unresolved = xp.sum(is_kink), found.unresolved[own + 2 * F :].min()
    full = xp.where(count >= MOST_KINKS, xp.max(xp.where(is_kink, found.event_time, -xp.inf)), xp.inf)
    return Listing(run, Kinks(count, xp.minimum(unresolved, full)), sticking)


def _turn(phases: Phases, found: EventRun, slides: Bool[Any, "k F"], xp: ModuleType) -> Bool[Any, "k F"]:
    """Return a mask of the joints that slide in opposite directions before and after each event."""
    places = [x.first for x in phases.sticking]
    after, first = found.sides[:, places], found.first_sides[None, places]
    return slides & (xp.concatenate([first, after[:-1]]) * after < 0)


def _first(found: EventRun) -> tuple[Any, Any]:
    return found.first_phase[None], found.first_sides[None]


def _stick(phases: Phases, phase: Bool[Any, "k C"], sides: Float[Any, "k S"], xp: ModuleType) -> Bool[Any, "k F"]:
    """Return a mask of the joints that stick: they are locked, or kept at rest by other joints that are locked."""
    locks = np.array([phases.switches.contacts[x.event] for x in phases.sticking], int)
    return phase[:, locks] | (sides[:, [x.first + 1 for x in phases.sticking]] > 0.5)
