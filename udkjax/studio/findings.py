"""Findings about a drawing, shown by the page: degrees of freedom, redundant constraints, unique reactions, travel of motors."""

import math
from functools import partial

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.integrate import SimulationError
from udkjax.integrate.causes.find import cause_of_standstill
from udkjax.positions.answers.centres import centres_table
from udkjax.positions.answers.characteristics import characteristics
from udkjax.positions.answers.counting import Count
from udkjax.positions.answers.pin_motion import pin_motion, usual_rate
from udkjax.positions.assembling.assembly import AssemblyError, assemble
from udkjax.positions.assembling.coordinates import value_of
from udkjax.positions.following.continuation import Reached
from udkjax.positions.following.drive import only_driver
from udkjax.positions.following.kinematics import kinematics
from udkjax.positions.following.travel import travel
from udkjax.positions.gaps.gaps import gaps
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.show.player.gap_records import outlines
from udkjax.statics.equilibrium import equilibrium
from udkjax.statics.resting_forces import forces_table
from udkjax.studio.drawn_fixes import drawn_fix
from udkjax.studio.limits import RefusedError
from udkjax.studio.shown_runs import duration_of, force_curves, holding_curves
from udkjax.study.diagnosis import Diagnosis, diagnose
from udkjax.wording import plural

MOST_FIXES = 8  # fixes listed for one redundancy
IN_LINE = 1e-4  # rad: the error of an angle at a dead point is the square root of the rounding error


def examine(mechanism: Mechanism, text: str, about: str, end: JsonObject | None = None) -> JsonObject:
    """Return the findings about a subject as JSON, with `problems`: the reason why there are none, or an empty list.

    Args:
        mechanism: mechanism of the drawing.
        text: text of the drawing.
        about: "structure" (degrees of freedom, redundant constraints, reactions), "travel" (of each motor), "dynamics" (curves
            of forces), "rest" (an equilibrium), "holding" (curves of holding torques and forces), "answers" (the answers of a
            course), "gaps" (between links), or "end" (the cause of the early end of a run).
        end: for "answers", the value `at` of the motor, a text with its unit; for "end", a state `t`, `q`, `v` of the run, as the
            page sends it, and the time `end` (s) at which it ended.

    Raises:
        RefusedError: there is no such subject, or `end` lacks numbers.
    """
    if about == "end":
        return {"cause": _cause(mechanism, end or {}), "problems": []}
    subjects = {
        "structure": partial(structure, text=text),
        "travel": motor_travel,
        "dynamics": force_curves,
        "rest": rest,
        "holding": holding_curves,
        "answers": partial(answers, at=(end or {}).get("at")),
        "gaps": least_gaps,
    }
    if about not in subjects:
        raise RefusedError(400, f"about: must be one of {', '.join(subjects)}")
    try:
        return subjects[about](mechanism) | {"problems": []}
    except (AssemblyError, SimulationError) as error:
        return {"problems": [str(error)]}


def answers(mechanism: Mechanism, at: object = None) -> JsonObject:
    """Return the characteristics of a mechanism with one motor, and tables of pins, links and instant centres in one position.

    Without a single motor, both are empty. `at` is the value of the motor as a text with its unit; by default it is as drawn.
    """
    if len(mechanism.driver_names) != 1:
        return {"answers": [], "tables": []}
    driver = only_driver(mechanism)
    count, rate = Count.of(mechanism, driver), usual_rate(mechanism, driver)
    drawn = float(value_of(mechanism, driver)(assemble(mechanism).q))
    value = count.nearest(count.read(at, "at"), drawn) if isinstance(at, str) else drawn
    motion = kinematics(mechanism, driver, [value], rate=rate)
    lines = [list(line) for line in characteristics(mechanism, driver).lines().items()]
    tables = [*pin_motion(mechanism, motion).counted(count).tables(), centres_table(mechanism, motion, count)]
    if np.all(motion.reached) and (forces := forces_table(mechanism, np.asarray(motion.q)[0])):
        tables.insert(2, forces)
    shown = [{"title": x.title, "heads": list(x.heads), "rows": [[str(cell) for cell in row] for row in x.rows]} for x in tables]
    return {"answers": lines, "tables": shown}


