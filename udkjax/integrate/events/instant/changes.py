"""The constraints that hold at the output times of a run, for quantities of its solution."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

from udkjax.equations.states.scene_changes import SceneChanges
from udkjax.equations.terms import switches as switching
from udkjax.integrate.events.instant.runs import EventRun
from udkjax.integrate.events.law.event import Event
from udkjax.integrate.events.law.phases import SCENE, SWITCHED, Phases
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import Constraint


def scene_changes(
    found: EventRun, ts: Float[Any, "T"], events: Sequence[Event], phases: Phases, xp: ModuleType
) -> SceneChanges | None:
    """Return which constraints hold at the output times, without those by which joints stick; None if events change none.

    Args:
        found: The run, with all its events.
        ts: The output times (s).
        events: All events.
        phases: The phases.
        xp: jax.numpy, or NumPy.
    """
    switches = phases.switches
    locks = {switches.contacts[x.event] for x in phases.sticking}
    own = [k for k in range(len(switches.names)) if k not in locks]
    if not own:
        return None
    k = xp.arange(len(found.event_index))
    last = xp.searchsorted(xp.where(k < found.count, found.event_time, xp.inf), ts, side="right") - 1
    phase = xp.where((last >= 0)[:, None], found.event_phase[xp.maximum(last, 0)], found.first_phase)
    scene, places, others = phases.mechanisms[SCENE], [], []
    guess = xp.asarray(scene.q0).reshape(1, -1)
    for (event, name), joint in zip(phases.added_by, phases.added, strict=True):
        if switches.names.index(name) in locks:
            continue
        addition = events[event].action.addition(scene, events[event].name)
        assert addition is not None  # it has added the joint
        others.append((name, addition[0], joint))
        added = (found.event_index == event) & (k < found.count) & (k <= last[:, None])
        latest = xp.max(xp.where(added, k, -1), axis=1)
        places.append(xp.where((latest >= 0)[:, None], found.event_q[xp.maximum(latest, 0), 1], guess))
    contacts = _contacts(events, phases)
    friction = {x.contact: x.name for x in phases.sticking if x.contact >= 0}
    return SceneChanges.of(
        phase[:, np.array(own, int)],
        xp.stack(places, axis=1) if places else xp.zeros((len(ts), 0, guess.size)),
        [switches.names[k] for k in own if switches.first[k]],
        [*others, *((name, name, joint) for name, joint in contacts.values())],
        {contacts[event][0]: (name, _friction(events[event], contacts[event][0])) for event, name in friction.items()},
    )


def _contacts(events: Sequence[Event], phases: Phases) -> dict[int, tuple[str, Constraint]]:
    """Return the joints that hold contacts at rest with their names, by the event of the contact."""
    switches, found = phases.switches, {}
    for event, x in enumerate(events):
        if x.action.rest == "hold":
            name = switches.names[switches.contacts[event]]
            found[event] = name, switching.unswitched(phases.mechanisms[SWITCHED].joints[name])
    return found


def _friction(contact: Event, joint: str) -> Friction:
    """Return the friction of a contact with its set-valued law, in the joint that holds it."""
    action: Any = contact.action
    numbers = {"coefficient": action.coefficient, "static_coefficient": action.static_coefficient}
    return Friction(joint=joint, law="set-valued", **numbers)
