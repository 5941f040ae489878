"""Findings about a drawing, which the page says: freedoms, redundancy and its cure, unique reactions, how far a motor turns."""

import math

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.integrate import SimulationError
from udkjax.positions.assembly import AssemblyError
from udkjax.positions.continuation import Reached
from udkjax.positions.kinematics import travel
from udkjax.scene import GROUND, Mechanism, SceneError
from udkjax.scene.joints import Revolute, Slot
from udkjax.scene.wording import plural
from udkjax.statics.equilibrium import equilibrium
from udkjax.studio.limits import RefusedError
from udkjax.studio.shown_runs import force_curves, holding_curves
from udkjax.study.diagnosis import Diagnosis, diagnose
from udkjax.study.diagnosis.fixes import Fix

MOST_FIXES = 8  # fixes listed for one redundancy
IN_LINE = 1e-4  # rad: of a toggle that is found to rounding, whose angle errs by the root of that


def examine(mechanism: Mechanism, about: str) -> JsonObject:
    """Return the findings about a subject.

    Args:
        mechanism: the drawing's.
        about: "structure" (freedoms, redundancy, reactions), "travel" (how far each motor turns), "dynamics" (curves of forces),
            "rest" (a position of rest), or "holding" (curves of forces where motors hold it still).
    """
    subjects = {"structure": structure, "travel": motor_travel, "dynamics": force_curves, "rest": rest, "holding": holding_curves}
    if about not in subjects:
        raise RefusedError(400, f"about: must be one of {', '.join(subjects)}")
    try:
        return subjects[about](mechanism) | {"problems": []}
    except (AssemblyError, SimulationError) as error:
        return {"problems": [str(error)]}


def structure(mechanism: Mechanism) -> JsonObject:
    """Return freedoms, sets of redundant constraints with what mends them, and which reactions are unique."""
    found = diagnose(mechanism, walk=False)
    loose = {
        name: {"components": [bool(x) for x in forces.unique], "direction": forces.direction}
        for name, forces in found.forces.items()
        if not all(forces.unique)
    }
    return {
        "freedoms": found.degrees_of_freedom,
        "joint_freedoms": found.joint_mobility,
        "gruebler": found.gruebler,
        "redundant": found.rows - found.ordinary_rank,
        "singular": bool(found.is_singular),
        "motion": _why(found, mechanism),
        "sets": [
            {
                "constraints": list(r.constraints),
                "count": r.count,
                "permanent": r.permanent,
                "fixes": [
                    {"constraint": fix.constraint, "change": fix.change, "drawn": drawn_change(fix)}
                    for fix in r.fixes[:MOST_FIXES]
                ],
            }
            for r in found.redundancies
        ],
        "loose": loose,
        "text": str(found),
    }


def drawn_change(fix: Fix) -> JsonObject | None:
    """Return a fix as a change of the drawing: a constraint that is gone, or the slot that takes a pin's place; else None."""
    joint = fix.mechanism.joints.get(fix.constraint)
    if joint is None:
        return {"kind": "remove"}
    if not isinstance(joint, Slot):
        return None
    on, guided = joint.bodies
    angle = float(joint.axis) + (0.0 if on == GROUND else float(fix.mechanism.bodies[on].angle))
    return {"kind": "slot", "on": on, "link": guided, "direction": [math.cos(angle), math.sin(angle)]}


def _why(found: Diagnosis, mechanism: Mechanism) -> str:
    """Describe how the mechanism moves, or why it does not."""
    drivers = list(mechanism.drivers)
    if found.joint_mobility <= 0:
        if found.is_singular:
            return "it cannot move: it gives way to first order only"
        return f"it cannot move: its joints hold all {found.coordinates} coordinates of its bodies. Take a joint or a link away"
    if drivers and found.mobility == 0 and not found.is_singular:
        return f"{_names(drivers)} {'moves' if len(drivers) == 1 else 'move'} all of it"
    if len(drivers) > found.joint_mobility:
        return f"{plural(len(drivers), 'motor')} for {plural(found.joint_mobility, 'freedom')}: they must agree with each other"
    free = plural(found.degrees_of_freedom, "freedom")
    if drivers:
        return f"{_names(drivers)} and the loads move it; {free} left to the loads"
    if mechanism.forces or np.any(np.asarray(mechanism.gravity)):
        return f"{free}: loads and gravity move it; a motor would drive it"
    return f"{free}, and nothing that drives it: add a motor or a load"


