"""A curve from a file: rows x, y of a CSV file, or the shapes of an SVG file in one stroke."""

import re
from pathlib import Path

import numpy as np

from udkjax.scene.outlines.svg import read_svg

FRACTIONS = np.linspace(0.0, 1.0, 49)  # of an arc or a spline
LIFTED = 1e-6  # of the length of the next piece: a pen that moves farther is lifted


def read_curve_file(file: Path) -> np.ndarray:
    """Return the points (n, 2) of a curve in a file, in its unit, with y upwards; in mm if the width of a drawing has a unit.

    Args:
        file: rows x, y of numbers after an optional heading (`.csv`, `.txt`), or a drawing in one stroke (`.svg`).

    Raises:
        ValueError: the file has no curve, or more than one; the message names the line or the shape.
        OSError: the file cannot be read.
    """
    if file.suffix.lower() != ".svg":
        return _of_rows(file.name, file.read_text(encoding="utf-8-sig"))
    drawn, _, problems = read_svg(file)
    if problems or not drawn:
        raise ValueError(f"{file.name} {f'is {problems[0]}' if problems else 'draws nothing'}")
    pieces = [one.piece.at(FRACTIONS)[0] for one in drawn]
    for k in range(1, len(pieces)):
        if np.hypot(*(pieces[k][0] - pieces[k - 1][-1])) > LIFTED * np.ptp(pieces[k], axis=0).max():
            raise ValueError(f"{file.name} must be one stroke: the pen is lifted between {drawn[k - 1].name} and {drawn[k].name}")
    return np.concatenate(pieces)


def _of_rows(name: str, text: str) -> np.ndarray:
    points = []
    for k, line in enumerate(text.splitlines()):
        fields = re.split(r"[\s,;]+", line.strip())
        try:
            points.append([float(fields[0]), float(fields[1])])
        except (ValueError, IndexError):
            if k and line.strip():  # the first line may be a heading
                raise ValueError(f"line {k + 1} of {name} must be two numbers x, y, not {line!r}") from None
    if not points:
        raise ValueError(f"{name} has no rows x, y")
    return np.array(points)