def least_gaps(mechanism: Mechanism) -> JsonObject:
    """Return the least gap of each pair of links over the range of the motor, with the pose in which it occurs.

    `counted` describes the zero of the motor's values; `parts` and `pairs` are the outlines of links in frames of the drawing.
    """
    found = gaps(mechanism, only_driver(mechanism))
    frames = {name: np.array([*np.asarray(body.position), body.angle]) for name, body in mechanism.bodies.items()}
    rows = [
        {"words": words, "gap": gap, "at": at, "touches": float(least.distance) <= 0, "q": np.ravel(least.q).tolist()}
        for (words, gap, at), least in zip(found.rows(), found.pairs, strict=True)
    ]
    counted = "" if found.count is None else found.count.words
    return {"gaps": rows, "counted": counted, "remarks": found.remarks(), **outlines(found, mechanism.body_names, frames)}


def _cause(mechanism: Mechanism, end: JsonObject) -> str:
    """Return the reason why motors stopped a run, which ended as `end` describes; "" if they did not stop it."""
    try:
        t, until, q, v = float(end["t"]), float(end["end"]), *(np.asarray(end[key], float) for key in "qv")
    except (KeyError, TypeError, ValueError):
        raise RefusedError(400, "end: must have numbers t and end, and lists q and v") from None
    if not (q.shape == v.shape == (3 * len(mechanism.bodies),) and all(np.isfinite(x).all() for x in (t, until, q, v))):
        raise RefusedError(400, "end: q and v must have three finite numbers for each link")
    return cause_of_standstill(mechanism, duration_of(mechanism), (t, q, v), until)


def structure(mechanism: Mechanism, text: str) -> JsonObject:
    """Return degrees of freedom, sets of redundant constraints with their fixes, and reactions that are not unique.

    `motion` says in words if the mechanism moves, and `conflict` why no velocities satisfy its constraints.
    """
    diagnosis = diagnose(mechanism, walk=False)
    not_unique = {
        name: {"components": [bool(x) for x in forces.unique], "direction": forces.direction}
        for name, forces in diagnosis.forces.items()
        if not all(forces.unique)
    }
    return {
        "degrees_of_freedom": diagnosis.degrees_of_freedom,
        "joint_mobility": diagnosis.joint_mobility,
        "gruebler": diagnosis.gruebler,
        "redundant": diagnosis.rows - diagnosis.ordinary_rank,
        "singular": bool(diagnosis.is_singular),
        "motion": _why(diagnosis, mechanism),
        "conflict": _conflict(mechanism),
        "sets": [
            {
                "constraints": list(redundancy.constraints),
                "count": redundancy.count,
                "permanent": redundancy.permanent,
                "fixes": [
                    {"constraint": fix.constraint, **drawn_fix(text, mechanism, fix)} for fix in redundancy.fixes[:MOST_FIXES]
                ],
            }
            for redundancy in diagnosis.redundancies
        ],
        "not_unique": not_unique,
        "text": str(diagnosis),
    }


def _conflict(mechanism: Mechanism) -> str:
    """Return the reason why no velocities satisfy all constraints as drawn, with the names of the motors; "" if some do."""
    try:
        assemble(mechanism)
    except AssemblyError as error:
        return str(error)
    return ""


def _why(diagnosis: Diagnosis, mechanism: Mechanism) -> str:
    """Return a sentence about the motion of a mechanism: its cause, or the reason why there is none, with advice."""
    drivers = list(mechanism.drivers)
    if diagnosis.joint_mobility <= 0:
        if diagnosis.is_singular:
            return "The mechanism cannot move, except infinitesimally"
        return f"The mechanism cannot move: its joints fix all {diagnosis.coordinates} coordinates. Remove a joint or a link"
    names = ", ".join(drivers)
    if drivers and diagnosis.mobility == 0 and not diagnosis.is_singular:
        return f"{names} {'determines' if len(drivers) == 1 else 'determine'} the whole motion"
    if len(drivers) > diagnosis.joint_mobility:
        return f"{plural(len(drivers), 'motor')} for {_freedom(diagnosis.joint_mobility)}: their motions must agree"
    if drivers:
        return f"{names} and the loads move the mechanism; {_freedom(diagnosis.degrees_of_freedom)} left to the loads"
    if mechanism.forces or np.any(np.asarray(mechanism.gravity)):
        return "Gravity and loads move the mechanism; add a motor to drive it"
    return "Nothing moves the mechanism: add a motor or a load"


