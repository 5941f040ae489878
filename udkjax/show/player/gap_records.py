"""The gaps of a run as data of the player: the outlines that may touch, and the least gap of the motion."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.positions.gaps.gaps import LeastGaps, gaps
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player.marks.measure_curves import ShownMotion

ShownGaps: TypeAlias = "bool | LeastGaps | Mapping[str, LeastGaps]"


def add_gaps(record: JsonObject, mechanism: Mechanism, run: ShownMotion, found: bool | LeastGaps | None) -> LeastGaps | None:
    """Add the gaps between links to the record of a run: the least gap, outlines, and events where links touch and part.

    Args:
        record: the record (player_data.py).
        mechanism: the mechanism of the run.
        run: the run.
        found: a result of `gaps` for the run; True to find the gaps of all pairs, False or None to add nothing.

    Returns:
        The gaps; None if nothing was added.

    Raises:
        ValueError: the gaps were measured along values of a driver, but the run is over time, or vice versa.
    """
    if not isinstance(found, LeastGaps):
        if not found:
            return None
        found = gaps(mechanism, run=run)
    over = getattr(run, "unit", "s") or "s"
    if found.unit != over:
        which = " and ".join("time" if unit == "s" else f"values in {unit}" for unit in (found.unit, over))
        raise ValueError(f"gaps and run are over {which}: give udk.gaps(mechanism, run=solution)")
    least = {"t": found.least.value, "least": float(found.least.distance), "words": found.summary()}
    record["gaps"] = least | outlines(found, mechanism.body_names)
    events = [{"t": least["t"], "name": least["words"]}]
    for pair, begins, ceases in found.contacts:
        events += [{"t": t, "name": f"{' and '.join(pair)} {word}"} for t, word in ((begins, "touch"), (ceases, "part"))]
    record["events"] = sorted([*record["events"], *events], key=lambda event: event["t"])
    return found


def outlines(found: LeastGaps, bodies: Sequence[str], frames: Mapping[str, np.ndarray] | None = None) -> JsonObject:
    """Return the outlines of links as JSON: `parts`, and `pairs`.

    Each of the `parts` is a convex part {body, points, radius} of a link; for each pair of links, `pairs` has two lists, the
    indices of the parts of both links.

    Args:
        found: the gaps.
        bodies: names of the bodies by index; any other name is the ground, -1.
        frames: x, y, angle (m, m, rad) of the frame of each body in which its points are given; by default its own frame.
    """
    number = {name: k for k, name in enumerate(bodies)}
    parts = [
        {"body": number.get(part.body, -1), "points": corners.tolist(), "radius": float(part.radius)}
        for part, corners in zip(found.parts, found.corners_in(frames or {}), strict=True)
    ]
    return {"parts": parts, "pairs": [[*pair] for pair in found.parts_of_pairs]}