def _names(names: list[str]) -> str:
    return ", ".join(names)


def rest(mechanism: Mechanism) -> JsonObject:
    """Return the position of rest next to the drawn one, downhill if need be, and its frequencies (Hz)."""
    found = equilibrium(mechanism, stable=True)
    rates = [float(x) for x in np.asarray(found.omega2)]
    return {
        "q": np.asarray(found.q).ravel().tolist() if bool(found.balanced) else None,
        "kind": found.kind,
        "frequencies": [math.sqrt(x) / (2 * math.pi) for x in rates if x > 0],
    }


def motor_travel(mechanism: Mechanism) -> JsonObject:
    """Return the travel of each motor from the drawn position, where the others hold, and the pins in line at its limits."""
    found = []
    for name, driver in mechanism.drivers.items():
        if driver.coordinate == "y":
            continue
        try:
            ends_of = travel(mechanism, name)
        except SceneError:
            continue  # positions do not follow from this motor
        start = float(np.asarray(driver.motion(0.0)))
        ends = []
        for limit, q in ((ends_of.lower, ends_of.lower_q), (ends_of.upper, ends_of.upper_q)):
            if np.isfinite(float(limit)):
                ends.append({"value": float(limit) - start, "in_line": pins_in_line(mechanism, np.asarray(q))})
        lost = [side for side, code in zip(("back", "ahead"), np.asarray(ends_of.status), strict=True) if code == Reached.lost]
        found.append({"motor": name, "unit": ends_of.unit, "ends": ends, "lost": lost})
    return {"travel": found}


def pins_in_line(mechanism: Mechanism, q: np.ndarray) -> list[list[str]]:
    """Return the pins that are in line in a position: of two links that share one, and of further ones on that line."""
    frames = dict(zip(mechanism.bodies, q, strict=True))
    pins = {name: joint for name, joint in mechanism.joints.items() if isinstance(joint, Revolute)}
    places = {}
    for name, joint in pins.items():
        body = joint.bodies[0] if joint.bodies[0] in frames else joint.bodies[1]
        point = np.asarray(joint.points)[joint.bodies.index(body)]
        x, y, angle = frames[body]
        c, s = math.cos(angle), math.sin(angle)
        places[name] = np.array([x + c * point[0] - s * point[1], y + s * point[0] + c * point[1]])
    found: list[list[str]] = []
    for middle, joint in pins.items():
        one, two = joint.bodies
        if "ground" in (one, two):
            continue
        for a, other in pins.items():
            for c, last in pins.items():
                if len({a, middle, c}) == 3 and one in other.bodies and two in last.bodies:
                    u, w = places[a] - places[middle], places[c] - places[middle]
                    size = np.linalg.norm(u) * np.linalg.norm(w)
                    if size > 0 and abs(u[0] * w[1] - u[1] * w[0]) <= IN_LINE * size:
                        _add_to_line(found, [a, middle, c], places)
    return found


def _add_to_line(lines: list[list[str]], pins: list[str], places: dict[str, np.ndarray]) -> None:
    """Put three pins in line on the line that has two of these places already, or on a new one; each place once."""
    near = IN_LINE * np.ptp(list(places.values()), axis=0).max()
    for line in lines:
        new = [pin for pin in pins if all(np.linalg.norm(places[pin] - places[other]) > near for other in line)]
        if len(new) <= len(pins) - 2:
            line += new
            return
    lines.append(pins)
