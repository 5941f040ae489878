"""Curves over time below the motion, and arrows of reactions."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import JsonObject, Numbers
from udkjax.equations import determinacy
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.states.quantities import efforts, energy, violation
from udkjax.equations.states.reactions import reactions, unique_reactions
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player.marks.pin_measures import pin_speeds, transmission_angles
from udkjax.study.accuracy import conserves_energy
from udkjax.study.diagnosis.configuration import RankedPositions
from udkjax.study.power_balance import power_balance

SMALLEST_POSITIVE = 1e-17  # drawn instead of zero on a logarithmic axis; less than any nonzero violation or singular value


# Names of measures; or values over time by name, and for several runs also by label.
Measures = Sequence[str] | Mapping[str, Numbers | Mapping[str, Numbers] | None]


ReactionArrows = tuple[
    list[list[float]], Float[np.ndarray, "T joints 2"], list[bool]
]  # anchors, forces (N), mask of unique forces


class ShownMotion(Protocol):
    """A motion: times ts (T,) in s, coordinates q and velocities v (T, bodies, 3)."""

    @property
    def ts(self) -> Array | np.ndarray: ...

    @property
    def q(self) -> Array | np.ndarray: ...

    @property
    def v(self) -> Array | np.ndarray: ...


class MeasureCurve(NamedTuple):
    """A number over time: its name, unit, and values at the output times; `log` is True for a logarithmic axis.

    `anchors` are places [body, x, y], by which a page computes the number again: one whose speed it is, or three whose angle it
    is, with the corner in the middle; they are empty for other numbers.
    """

    name: str
    unit: str
    values: Float[np.ndarray, "T"]
    log: bool = False
    anchors: Sequence[Sequence[float]] = ()


def measures_of(mechanism: Mechanism, solution: ShownMotion, wanted: Measures, label: str) -> list[MeasureCurve]:
    """Return the curves of the measures of a run.

    Args:
        mechanism: the mechanism of the run.
        solution: the run.
        wanted: names in `MEASURES`; or other measures as {"name" or "name (unit)": values}, by label for several runs.
        label: label of the run.

    Raises:
        ValueError: a name is unknown, or values are not one number per output time.
    """
    found: list[MeasureCurve] = []
    by_name = wanted if isinstance(wanted, Mapping) else dict.fromkeys(wanted)
    for name, values in by_name.items():
        if values is None:
            if name not in MEASURES:
                raise ValueError(f"measure {name!r} is unknown: use {', '.join(MEASURES)}, or give its values")
            found += MEASURES[name](mechanism, solution)
        elif not isinstance(values, Mapping) or label in values:
            values = values[label] if isinstance(values, Mapping) else values
            words, _, unit = name.partition(" (")
            values = np.asarray(values, float)
            if values.shape != np.shape(solution.ts):
                raise ValueError(f"measure {name!r} has shape {values.shape}; the run has {len(solution.ts)} output times")
            found.append(MeasureCurve(words, unit.removesuffix(")"), values))
    return found


def _violation(mechanism: Mechanism, solution: ShownMotion) -> list[MeasureCurve]:
    psi = np.asarray(violation(mechanism, solution))
    values = np.abs(psi) * np.asarray(analyse(mechanism).scales.weights)  # radians as arcs of the characteristic length
    return [MeasureCurve("violation", "m", np.maximum(values.max(axis=1, initial=0.0), SMALLEST_POSITIVE), log=True)]


def _energy(mechanism: Mechanism, solution: ShownMotion) -> list[MeasureCurve]:
    if mechanism.massless:
        return []
    parts = energy(mechanism, solution)
    total = np.asarray(parts.total)
    changed_by = "energy change" if conserves_energy(mechanism, solution.ts) else "work of drivers and loads"
    return [
        MeasureCurve(changed_by, "J", total - total[0]),
        MeasureCurve("kinetic energy", "J", np.asarray(parts.kinetic)),
        MeasureCurve("potential energy", "J", np.asarray(parts.potential)),
    ]


def _rank(mechanism: Mechanism, solution: ShownMotion) -> list[MeasureCurve]:
    """Return the rank of the scaled Jacobian, and the smallest singular value that is nonzero at the largest rank.

    Both are NaN where events have released constraints, or where the state is not finite.
    """
    positions, q = RankedPositions(mechanism, determinacy.STATIC_RANK_TOL), np.asarray(solution.q, float)
    ts, q = np.asarray(solution.ts, float).tolist(), q.reshape(len(q), -1)
    changes, holds = getattr(solution, "scene_changes", None), np.isfinite(q).all(1)
    holds = holds if changes is None else holds & ~np.asarray(changes.are_released)
    found = [positions.at(t, x) if ok else None for t, x, ok in zip(ts, q, holds, strict=True)]
    full = max((at.rank for at in found if at), default=0)
    curves = [MeasureCurve("rank", "", np.array([at.rank if at else np.nan for at in found], float))]
    if full:
        values = np.array([max(at.value(full), SMALLEST_POSITIVE) if at else np.nan for at in found])
        curves.append(MeasureCurve(f"singular value {full}", "", values, log=True))
    return curves


def _effort(mechanism: Mechanism, solution: ShownMotion) -> list[MeasureCurve]:
    units = {name: ("torque", "N m") if d.coordinate == "angle" else ("force", "N") for name, d in mechanism.drivers.items()}
    by_driver = [] if mechanism.massless else efforts(mechanism, solution).items()
    return [MeasureCurve(f"{units[name][0]} of {name}", units[name][1], np.asarray(values)) for name, values in by_driver]


def _friction(mechanism: Mechanism, solution: ShownMotion) -> list[MeasureCurve]:
    """Return the power of all friction together; [] for a mechanism without friction."""
    names = [name for name, force in mechanism.forces.items() if isinstance(force, Friction)]
    if not names:
        return []
    powers = power_balance(mechanism, solution).forces
    return [MeasureCurve("power of friction", "W", np.sum([np.asarray(powers[name]) for name in names], axis=0))]


def _speed(mechanism: Mechanism, solution: ShownMotion) -> list[MeasureCurve]:
    found = pin_speeds(mechanism, np.asarray(solution.q, float), np.asarray(solution.v, float))
    return [MeasureCurve(name, unit, values, anchors=anchors) for name, unit, anchors, values in found]


def _transmission(mechanism: Mechanism, solution: ShownMotion) -> list[MeasureCurve]:
    found = transmission_angles(mechanism, np.asarray(solution.q, float))
    return [MeasureCurve(name, unit, values, anchors=anchors) for name, unit, anchors, values in found]


MEASURES = {
    "violation": _violation,
    "energy": _energy,
    "rank": _rank,
    "effort": _effort,
    "friction": _friction,
    "speed": _speed,
    "transmission": _transmission,
}


def sticking_spans(mechanism: Mechanism, solution: ShownMotion) -> list[JsonObject]:
    """Return the spans of time in which joints with set-valued friction stick.

    Each entry has the name of a joint, its place `at` as [body, x, y], and `spans` of time (s). A span begins and ends at the
    events of its joint, or else at output times. Contacts with friction are left out.
    """
    ts, events = np.asarray(solution.ts, float), getattr(solution, "events", None)
    happened = {} if events is None else {name: events.of(name) for name in events.names if name}
    found: list[JsonObject] = []
    for name, sticks in (getattr(solution, "sticking", None) or {}).items():
        if name not in mechanism.joints:
            continue
        joint, states = mechanism.joints[name], np.asarray(sticks)
        side = 0 if joint.bodies[1] == GROUND else 1
        place = [mechanism.body_names.index(joint.bodies[side]), *np.asarray(joint.points, float)[side].tolist()]
        turns = {True: happened.get(f"{name} sticks", ()), False: happened.get(f"{name} slips", ())}
        changes = [ts[0]] if states[0] else []
        for k in np.flatnonzero(states[1:] != states[:-1]).tolist():
            located = [float(t) for t in turns[bool(states[k + 1])] if ts[k] <= t <= ts[k + 1]]
            changes.append(located[-1] if located else float(ts[k + 1]))
        changes += [float(ts[-1])] if len(changes) % 2 else []
        spans = [[float(start), float(end)] for start, end in zip(changes[::2], changes[1::2], strict=True)]
        found.append({"name": name, "at": place, "spans": spans})
    return found


def reaction_arrows(mechanism: Mechanism, solution: ShownMotion) -> ReactionArrows:
    """Return the arrows of reactions, for each joint and driver that exerts a force on a body.

    Returns:
        Anchors [body, x, y]; forces (N, ground axes) on the second body, or on the first if the second is the ground, with least
        norm where redundant constraints share them; and a mask of the forces that are unique throughout the run.
    """
    loads, uniqueness = reactions(mechanism, solution), unique_reactions(mechanism, solution)
    bodies = list(mechanism.bodies)
    alive = np.isfinite(np.asarray(solution.q)).all((1, 2))
    anchors, forces, unique = [], [], []
    for name, constraint in mechanism.constraints.items():
        points = getattr(constraint, "points", None)
        if points is None or getattr(constraint, "coordinate", "") == "angle":
            continue
        side = 0 if constraint.bodies[1] == GROUND else 1
        body, point = constraint.bodies[side], np.asarray(points, float)[side]
        anchors.append([bodies.index(body), *point.tolist()])
        forces.append(np.asarray(loads[name][body])[:, :2])
        unique.append(bool(np.asarray(uniqueness[name][body])[alive, :2].all()))
    return anchors, np.stack(forces, axis=1) if forces else np.zeros((len(solution.ts), 0, 2)), unique
