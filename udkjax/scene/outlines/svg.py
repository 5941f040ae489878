"""Pieces of contours from the shapes of an SVG file: lines, arcs of circles and ellipses, and Bezier curves, with transforms."""

import os
import re
from typing import Any

import numpy as np

from udkjax.extras import OptionalImport
from udkjax.scene.outlines.contours import DrawnPiece
from udkjax.scene.outlines.curves import Arc, Bezier, Piece, line

# Units of widths that give the file a unit.
MILLIMETRES_PER_UNIT = {"mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72, "pc": 25.4 / 6}
PIXELS_PER_INCH = 96.0  # per inch, as CSS has it


def read_svg(path: str | os.PathLike[str]) -> tuple[list[DrawnPiece], str | None, list[str]]:
    """Return the pieces of all shapes, their unit ("mm", or None), and mistakes. The y axis points up.

    If the width of the file has a unit, the pieces are in mm; otherwise they are in the units of the file's view box.
    """
    with OptionalImport():
        import svgelements as svg
    from xml.etree.ElementTree import ParseError

    try:
        file = svg.SVG.parse(os.fspath(path), reify=True, ppi=PIXELS_PER_INCH)
    except (ParseError, ValueError) as error:
        return [], None, [f"not an SVG file that can be read: {error}"]
    width = str(file.values.get("attributes", {}).get("width", ""))
    physical = re.fullmatch(r"\s*([\d.eE+-]+)\s*([a-z]+)\s*", width)
    own, scale = None, np.array([1.0, -1.0])
    if physical is not None and physical[2] in MILLIMETRES_PER_UNIT:  # svgelements rounds its factors
        own, scale = (
            "mm",
            scale * float(physical[1]) * MILLIMETRES_PER_UNIT[physical[2]] / svg.Length(width).value(ppi=PIXELS_PER_INCH),
        )
    drawn, problems = [], []
    for shape in file.select(lambda x: isinstance(x, svg.Shape)):
        name = f"{type(shape).__name__.lower()} {shape.id!r}" if shape.id else type(shape).__name__.lower()
        for segment in svg.Path(shape).segments():
            piece = _piece(segment, svg, scale)
            if piece is not None:
                drawn.append(DrawnPiece(piece, name))
    return drawn, own, problems


def _piece(segment: Any, svg: Any, scale: np.ndarray) -> Piece | None:
    def place(point: Any) -> np.ndarray:
        return scale * (point.x, point.y)

    if isinstance(segment, svg.Move) or segment.start is None or segment.end is None:
        return None
    if isinstance(segment, svg.Arc) and segment.sweep:
        centre = place(segment.center)
        x, y, to, middle = (place(p) - centre for p in (segment.prx, segment.pry, segment.start, segment.point(0.5)))
        first, half = (np.arctan2(*np.linalg.solve(np.stack([x, y], 1), p)[::-1]) for p in (to, middle))
        sweep = 2 * ((half - first + np.pi) % (2 * np.pi) - np.pi)  # by the middle; a circle turns either way
        return Arc(centre, x, y, float(first), float(sweep))
    if isinstance(segment, svg.CubicBezier | svg.QuadraticBezier):
        controls = [getattr(segment, key) for key in ("start", "control", "control1", "control2", "end") if hasattr(segment, key)]
        return Bezier(np.array([place(p) for p in controls]))
    start, end = place(segment.start), place(segment.end)
    return line(start, end) if (start != end).any() else None
