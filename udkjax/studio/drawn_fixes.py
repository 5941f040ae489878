"""Fixes of redundant constraints as changes of a drawing that moves as before: a pin becomes a slot, or an element goes."""

import math
from collections.abc import Iterator
from itertools import count

import numpy as np

from udkjax.annotations import JsonObject, Number
from udkjax.scene.drawing.drawing_tables import LISTS
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Revolute, Slot
from udkjax.scene.files import loads
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.studio.text_edits import Document, merge_document, read_document
from udkjax.study.diagnosis.fixes import Fix

ROUNDING = 1e-9  # relative: a drawing that is read again has the same bodies to this
DIGITS = 12  # decimals of the components of a direction, and digits of a centre
MASS_KEYS = ("density", "thickness", "width", "outline", "mass", "inertia", "centre")  # keys that give a link its mass


def drawn_fix(text: str, mechanism: Mechanism, fix: Fix) -> JsonObject:
    """Return a fix of a drawing's mechanism as JSON: its description, `change`, and the changed tables, `document`.

    The document is None if no change of the drawing can be read and has the bodies, forces, drivers and joints of the fix.

    Args:
        text: text of the drawing.
        mechanism: mechanism of the drawing.
        fix: a fix of its redundant constraints.
    """
    joint, changed, change = mechanism.joints.get(fix.constraint), fix.mechanism.joints.get(fix.constraint), fix.change
    tables, candidates = read_document(text), iter(())
    if isinstance(joint, Revolute) and isinstance(changed, Slot):
        base, guided = changed.bodies
        named = ["the ground" if body == GROUND else body for body in (base, guided)]
        change = f"let the pin on {named[1]} slide in a slot of {named[0]}"
        angle = float(changed.axis) + float(_angle(mechanism, base))
        candidates = iter([_with_slot(*_split(tables, base, guided, fix.constraint), base, angle)])
    elif changed is None:
        candidates = (
            _without_pin(tables, mechanism, joint, fix.constraint)
            if isinstance(joint, Revolute)
            else _without(tables, fix.constraint)
        )
    return {"change": change, "document": next((x for x in candidates if _is_fixed(text, x, fix.mechanism)), None)}


def _is_fixed(text: str, document: Document, fixed: Mechanism) -> bool:
    """Return True if a text with the tables of a document can be read, and gives the mechanism `fixed`, judged by `_is_same`."""
    try:
        return _is_same(loads(merge_document(text, document)), fixed)
    except SceneError:  # such as a motor at a pin that two links no longer share
        return False


def _angle(mechanism: Mechanism, body: str) -> Number:
    return 0.0 if body == GROUND else mechanism.bodies[body].angle


def _without(tables: Document, constraint: str) -> Iterator[Document]:
    """Yield the document without the element that is named `constraint`, for each section with such an element."""
    for section in (s for s in LISTS if s != "link"):
        entries = tables.get(section, [])
        for k, entry in enumerate(entries):
            if entry.get("name", f"{section}{k + 1}") == constraint:
                rest = [*entries[:k], *entries[k + 1 :]]
                yield {key: x for key, x in tables.items() if key != section} | ({section: rest} if rest else {})


def _without_pin(tables: Document, mechanism: Mechanism, joint: Revolute, constraint: str) -> Iterator[Document]:
    """Yield documents in which one of the two bodies of a revolute has lost its pin.

    First the ground loses it, if it is one of the bodies; then each link; then each link again, with its mass, inertia and centre
    written as numbers, since its shape would give other numbers without the pin.
    """
    pin = _pin_of(tables, constraint)
    if GROUND in joint.bodies:
        yield {**tables, "ground": [name for name in tables.get("ground", ()) if name != pin]}
    for numbers in (False, True):
        for body in (body for body in joint.bodies if body != GROUND):
            links = []
            for link in tables["link"]:
                pins = [name for name in link["pins"] if name != pin]
                kept = {key: x for key, x in link.items() if not (numbers and key in MASS_KEYS)}
                more = _body_numbers(mechanism, body) if numbers else {}
                links.append({**kept, "pins": pins, **more} if link["name"] == body else link)
            yield {**tables, "link": links}


def _body_numbers(mechanism: Mechanism, body: str) -> JsonObject:
    """Return mass, inertia and centre of a link as they are written in a drawing."""
    found = mechanism.bodies[body]
    centre = [f"{1e3 * float(x):.{DIGITS}g} mm" for x in np.asarray(found.position)]
    return {"mass": f"{float(found.mass)!r} kg", "inertia": f"{float(found.inertia)!r} kg m2", "centre": centre}


def _pin_of(tables: Document, constraint: str) -> str:
    """Return the pin of a revolute by the revolute's name; "" if there is none.

    A revolute is named like its pin, followed by "-" and a number if the pin has more than two links.
    """
    return max((name for name in tables["pins"] if constraint == name or constraint.startswith(f"{name}-")), key=len, default="")


def _split(tables: Document, base: str, guided: str, constraint: str) -> tuple[Document, str]:
    """Return the document in which two bodies do not share the pin of a revolute, and the pin that belongs to `guided`.

    Of the links at a pin, each turns on the first. The first link keeps the pin, and the other one gets a new pin at the same
    place, so that both keep their shapes. The ground has no shape: where it is the base of a single link, it loses the pin.
    """
    pin = _pin_of(tables, constraint)
    met = [GROUND] * (pin in tables.get("ground", ())) + [link["name"] for link in tables["link"] if pin in link["pins"]]
    if base == GROUND and len(met) == 2:
        return {**tables, "ground": [name for name in tables["ground"] if name != pin]}, pin
    fresh = next(name for k in count(2) if (name := f"{pin}{k}") not in tables["pins"])
    moved = max(base, guided, key=met.index)
    links = [
        {**link, "pins": [fresh if name == pin else name for name in link["pins"]]} if link["name"] == moved else link
        for link in tables["link"]
    ]
    pins = {**tables["pins"], fresh: tables["pins"][pin]}
    return {**tables, "pins": pins, "link": links}, fresh if moved == guided else pin


def _with_slot(tables: Document, pin: str, base: str, angle: float) -> Document:
    """Return the document with a slot of `base` for a pin, in the direction of an angle (rad)."""
    direction = [round(x, DIGITS) + 0.0 for x in (math.cos(angle), math.sin(angle))]
    slot = {"pin": pin, "direction": direction} | ({} if base == GROUND else {"on": base})
    return {**tables, "slot": [*tables.get("slot", []), slot]}


def _is_same(drawn: Mechanism, fixed: Mechanism) -> bool:
    """Return True if two mechanisms have the same bodies, and elements of the same classes between the same bodies."""

    def bodies(mechanism: Mechanism) -> np.ndarray:
        return np.array([[b.mass, b.inertia, *b.position] for _, b in sorted(mechanism.bodies.items())], float)

    def elements(mechanism: Mechanism) -> list[tuple[str, list[str]]]:
        groups = (mechanism.joints, mechanism.drivers, mechanism.forces)
        return sorted((type(x).__name__, sorted(mechanism.frames_of(x))) for group in groups for x in group.values())

    if set(drawn.bodies) != set(fixed.bodies) or elements(drawn) != elements(fixed):
        return False
    return bool(np.allclose(bodies(drawn), bodies(fixed), rtol=ROUNDING, atol=ROUNDING * float(np.abs(bodies(fixed)).max())))
