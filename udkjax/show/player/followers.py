"""Symbols of a mechanism that follow its numbers, in a page where these change.

Places of symbols in the frames of bodies are numbers of the scene: points of joints and springs, radii of wheels, directions of
rails. Those that equal one follow it:

    frames                  [symbol; which of its two anchors, or -1; the places in the vector of all numbers of x and y]
    traces, pins, arrows    [trace, mark or arrow of a force; 0; places of x and y]
    points                  [symbol, point of its line, places of x and y]
    angles                  [symbol, place]
    sizes                   [symbol, place, the radius as it is]: all its lengths grow with a radius
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from udkjax.annotations import JsonObject
from udkjax.integrate.portable import drawn_points
from udkjax.scene import GROUND, Gear, Mechanism, Rack

SAME_DIGITS = 7  # significant digits of the points of symbols

BodyPoint = tuple[int, float, float]  # the number of a body, and a place in its frame, with so many digits


def followers(mechanism: Mechanism, record: Mapping[str, Any], symbols: Sequence[JsonObject], drawn: int) -> JsonObject:
    """Return how the symbols, marks and traces of a run follow its mechanism, whose drawn points begin at `drawn`."""
    places: Mechanism = _places(mechanism)
    known = _points(mechanism, places)
    for body, points in drawn_points(mechanism):
        for x, y in np.asarray(points, float):
            known.setdefault(_key(mechanism.body_names.index(body), x, y), (drawn, drawn + 1))
            drawn += 2
    angles = {_rounded(e.axis): int(places.joints[name].axis) for name, e in mechanism.joints.items() if hasattr(e, "axis")}
    radii = _radii(mechanism, places)
    found: JsonObject = {"frames": [], "points": [], "angles": [], "sizes": [], "traces": [], "pins": [], "arrows": []}
    for k, symbol in enumerate(symbols):
        frame = symbol["frame"]
        pair = len(frame) == 2
        for which, anchor in enumerate(frame if pair else [frame[:3]]):
            if (place := known.get(_key(*anchor))) is not None:
                found["frames"].append([k, which if pair else -1, *place])
        if symbol["layer"] == "link":
            for row, (x, y) in enumerate(symbol["points"]):
                if (place := known.get(_key(frame[0], x, y))) is not None:
                    found["points"].append([k, row, *place])
        if symbol["layer"] in ("rail", "rack") and (place := angles.get(_rounded(frame[3]))) is not None:
            found["angles"].append([k, place])
        if symbol["layer"] == "wheel" and (radius := radii.get(frame[0])) is not None:
            found["sizes"].append([k, *radius])
    marks = [[mark["body"], *mark.get("at", ())] if "body" in mark else [] for mark in record["marks"]]
    arrows = record["reactions"]["anchors"] if record["reactions"] else []
    for name, anchors in (("traces", record["traces"]), ("pins", marks), ("arrows", arrows)):
        for k, anchor in enumerate(anchors):
            if len(anchor) == 3 and (place := known.get(_key(*anchor))) is not None:
                found[name].append([k, 0, *place])
    return found


def _places(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism with the place of each number in the vector of all in its stead."""
    leaves, tree = jax.tree.flatten(mechanism.without_origin.without_samples)
    starts = np.cumsum([0, *(np.size(x) for x in leaves)])
    numbered = [np.arange(k, k + np.size(x)).reshape(np.shape(x)) for k, x in zip(starts, leaves, strict=False)]
    return jax.tree.unflatten(tree, numbered)


def _rounded(x: Any) -> float:
    return float(f"{float(x):.{SAME_DIGITS}g}")


def _key(body: float, x: float, y: float) -> BodyPoint:
    return int(body), _rounded(x), _rounded(y)


def _points(mechanism: Mechanism, places: Mechanism) -> dict[BodyPoint, tuple[int, int]]:
    """Return the places of x and y of the points that elements have in the frames of bodies."""
    number = {GROUND: -1, **{name: k for k, name in enumerate(mechanism.body_names)}}
    found: dict[BodyPoint, tuple[int, int]] = {}
    elements = [*mechanism.constraints.values(), *mechanism.forces.values()]
    numbered = [*places.constraints.values(), *places.forces.values()]
    for element, place in zip(elements, numbered, strict=True):
        points, at = getattr(element, "points", None), getattr(place, "points", None)
        bodies = element.bodies
        if points is None and (point := getattr(element, "point", None)) is not None:
            points, at = np.asarray(point)[None], np.asarray(place.point)[None]
        if points is None or at is None:
            continue
        for body, point, where in zip(bodies, np.asarray(points), np.asarray(at), strict=False):
            found.setdefault(_key(number[body], *point), (int(where[0]), int(where[1])))
    return found


def _radii(mechanism: Mechanism, places: Mechanism) -> dict[int, tuple[int, float]]:
    """Return the place of the radius of each body that is a wheel, and the radius."""
    number, found = {name: k for k, name in enumerate(mechanism.body_names)}, {}
    for name, joint in mechanism.joints.items():
        place = places.joints[name]
        if isinstance(joint, Gear):
            for k, body in enumerate(joint.bodies):
                found[number.get(body, -1)] = int(place.radii[k]), float(np.asarray(joint.radii)[k])
        elif isinstance(joint, Rack):
            found[number.get(joint.bodies[1], -1)] = int(place.radius), float(np.asarray(joint.radius))
    return found
