"""Mechanisms for a wanted path: linkages with a pin that draws it, each a drawing with a motor."""

from typing import Any

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.files import dumps
from udkjax.segments import distances_from_segments
from udkjax.studio.limits import RefusedError
from udkjax.studio.text_edits import merge_document, read_document
from udkjax.synthesis.curves.curve_designs import CurveDesign
from udkjax.synthesis.curves.curve_file import read_curve_table
from udkjax.synthesis.curves.mechanisms_for import mechanisms_for

# Largest number of bars, and CPU time (s), of the first search and the following ones: simple mechanisms appear at once.
EFFORTS = ((6, 3.0), (8, 8.0), (10, 16.0), (12, 30.0))
RESULTS = 4
FEWEST_POINTS, MOST_POINTS = 3, 10_000  # points of a wanted path
CLOSED_GAP = 0.08  # a path drawn by hand whose ends are nearer, relative to its length, is closed
LEAST_TRANSMISSION = float(np.deg2rad(20.0))  # least transmission angle (rad)
POINTS_AT_ONCE = 500  # points whose distances are computed at once, to bound the memory
DIGITS = 6  # of the written numbers


def find_mechanisms(path: object, unit: str = "mm", seed: int = 0) -> JsonObject:
    """Return mechanisms with a pin that draws a wanted path.

    Args:
        path: places [x, y] of the path (m), in order; it is closed if its ends nearly meet.
        unit: unit of lengths of the drawings.
        seed: number of the search, from 0: each search finds other mechanisms. Up to number 3, each has more bars and more time
            than the one before; searches of odd number use slides, too.

    Returns:
        `designs`, those that deviate least first, each with its `document`, `text`, largest `deviation` from the path (m),
        `turns` (true if the crank turns fully), and smallest `transmission` angle (rad); `extent` of the wanted path (m); and
        `reason`, if nothing was found.

    Raises:
        RefusedError: the path is not a list of places, or no search is possible for it.
    """
    points = _points(path)
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not extent > 0:
        raise RefusedError(400, "path: its points are all in the same place")
    way = float(np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    if np.linalg.norm(points[-1] - points[0]) <= CLOSED_GAP * way:
        points = np.concatenate([points, points[:1]])
    bars, seconds = EFFORTS[min(seed, len(EFFORTS) - 1)]
    given: dict[str, Any] = {"bars": bars, "seconds": seconds, "seed": seed, "results": RESULTS, "unit": unit}
    try:
        found = mechanisms_for(points, transmission=LEAST_TRANSMISSION, slides=seed % 2 == 1, progress=False, **given)
    except ValueError as problem:
        raise RefusedError(400, f"path: {problem}") from None
    designs = [_drawn(design, points) for design in found]
    return {"designs": sorted(designs, key=lambda one: one["deviation"]), "extent": extent, "reason": found.reason}


def path_of_table(name: str, text: str, unit: str) -> list[list[float]]:
    """Return the places [x, y] (m) of a wanted path from the text of a table, with lengths in `unit`; `name` is for messages."""
    try:
        points = Units.sizes("m")[unit] * read_curve_table(name, text)
    except ValueError as problem:
        raise RefusedError(400, str(problem)) from None
    return _points(points).tolist()


def _points(path: object) -> np.ndarray:
    try:
        points = np.asarray(path, float)
    except (TypeError, ValueError):
        points = np.zeros((0, 2))
    if points.shape[1:] != (2,) or not FEWEST_POINTS <= len(points) <= MOST_POINTS or not np.isfinite(points).all():
        raise RefusedError(400, f"path: must be a list of {FEWEST_POINTS} to {MOST_POINTS} places [x, y]")
    return points


def _drawn(design: CurveDesign, points: np.ndarray) -> JsonObject:
    """Return a design as a drawing, with the largest distance of `points` from its curve."""
    text = merge_document("", _rounded(read_document(dumps(design.mechanism))))
    parts = np.array_split(points, 1 + len(points) // POINTS_AT_ONCE)
    off = max(distances_from_segments(part, design.curve[:-1], design.curve[1:]).min(1).max() for part in parts)
    return {
        "document": read_document(text),
        "text": text,
        "deviation": float(off),
        "turns": design.turns,
        "transmission": design.transmission,
    }


def _rounded(value: Any) -> Any:
    """Return a document with its numbers rounded to `DIGITS` significant digits."""
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
