"""Exports of a drawing: a page, pictures, a film, a table of its motion, a script."""

import contextlib
import csv
import io
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.native.language.program import UnsupportedError
from udkjax.positions.assembling.assembly import assemble
from udkjax.positions.assembling.channels import StateHistory
from udkjax.requirements import ArgumentError
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player import Animation, animate
from udkjax.statics.reaction_peaks import RestingPositions
from udkjax.studio.limits import RefusedError
from udkjax.studio.shown_runs import INSTANTS, duration_of, shown_run

SCRIPT_TEMPLATE = '''"""{title}, drawn in the udkjax studio."""

import numpy as np

import udkjax as udk

SCENE = {scene}

mech = udk.loads(SCENE)
print(udk.diagnose(mech))
sol = udk.simulate(mech, np.linspace(0.0, {duration!r}, {instants}))
print(sol)
udk.animate(mech, sol).save("motion.html")
'''

LABELLED_SUFFIXES = (".svg", ".png", ".dxf")  # pictures with the names of points and the lengths of links
# A spreadsheet evaluates cells that begin like this, unless an apostrophe comes first.
FORMULA_STARTS = ("=", "+", "-", "@", "\t")


def exported(mechanism: Mechanism, text: str, suffix: str, pose: JsonObject | None = None, has_gaps: bool = False) -> bytes:
    """Return a drawing as the content of a file in the format of a suffix.

    Args:
        mechanism: mechanism of the drawing.
        text: text of its file.
        suffix: .html (a live page), .svg, .png, .gif, .mp4 or .dxf, as `animate` saves them; .csv (positions over time) or .py (a
            script).
        pose: the position in a picture: a time `t` (s) of the run, or the coordinates `q` of all bodies; by default as drawn.
        has_gaps: True to paint links red that touch, in pictures and films.

    Raises:
        ArgumentError: links without mass move freely.
        RefusedError: the pose is neither a time nor coordinates.
    """
    if suffix == ".py":
        return script(mechanism, text).encode()
    if suffix in LABELLED_SUFFIXES:
        run, t = _posed(mechanism, pose or {})
        options = {"t": t, "labels": True}
    else:
        run, options = shown_run(mechanism), {}
    if suffix == ".csv":
        return table(mechanism, run).encode()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"drawing{suffix}"
        shown(mechanism, run, suffix, has_gaps).save(path, **options)
        return path.read_bytes()


def _posed(mechanism: Mechanism, pose: JsonObject) -> tuple[StateHistory, float]:
    """Return a motion that contains a pose of a mechanism, and the time (s) of this pose in the motion."""
    q = pose.get("q")
    if q is None:
        try:
            return shown_run(mechanism), finite_numbers(pose.get("t", 0.0), "t", ()).item()
        except ArgumentError:  # links without mass that nothing drives: as drawn
            q = np.ravel(assemble(mechanism).q)
    still = finite_numbers(q, "q", (3 * len(mechanism.bodies),)).reshape(1, -1, 3)
    return RestingPositions(np.array([0.0, 1.0]), np.repeat(still, 2, axis=0), np.zeros((2, *still.shape[1:]))), 0.0


def finite_numbers(given: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return numbers of a request as an array; raise `RefusedError` unless they are finite and have the given shape."""
    try:
        found = np.asarray(given, float)
    except (TypeError, ValueError):
        found = np.array([np.nan])
    if found.shape != shape or not np.isfinite(found).all():
        raise RefusedError(400, f"{name}: must be {math.prod(shape)} finite number{'s' * bool(shape)}")
    return found


def shown(mechanism: Mechanism, run: StateHistory, suffix: str, has_gaps: bool = False) -> Animation:
    """Return a run as an animation; for .html it is a live page, if a page can simulate the mechanism."""
    if suffix == ".html":
        with contextlib.suppress(ValueError, UnsupportedError):
            return animate(mechanism, run, live=True)
    return animate(mechanism, run, gaps=has_gaps)


def script(mechanism: Mechanism, text: str) -> str:
    """Return a Python script that simulates and shows a drawing."""
    title = " ".join(mechanism.name.split()).replace("\\", "").replace('"', "'") or "A mechanism"
    lines = "".join(f"    {line!r}\n" for line in text.splitlines(keepends=True))
    return SCRIPT_TEMPLATE.format(title=title, scene=f"(\n{lines})", duration=duration_of(mechanism), instants=INSTANTS)


def table(mechanism: Mechanism, run: StateHistory) -> str:
    """Return the motion of all bodies as comma-separated values, one line per instant."""
    q = np.asarray(run.q).reshape(len(run.ts), -1)
    units = ("x (m)", "y (m)", "angle (rad)")
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = [f"'{body}" if body.startswith(FORMULA_STARTS) else body for body in mechanism.bodies]
    writer.writerow(["time (s)", *(f"{name} {unit}" for name in names for unit in units)])
    writer.writerows([repr(float(t)), *map(repr, row)] for t, row in zip(np.asarray(run.ts), q.tolist(), strict=True))
    return out.getvalue()
