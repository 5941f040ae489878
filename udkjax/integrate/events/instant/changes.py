"""The constraints that hold at the output times of a run, for quantities of its solution."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from udkjax.arrays import make_module
from udkjax.equations.states.scene_changes import SceneChanges, numbers_and_form
from udkjax.equations.terms import switches as switching
from udkjax.integrate.events.instant.runs import EventRun
from udkjax.integrate.events.law.event import Event
from udkjax.integrate.events.law.phases import SCENE, SWITCHED, Phases
from udkjax.programs.identity_cache import cached_by_identity, is_concrete
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import Constraint


def scene_changes(
    found: EventRun, ts: Float[Any, "T"], events: Sequence[Event], phases: Phases, xp: ModuleType
) -> SceneChanges | None:
    """Return the `SceneChanges` of a run: the constraints that hold at the output times; None if events change no constraints.

    Locks of joints that stick are left out.

    Args:
        found: The run, with all its events.
        ts: The output times (s).
        events: All events.
        phases: The phases.
        xp: jax.numpy, or NumPy.
    """
    if not phases.switches.names:
        return None
    changing = (_concrete_scene if is_concrete(phases, *events) else _changing_scene)(phases, *events)
    if not changing.switches:
        return None
    k = xp.arange(len(found.event_index))
    last = xp.searchsorted(xp.where(k < found.count, found.event_time, xp.inf), ts, side="right") - 1
    phase = xp.where((last >= 0)[:, None], found.event_phase[xp.maximum(last, 0)], found.first_phase)
    guess, places = xp.asarray(changing.guess), []
    for event in changing.adding:
        added = (found.event_index == event) & (k < found.count) & (k <= last[:, None])
        latest = xp.max(xp.where(added, k, -1), axis=1)
        places.append(xp.where((latest >= 0)[:, None], found.event_q[xp.maximum(latest, 0), 1], guess))
    return make_module(
        SceneChanges,
        holds=phase[:, np.array(changing.switches, int)],
        places=xp.stack(places, axis=1) if places else xp.zeros((len(ts), 0, guess.size)),
        **changing.fields,
    )


class _ChangingScene(NamedTuple):
    """The part of `SceneChanges` that is the same for all runs."""

    switches: tuple[int, ...]  # indices of the switches, without those of joints that stick
    adding: tuple[int, ...]  # the event that adds each added joint
    guess: Float[Any, "1 n"]  # initial guess of the scene
    fields: dict[str, Any]  # the other fields of `SceneChanges`


def _changing_scene(phases: Phases, *events: Event) -> _ChangingScene:
    switches, scene = phases.switches, phases.mechanisms[SCENE]
    locks = {switches.contacts[x.event] for x in phases.sticking}
    own = tuple(k for k in range(len(switches.names)) if k not in locks)
    names = [switches.names[k] for k in own if switches.first[k]]
    public, scene_constraint_count, adding, joints = list(names), len(names), [], []
    for (event, name), joint in zip(phases.added_by, phases.added, strict=True):
        if switches.names.index(name) not in locks:
            addition = events[event].action.addition(scene, events[event].name)
            assert addition is not None  # it adds the joint
            adding.append(event)
            names.append(name)
            public.append(addition[0])
            joints.append(joint)
    contacts = _contacts(events, phases)
    names, public = ([*x, *(name for name, _ in contacts.values())] for x in (names, public))
    rubbing = {contacts[x.contact][0]: x for x in phases.sticking if x.contact >= 0}
    friction = {name: _friction(events[x.contact], name) for name, x in rubbing.items()}
    numbers, form = numbers_and_form([*joints, *(joint for _, joint in contacts.values())], friction)
    fields = {
        "numbers": numbers,
        "form": form,
        "names": tuple(names),
        "public": tuple(public),
        "scene_constraint_count": scene_constraint_count,
    }
    fields["sticking"] = tuple(x.name for x in rubbing.values())
    return _ChangingScene(own, tuple(adding), scene.q0.reshape(1, -1), fields)


@cached_by_identity
def _concrete_scene(phases: Phases, *events: Event) -> _ChangingScene:
    with jax.ensure_compile_time_eval():
        return _changing_scene(phases, *events)


def _contacts(events: Sequence[Event], phases: Phases) -> dict[int, tuple[str, Constraint]]:
    """Return the name and the joint by which each contact is held at rest, by the index of the event of the contact."""
    switches, found = phases.switches, {}
    for event, x in enumerate(events):
        if x.action.rest == "hold":
            name = switches.names[switches.contacts[event]]
            found[event] = name, switching.unswitched(phases.mechanisms[SWITCHED].joints[name])
    return found


def _friction(contact: Event, joint: str) -> Friction:
    """Return the friction of a contact with the set-valued law, in the joint by which the contact is held."""
    action: Any = contact.action
    numbers = {"coefficient": action.coefficient, "static_coefficient": action.static_coefficient}
    return Friction(joint=joint, law="set-valued", **numbers)
