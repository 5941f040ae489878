"""Exports of a drawing: a page, pictures, a film, a table of its motion, a script."""

import contextlib
import csv
import io
import tempfile
from pathlib import Path

import numpy as np

from udkjax.integrate import Solution
from udkjax.native.language.program import UnsupportedError
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player import Animation, animate
from udkjax.studio.shown_runs import INSTANTS, duration_of, shown_run

SCRIPT = '''"""{title}, drawn in the udkjax studio."""

import numpy as np

import udkjax as udk

SCENE = {scene}

mech = udk.loads(SCENE)
print(udk.diagnose(mech))
sol = udk.simulate(mech, np.linspace(0.0, {duration!r}, {instants}))
print(sol)
udk.animate(mech, sol).save("motion.html")
'''

LABELLED = (".svg", ".png", ".dxf")  # pictures with the names of points and the lengths of links
FORMULA = ("=", "+", "-", "@", "\t")  # a spreadsheet evaluates cells that begin like this, unless an apostrophe comes first


def exported(mechanism: Mechanism, text: str, suffix: str) -> bytes:
    """Return a drawing in the format of a file name suffix.

    Args:
        mechanism: mechanism of the drawing.
        text: text of its file.
        suffix: .html (a live page), .svg, .png, .gif, .mp4 or .dxf, as `animate` saves them; .csv (positions over time) or .py (a
            script).
    """
    if suffix == ".py":
        return script(mechanism, text).encode()
    run = shown_run(mechanism)
    if suffix == ".csv":
        return table(mechanism, run).encode()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"drawing{suffix}"
        shown(mechanism, run, suffix).save(path, **({"labels": True} if suffix in LABELLED else {}))
        return path.read_bytes()


def shown(mechanism: Mechanism, run: Solution, suffix: str) -> Animation:
    """Return a run as an animation; if it is a page, it is live if the mechanism can be compiled to machine code."""
    if suffix == ".html":
        with contextlib.suppress(ValueError, UnsupportedError):
            return animate(mechanism, run, live=True)
    return animate(mechanism, run)


def script(mechanism: Mechanism, text: str) -> str:
    """Return a Python script that simulates and shows a drawing."""
    title = " ".join(mechanism.name.split()).replace("\\", "").replace('"', "'") or "A mechanism"
    lines = "".join(f"    {line!r}\n" for line in text.splitlines(keepends=True))
    return SCRIPT.format(title=title, scene=f"(\n{lines})", duration=duration_of(mechanism), instants=INSTANTS)


def table(mechanism: Mechanism, run: Solution) -> str:
    """Return the motion of all bodies as comma-separated values, one line per instant."""
    q = np.asarray(run.q).reshape(len(run.ts), -1)
    units = ("x (m)", "y (m)", "angle (rad)")
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = [f"'{body}" if body.startswith(FORMULA) else body for body in mechanism.bodies]
    writer.writerow(["time (s)", *(f"{name} {unit}" for name in names for unit in units)])
    writer.writerows([repr(float(t)), *map(repr, row)] for t, row in zip(np.asarray(run.ts), q.tolist(), strict=True))
    return out.getvalue()