def _freedom(count: int) -> str:
    return f"{count} {'degree' if count == 1 else 'degrees'} of freedom"


def rest(mechanism: Mechanism) -> JsonObject:
    """Return the stable equilibrium near the drawn position, and its natural frequencies (Hz); `q` is None if none was found."""
    balance = equilibrium(mechanism, stable=True)
    rates = [float(x) for x in np.asarray(balance.omega2)]
    return {
        "q": np.asarray(balance.q).ravel().tolist() if bool(balance.balanced) else None,
        "kind": balance.kind,
        "frequencies": [math.sqrt(x) / (2 * math.pi) for x in rates if x > 0],
    }


def motor_travel(mechanism: Mechanism) -> JsonObject:
    """Return the travel of each motor, with the others held, and the pins that are in line at its limits.

    Limits are counted from the zero that `words` describe. Left out are motors that do not determine the positions, and drivers
    of a coordinate y.
    """
    travels = []
    for name, driver in mechanism.drivers.items():
        if driver.coordinate == "y":
            continue
        try:
            range_of_motor = travel(mechanism, name)
        except SceneError:
            continue  # this motor does not determine the positions
        counted, ends = Count.of(mechanism, name), []
        for limit, q in ((range_of_motor.lower, range_of_motor.lower_q), (range_of_motor.upper, range_of_motor.upper_q)):
            if np.isfinite(float(limit)):
                ends.append({"value": float(limit) + counted.offset, "in_line": pins_in_line(mechanism, np.asarray(q))})
        lost = [
            side for side, code in zip(("lower", "upper"), np.asarray(range_of_motor.status), strict=True) if code == Reached.lost
        ]
        travels.append({"motor": name, "unit": range_of_motor.unit, "words": counted.words, "ends": ends, "lost": lost})
    return {"travel": travels}


def pins_in_line(mechanism: Mechanism, q: np.ndarray) -> list[list[str]]:
    """Return the lines of pins in a position: each contains the pins of two links with a common pin, and further pins."""
    frames = dict(zip(mechanism.bodies, q, strict=True))
    pins = {name: joint for name, joint in mechanism.joints.items() if isinstance(joint, Revolute)}
    places = {}
    for name, joint in pins.items():
        body = joint.bodies[0] if joint.bodies[0] in frames else joint.bodies[1]
        point = np.asarray(joint.points)[joint.bodies.index(body)]
        x, y, angle = frames[body]
        third, s = math.cos(angle), math.sin(angle)
        places[name] = np.array([x + third * point[0] - s * point[1], y + s * point[0] + third * point[1]])
    lines: list[list[str]] = []
    for middle, joint in pins.items():
        body1, body2 = joint.bodies
        if "ground" in (body1, body2):
            continue
        for first, first_joint in pins.items():
            for third, last_joint in pins.items():
                if len({first, middle, third}) == 3 and body1 in first_joint.bodies and body2 in last_joint.bodies:
                    to_first, to_third = places[first] - places[middle], places[third] - places[middle]
                    size = np.linalg.norm(to_first) * np.linalg.norm(to_third)
                    if size > 0 and abs(to_first[0] * to_third[1] - to_first[1] * to_third[0]) <= IN_LINE * size:
                        _add_to_line(lines, [first, middle, third], places)
    return lines


def _add_to_line(lines: list[list[str]], pins: list[str], places: dict[str, np.ndarray]) -> None:
    """Add three collinear pins to the line that contains two of their positions, or else as a new line.

    A pin at the place of a pin of the line is not added to it.
    """
    near = IN_LINE * np.ptp(list(places.values()), axis=0).max()
    for line in lines:
        new = [pin for pin in pins if all(np.linalg.norm(places[pin] - places[other]) > near for other in line)]
        if len(new) <= len(pins) - 2:
            line += new
            return
    lines.append(pins)
