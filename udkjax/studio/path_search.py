"""A mechanism for a wanted path: four-bars with a point that passes along a curve, each a drawing with a motor."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.positions.answers.pin_motion import pin_motion
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.files import loads
from udkjax.studio.limits import RefusedError
from udkjax.studio.text_edits import merge_document, read_document
from udkjax.synthesis.design import DesignSearch
from udkjax.synthesis.designs import FoundDesign
from udkjax.synthesis.goals import PathGoal

TARGETS = 16  # places on the path that the search meets: more take longer, and hardly change what is found
STARTS = 60  # random mechanisms to start from: some seconds
RESULTS = 4
FEWEST, MOST = 3, 10_000  # points of a wanted path
CLOSED = 0.08  # a path whose ends are nearer, relative to its length, is closed
REACH = 2.5  # ground pins stay within so many extents of the path from its middle
LONGEST = 4.0  # longest link, in extents of the path
SHORTEST = 0.08  # shortest link, in extents
TRANSMISSION = np.deg2rad(20)  # least transmission angle (rad)
DIGITS = 6  # of the written numbers
DENSITY = 7850  # kg/m^3, of steel
CURVE = 721  # values of the driver at which a found path is compared
THREADS = 1  # batches are small: threads would take more time to start than they save
# Pins of a four-bar about a path of extent 1, from which the search departs.
DRAFT = {"O": (-1.0, -1.0), "A": (-0.8, -0.7), "B": (0.2, 0.1), "C": (0.4, -1.0), "P": (0.0, 0.3)}
LINKS: Sequence[Mapping[str, Any]] = (
    {"name": "crank", "pins": ["O", "A"]},
    {"name": "coupler", "pins": ["A", "B", "P"]},
    {"name": "rocker", "pins": ["C", "B"]},
)


def find_mechanisms(path: object, unit: str = "mm", seed: int = 0) -> JsonObject:
    """Return four-bars whose coupler point passes along a wanted path.

    Args:
        path: places [x, y] of the path (m), in order; it is closed if its ends nearly meet.
        unit: unit of lengths of the drawings.
        seed: seed of the random mechanisms; another one finds others.

    Returns:
        `designs`, the best first, each with its `document`, `text`, the largest `deviation` of the path (m), whether the crank
        `turns`, and its smallest transmission angle (rad); `extent` of the wanted path (m), and `reason` if nothing was found.
    """
    points = _points(path)
    size, middle = float(np.linalg.norm(np.ptp(points, axis=0))), points.mean(0)
    if not size > 0:
        raise RefusedError(400, "path: its points are all in the same place")
    points = (points - middle) / size
    found = prepared_search().with_path(_spread(points))(starts=STARTS, seed=seed, results=RESULTS, threads=THREADS)
    designs = [_drawn(design, points, middle, size, unit) for design in found]
    return {"designs": sorted(designs, key=lambda one: one["deviation"]), "extent": size, "reason": found.reason}


@cache
def prepared_search() -> DesignSearch:
    """Return the search for paths of extent 1 about the origin, compiled by a first search for an ellipse."""
    area, ends = (0.0, 0.0, REACH), (SHORTEST, LONGEST)
    angles = np.linspace(0.0, 2 * np.pi, TARGETS, endpoint=False)
    ellipse = np.stack([0.45 * np.cos(angles), 0.2 * np.sin(angles)], 1)
    search = DesignSearch(
        loads(merge_document("", _document(DRAFT, 1.0, "m"))),
        PathGoal("P", ellipse),
        areas={"O": area, "C": area},
        lengths=dict.fromkeys((("O", "A"), ("A", "B"), ("C", "B"), ("A", "P")), ends),
        transmission=TRANSMISSION,
        rotation=True,
    )
    search.with_path(ellipse)(starts=1, results=1, threads=THREADS)
    return search


def _points(path: object) -> np.ndarray:
    try:
        points = np.asarray(path, float)
    except (TypeError, ValueError):
        points = np.zeros((0, 2))
    if points.shape[1:] != (2,) or not FEWEST <= len(points) <= MOST or not np.isfinite(points).all():
        raise RefusedError(400, f"path: must be a list of {FEWEST} to {MOST} places [x, y]")
    return points


def _spread(points: np.ndarray) -> np.ndarray:
    """Return places at equal distances along a path: `TARGETS` if it is closed, and one more if it has two ends."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    gap = float(np.linalg.norm(points[-1] - points[0]))
    is_closed = gap <= CLOSED * way[-1]
    if is_closed:
        points, way = np.concatenate([points, points[:1]]), np.append(way, way[-1] + gap)
    at = np.linspace(0.0, way[-1], TARGETS + 1)[: TARGETS if is_closed else None]
    return np.stack([np.interp(at, way, x) for x in points.T], 1)


def _document(places: Mapping[str, Sequence[float] | np.ndarray], size: float, unit: str) -> JsonObject:
    """Return the document of a four-bar with pins at places (m), with links that suit its size (m)."""

    def written(metres: float) -> float:
        return float(f"{metres / Units({'length': unit}).size('m'):.{DIGITS}g}")

    shape = {"density": DENSITY, "thickness": written(size / 30)}
    links = [{**link, **shape, **({} if link["name"] == "coupler" else {"width": written(size / 12)})} for link in LINKS]
    return {
        "format": 2,
        "units": {"length": unit, "angle": "deg"},
        "ground": ["O", "C"],
        "pins": {name: [written(float(x)) for x in place] for name, place in places.items()},
        "link": links,
        "motor": [{"pin": "O", "speed": "60 rpm"}],
    }


def _drawn(design: FoundDesign, points: np.ndarray, middle: np.ndarray, size: float, unit: str) -> JsonObject:
    """Return a design of extent 1 as a drawing of a size (m) about a middle, with its largest distance from `points`."""
    places = {name: middle + size * np.asarray(design.parameters[f"pin.{name}"]) for name in DRAFT}
    text = merge_document("", _document(places, size, unit))
    curve = pin_motion(design.mechanism, design.motion(CURVE)).pins["P"][:, 0]
    off = np.linalg.norm(points[:, None] - np.asarray(curve)[None], axis=2).min(1)
    return {
        "document": read_document(text),
        "text": text,
        "deviation": size * float(off.max()),
        "turns": bool(design.turns),
        "transmission": float(np.arcsin(design.transmission)),
    }
