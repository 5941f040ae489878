"""Joint types and the modules that treat them specially: each cell of the table is tested by calling the module.

"served": the module treats this type differently from a user-defined class with the same equations; "refused": an error names
the joint; "-": the module treats it like any joint. A new type that no module knows needs no entry; the author of another
reads off which modules may have to handle it.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.elements import BODIES, JOINTS, P
from udkjax.integrate.causes.reach import Reach, dead_point
from udkjax.integrate.events.law.conditions import joint_coordinate
from udkjax.show.player.marks.marks import marks
from udkjax.show.player.marks.symbol_updates import symbol_updates
from udkjax.show.player.marks.symbols import symbols_of
from udkjax.statics.reaction_peaks import cam_forces
from udkjax.studio.drawn_fixes import drawn_fix
from udkjax.studio.drawn_scenes import drawing_text_of
from udkjax.study.diagnosis.configuration import RankedPositions
from udkjax.study.diagnosis.fixes import Fix, changes_of
from udkjax.study.report import row_label

UNKNOWN = "mjcf, tree | mjcf, loop | drawings | event limits | transmission"  # where a type that no module knows is refused


class Cells(NamedTuple):
    """The modules that serve a type, and those that refuse it; the others treat it like any joint."""

    served: str = ""
    refused: str = UNKNOWN


# A type without an entry is `Cells()`.
TABLE = {
    "Revolute": Cells(
        "row labels | mjcf, tree | mjcf, loop | drawings | with_angle | event limits | dead points | "
        "one compliance | pin directions | explained pins | fixes | transmission | motion ranges",
        "",
    ),
    "Prismatic": Cells(
        "row labels | marks | mjcf, tree | drawings | event limits | joint axes | fixes | motion ranges",
        "mjcf, loop | one compliance | transmission",
    ),
    "Slot": Cells(
        "marks | mjcf, tree | drawings | drawn fixes | event limits | joint axes",
        "mjcf, loop | transmission",
    ),
    "Weld": Cells(
        "row labels | marks | mjcf, tree | mjcf, loop | with_angle | pin directions | explained pins | fixes",
        "drawings | event limits | one compliance | transmission",
    ),
    "Distance": Cells(
        "marks | mjcf, tree | mjcf, loop | drawings | joint axes",
        "event limits | transmission",
    ),
    "Angle": Cells(
        "mjcf, tree | mjcf, loop",
        "drawings | event limits | transmission",
    ),
    "Gear": Cells(
        "marks | followers | mjcf, tree | mjcf, loop | drawings",
        "event limits | transmission",
    ),
    "Rack": Cells(
        "marks | followers | joint axes",
    ),
    "Screw": Cells(
        "marks | joint axes",
    ),
    "Coupling": Cells(
        "marks | joint axes",
    ),
    "KnifeEdge": Cells(
        "marks | joint axes",
    ),
    "Wheel": Cells(
        "marks | joint axes",
        "mjcf, tree | mjcf, loop | drawings | event limits | one compliance | transmission",
    ),
    "Cam": Cells(
        "marks | cam forces",
    ),
}


class Own(udk.Joint):
    """A user-defined joint with the equations of another."""

    other: udk.Joint

    @property
    def frame_names(self):
        return self.other.frame_names

    def residual(self, t, *frames):
        return self.other.residual(t, *frames)

    def complete(self, *frames):
        return eqx.tree_at(lambda own: own.other, self, self.other.complete(*frames))


class OwnAtPoints(Own):
    """The same for joints with points."""

    @property
    def points(self):
        return self.other.points  # pyright: ignore[reportAttributeAccessIssue]


class OwnRolling(udk.RollingJoint):
    """The same for joints that restrict velocities alone."""

    other: udk.RollingJoint

    @property
    def frame_names(self):
        return self.other.frame_names

    def rates(self, t, *frames):
        return self.other.rates(t, *frames)


class Motion(NamedTuple):
    """A motion through some states."""

    ts: jax.Array
    q: jax.Array
    v: jax.Array


def own(joint: udk.Joint) -> udk.Joint:
    if isinstance(joint, udk.RollingJoint):
        return OwnRolling(joint.bodies, joint)
    kind = OwnAtPoints if getattr(joint, "points", None) is not None else Own
    return kind(joint.bodies, joint)  # pyright: ignore[reportCallIssue]


def scene(joints: dict[str, udk.Joint], bodies: dict[str, udk.Body] = BODIES) -> udk.Mechanism:
    """Return a mechanism that starts closed."""
    mechanism = udk.Mechanism(bodies, joints)
    state = udk.assemble(mechanism)
    places = {f"body.{name}.position": q[:2] for name, q in zip(bodies, state.q, strict=True)}
    return mechanism.with_parameters(places | {f"body.{name}.angle": q[2] for name, q in zip(bodies, state.q, strict=True)})


def chain(joint: udk.Joint) -> udk.Mechanism:
    """Return two links in line, pinned to the ground at their outer ends, with a joint between them."""
    bodies = {"a": udk.Body(1.0, 0.1, [0.5, 0.0]), "b": udk.Body(1.0, 0.1, [1.5, 0.0]), "c": udk.Body(1.0, 0.1, [1.0, 1.0])}
    more = {"points": ((0.5, 0.0), (-0.4, 0.0))} if getattr(joint, "points", None) is not None else {}
    outer = udk.Revolute(["ground", "a"], [[0, 0], [-0.5, 0]]), udk.Revolute(["ground", "b"], [[2, 0], [0.5, 0]])
    return udk.Mechanism(bodies, {"A": outer[0], "J": replace(joint, bodies=("a", "b"), **more), "B": outer[1]})


def motion_of(mechanism: udk.Mechanism, turn: float = 0.0) -> Motion:
    """Return a motion that begins at the initial guess, with the same rotation of all bodies at each time."""
    q = jnp.stack([mechanism.q0, mechanism.q0 + jnp.array([0.0, 0.0, turn])])
    return Motion(jnp.array([0.0, 1.0]), q, 0 * q)


def outcome(is_served: Callable[[], object]) -> str:
    """Return the outcome of a call: "refused" if the error names the joint."""
    try:
        return "served" if is_served() else "-"
    except (udk.SceneError, ValueError) as error:
        assert "J" in str(error)
        return "refused"


def kinds_of_marks(joint: udk.Joint) -> Counter:
    mechanism = udk.Mechanism(BODIES, {"J": joint})
    return Counter(mark["kind"] for mark in marks(mechanism, mechanism.q0[None]))


def follows_radius(joint: udk.Joint) -> bool:
    mechanism = udk.Mechanism(BODIES, {"J": joint})
    symbols = symbols_of(marks(mechanism, mechanism.q0[None]), 0.1)
    record = {"marks": [], "traces": [], "reactions": None, "measures": []}
    return bool(symbol_updates(mechanism, record, symbols, 0)["sizes"])


def axles(joint: udk.Joint) -> dict[str, udk.Joint]:
    """Return the pins of wheels on their carrier, one for each wheel."""
    if not isinstance(joint, udk.Gear):
        return {}
    frames = {name: body.frame() for name, body in BODIES.items()}
    places = [(frames[name].x, frames[name].y) for name in joint.bodies]
    if joint.carrier != "ground":
        carrier = frames[joint.carrier]
        places = [carrier.local((x - carrier.x, y - carrier.y))[:2] for x, y in places]
    pairs = zip(joint.bodies, places, strict=True)
    return {f"axle {name}": udk.Revolute([joint.carrier, name], [place, (0.0, 0.0)]) for name, place in pairs}


def reactions_differ(joint: udk.Joint) -> bool:
    """Return True if loads in the axes and about the points of the joint differ from those of a user-defined joint."""
    found = []
    for one in (joint, own(joint)):
        mechanism = scene({"J": one})
        mechanism = udk.Mechanism(
            dict(mechanism.bodies), dict(mechanism.joints), forces={"push": udk.Force("b", [1.0, 2.0], P[0])}
        )
        loads = udk.reactions(mechanism, motion_of(mechanism), frame="joint", about="joint", method=udk.SVD())
        found.append(np.concatenate([np.asarray(load) for load in loads["J"].values()]))
    size = np.abs(found[0]).max()
    assert size > 0
    return bool(np.abs(found[0] - found[1]).max() > 1e-9 * size)


def slot_for(joint: udk.Joint) -> udk.Slot:
    """Return a slot through the point of a joint, which holds one of its directions a second time."""
    points = getattr(joint, "points", None)
    return udk.Slot(joint.bodies, P if points is None else np.asarray(points), axis=0.3)


def can_be_drawn(joint: udk.Joint) -> bool:
    """Return True if the studio can draw a joint between a body and the ground, or between meshing wheels on a carrier."""
    pins = axles(joint)
    if isinstance(joint, udk.Gear):
        one, two = (BODIES[name].position for name in joint.bodies)
        apart = jnp.linalg.norm(two - one)
        first, second = joint.radii
        joint = replace(joint, radii=joint.radii * apart / abs(second - first if joint.internal else second + first))
    else:
        joint = replace(joint, bodies=("ground", "b"))
    bodies = {name: body for name, body in BODIES.items() if name in joint.frame_names}
    return '"J"' in drawing_text_of(scene({"J": joint, **pins}, bodies))


def with_slot(joint: udk.Joint) -> udk.Mechanism:
    return scene({"J": joint, "again": slot_for(joint)})


def moves_on_pins(joint: udk.Joint) -> bool:
    """Return True if a body follows another that is turned."""
    mechanism = chain(joint)
    hanging = udk.Mechanism(dict(mechanism.bodies), {name: mechanism.joints[name] for name in "AJ"})
    return bool(np.any(udk.with_angle(hanging, "a", 0.3).q0[1] != hanging.q0[1]))


def has_fixes(joint: udk.Joint) -> bool:
    """Return True if a constraint can be relaxed without removing it."""
    mechanism = scene({"J": joint})
    at = RankedPositions(mechanism, 1e-9).at(0.0, np.asarray(mechanism.q0, float).ravel())
    return len(list(changes_of(mechanism, "J", at, lambda: np.ones((len(udk.analyse(mechanism).row_names), 1))))) > 1


def ranges(joint: udk.Joint) -> bool:
    mechanism = udk.Mechanism(BODIES, {"J": replace(joint, bodies=("ground", "b"))})
    found = udk.motion_ranges(mechanism, motion_of(mechanism, 0.5))
    return bool(found.swings or found.strokes)


def peaks(joint: udk.Joint) -> bool:
    mechanism = scene({"J": joint})
    return bool(cam_forces(mechanism, motion_of(mechanism)))


def compliance(joint: udk.Joint) -> bool:
    """Return True if one number serves several rows; for a single row, every joint accepts one number."""
    mechanism = scene({"J": joint})
    udk.reactions(mechanism, motion_of(mechanism), compliances={"J": 0.1})
    return len(udk.analyse(mechanism).row_names) > 1


def dead(joint: udk.Joint) -> bool:
    mechanism = chain(joint)
    return "pins A, J, B in line" in dead_point(mechanism, Reach(0.0, np.ravel(mechanism.q0), frozenset("AJB")), [])


def fix(joint: udk.Joint) -> bool:
    """Return whether a pin J that becomes this joint becomes something that is drawn."""
    links = "".join(f'[[link]]\nname = "{name}"\npins = ["J", "{name[0]}"]\nmass = 1\n' for name in BODIES)
    ends = "".join(f"{name[0]} = [1, {k}]\n" for k, name in enumerate(BODIES))
    text = f"format = 2\nground = []\n[pins]\nJ = [0, 0]\n{ends}{links}"
    changed = Fix("J", "as before", 1, 1.0, udk.Mechanism(BODIES, {"J": joint}))
    return drawn_fix(text, udk.loads(text), changed)["change"] != "as before"


CHECKS: dict[str, Callable[[udk.Joint], object]] = {
    "row labels": lambda joint: "row" not in row_label(udk.Mechanism(BODIES, {"J": joint}), "J", 0),
    "marks": lambda joint: kinds_of_marks(joint) != kinds_of_marks(own(joint)),
    "followers": follows_radius,
    "mjcf, tree": lambda joint: udk.mjcf_text(scene({"J": joint, **axles(joint)})),
    "mjcf, loop": lambda joint: udk.mjcf_text(scene({"I": slot_for(joint), "J": joint, **axles(joint)})),
    "drawings": can_be_drawn,
    "drawn fixes": fix,
    "with_angle": moves_on_pins,
    "event limits": lambda joint: joint_coordinate(udk.Mechanism(BODIES, {"J": joint}), "J", "limit") is not None,
    "dead points": dead,
    "joint axes": reactions_differ,
    "one compliance": compliance,
    "cam forces": peaks,
    "pin directions": lambda joint: udk.diagnose(with_slot(joint), fixes=False, walk=False).forces["J"].direction is not None,
    "explained pins": lambda joint: "J: only the component of its force along" in str(udk.explain(with_slot(joint))),
    "fixes": has_fixes,
    "transmission": lambda joint: udk.transmission_angle(chain(joint), motion_of(chain(joint)), "J").shape,
    "motion ranges": ranges,
}


def cell(kind: str, module: str) -> str:
    """Return the outcome that the table says."""
    served, refused = (modules.split(" | ") for modules in TABLE.get(kind, Cells()))
    return "served" if module in served else "refused" if module in refused else "-"


def test_the_table_names_types_and_checks():
    assert TABLE.keys() <= {type(joint).__name__ for joint in JOINTS.values()}
    for cells in TABLE.values():
        assert {module for modules in cells for module in modules.split(" | ") if modules} <= CHECKS.keys()


@pytest.mark.parametrize("module", CHECKS)
@pytest.mark.parametrize("name", JOINTS)
def test_modules_treat_joint_types_as_the_table_says(module, name):
    joint = JOINTS[name]
    kind = type(joint).__name__
    assert outcome(lambda: CHECKS[module](joint)) == cell(kind, module), f"{kind}: change its entry in TABLE"
