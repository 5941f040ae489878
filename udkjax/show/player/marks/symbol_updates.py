"""Updates of a mechanism's symbols when numbers of the scene change in a page.

Symbols depend on numbers of the scene: points of joints and springs, radii of wheels, directions of rails. A number of a symbol
that equals one of the scene is updated with it. Each kind of update is a list of rows; an index is the position of a number in
the vector of all numbers of the scene:

    frames                  [symbol; which of its two anchors, or -1; indices of x and y]
    traces, pins, arrows    [trace, mark, or arrow of a force; 0; indices of x and y]
    measures                [measure, anchor, indices of x and y]
    points                  [symbol, point of its line, indices of x and y]
    angles                  [symbol, index]
    sizes                   [symbol, index, original radius]: all lengths of the symbol scale with the radius
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from udkjax.annotations import JsonObject
from udkjax.integrate.portable import drawn_points
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.couplings import Gear, Rack
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player.marks.mark_kinds import MarkKind

SAME_DIGITS = 7  # significant digits to which points of symbols are compared

BodyPoint = tuple[int, float, float]  # index of a body, and a place in its frame rounded to `SAME_DIGITS`


def symbol_updates(mechanism: Mechanism, record: Mapping[str, Any], symbols: Sequence[JsonObject], drawn: int) -> JsonObject:
    """Return the updates of symbols, marks and traces of a run.

    Args:
        mechanism: the mechanism of the run.
        record: the record of the run (player_data.py).
        symbols: the symbols of its marks.
        drawn: index of the first of the points of drawn links, which follow the other numbers of the scene.
    """
    indices: Mechanism = _indices(mechanism)
    points = _points(mechanism, indices)
    for body, more in drawn_points(mechanism):
        for x, y in np.asarray(more, float):
            points.setdefault(_key(mechanism.body_names.index(body), x, y), (drawn, drawn + 1))
            drawn += 2
    angles = {
        _rounded(e.axis): int(indices.joints[name].axis)
        for name, e in mechanism.joints.items()
        if getattr(e, "axis", None) is not None
    }
    radii = _radii(mechanism, indices)
    found: JsonObject = {"frames": [], "points": [], "angles": [], "sizes": [], "traces": [], "pins": [], "arrows": []}
    found["measures"] = []
    for k, symbol in enumerate(symbols):
        frame = symbol["frame"]
        pair = len(frame) == 2
        for which, anchor in enumerate(frame if pair else [frame[:3]]):
            if (index := points.get(_key(*anchor))) is not None:
                found["frames"].append([k, which if pair else -1, *index])
        if symbol["layer"] == MarkKind.LINK:
            for row, (x, y) in enumerate(symbol["points"]):
                if (index := points.get(_key(frame[0], x, y))) is not None:
                    found["points"].append([k, row, *index])
        if symbol["layer"] in (MarkKind.RAIL, MarkKind.RACK) and (index := angles.get(_rounded(frame[3]))) is not None:
            found["angles"].append([k, index])
        if symbol["layer"] == MarkKind.WHEEL and (radius := radii.get(frame[0])) is not None:
            found["sizes"].append([k, *radius])
    marks = [[mark["body"], *mark.get("at", ())] if "body" in mark else [] for mark in record["marks"]]
    arrows = record["reactions"]["anchors"] if record["reactions"] else []
    for name, anchors in (("traces", record["traces"]), ("pins", marks), ("arrows", arrows)):
        for k, anchor in enumerate(anchors):
            if len(anchor) == 3 and (index := points.get(_key(*anchor))) is not None:
                found[name].append([k, 0, *index])
    for k, measure in enumerate(record["measures"]):
        for which, anchor in enumerate(measure["anchors"]):
            if (index := points.get(_key(*anchor))) is not None:
                found["measures"].append([k, which, *index])
    return found


def _indices(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism with each number replaced by its index in the vector of all numbers."""
    leaves, tree = jax.tree.flatten(mechanism.without_origin.without_samples)
    starts = np.cumsum([0, *(np.size(x) for x in leaves)])
    numbered = [np.arange(k, k + np.size(x)).reshape(np.shape(x)) for k, x in zip(starts, leaves, strict=False)]
    return jax.tree.unflatten(tree, numbered)


def _rounded(x: Any) -> float:
    return float(f"{float(x):.{SAME_DIGITS}g}")


def _key(body: float, x: float, y: float) -> BodyPoint:
    return int(body), _rounded(x), _rounded(y)


def _points(mechanism: Mechanism, indices: Mechanism) -> dict[BodyPoint, tuple[int, int]]:
    """Return the places of elements' points on bodies, each with the indices of its x and y in the vector of all numbers."""
    number = {GROUND: -1, **{name: k for k, name in enumerate(mechanism.body_names)}}
    found: dict[BodyPoint, tuple[int, int]] = {}
    elements = [*mechanism.constraints.values(), *mechanism.forces.values()]
    indexed = [*indices.constraints.values(), *indices.forces.values()]
    for element, index in zip(elements, indexed, strict=True):
        points, at = getattr(element, "points", None), getattr(index, "points", None)
        bodies = element.bodies
        if points is None and (point := getattr(element, "point", None)) is not None:
            points, at = np.asarray(point)[None], np.asarray(index.point)[None]
        if points is None or at is None:
            continue
        for body, point, where in zip(bodies, np.asarray(points), np.asarray(at), strict=False):
            found.setdefault(_key(number[body], *point), (int(where[0]), int(where[1])))
    return found


def _radii(mechanism: Mechanism, indices: Mechanism) -> dict[int, tuple[int, float]]:
    """Return the radius of each wheel, by the index of its body: its index in the vector of all numbers, and its value."""
    number, found = {name: k for k, name in enumerate(mechanism.body_names)}, {}
    for name, joint in mechanism.joints.items():
        index = indices.joints[name]
        if isinstance(joint, Gear):
            for k, body in enumerate(joint.bodies):
                found[number.get(body, -1)] = int(index.radii[k]), float(np.asarray(joint.radii)[k])
        elif isinstance(joint, Rack):
            found[number.get(joint.bodies[1], -1)] = int(index.radius), float(np.asarray(joint.radius))
    return found
