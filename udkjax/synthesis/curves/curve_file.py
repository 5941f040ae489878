"""A curve from a file: columns x, y of a table, or the shapes of an SVG file in one stroke."""

import re
from pathlib import Path

import numpy as np

from udkjax.scene.outlines.svg import read_svg

COORDINATE_COLUMN = re.compile(r"\W*([xy])(?![a-z])")  # a name of a column, such as "x (mm)"
FRACTIONS = np.linspace(0.0, 1.0, 49)  # of an arc or a spline
LIFTED_DISTANCE = 1e-6  # of the extent of the drawing: a pen that moves farther is lifted


def read_curve_file(file: Path) -> np.ndarray:
    """Return the points (n, 2) of a curve in a file, in its unit, with y upwards; in mm if the width of a drawing has a unit.

    Args:
        file: a table (`.csv`, `.txt`), as for `read_curve_table`, or a drawing in one stroke (`.svg`).

    Raises:
        ValueError: the file has no curve, or more than one; the message names the line or the shape.
        OSError: the file cannot be read.
    """
    if file.suffix.lower() != ".svg":
        return read_curve_table(file.name, file.read_text(encoding="utf-8-sig"))
    drawn, _, problems = read_svg(file)
    if problems or not drawn:
        raise ValueError(f"{file.name} {f'is {problems[0]}' if problems else 'draws nothing'}")
    pieces = [one.piece.at(FRACTIONS)[0] for one in drawn]
    extent = np.ptp(np.concatenate(pieces), axis=0).max()
    for k in range(1, len(pieces)):
        if np.hypot(*(pieces[k][0] - pieces[k - 1][-1])) > LIFTED_DISTANCE * extent:
            raise ValueError(f"{file.name} must be one stroke: the pen is lifted between {drawn[k - 1].name} and {drawn[k].name}")
    return np.concatenate(pieces)


def read_curve_table(name: str, text: str) -> np.ndarray:
    """Return the points (n, 2) of rows x, y, or of the columns that a heading names x and y.

    Semicolons, commas or blanks separate the numbers; between semicolons, a comma is a decimal point. Comments begin with #.

    Args:
        name: the name of the file, for messages.
        text: its text.

    Raises:
        ValueError: there are no rows, or one is not two numbers; the message names the line.
    """
    points, columns = [], {}
    for k, line in enumerate(text.splitlines()):
        separator = ";" if ";" in line else "," if "," in line else None
        fields = [field.strip(" \t\"'") for field in line.strip(" \t,;").split(separator)]
        numbers = [_number(field.replace(",", ".")) for field in fields]
        if not points and all(number is None for number in numbers):
            columns |= {match[1]: j for j, field in enumerate(fields) if (match := COORDINATE_COLUMN.match(field.lower()))}
        elif line.strip() and not line.lstrip().startswith("#"):
            chosen = [numbers[j] for j in (columns["x"], columns["y"]) if j < len(numbers)] if len(columns) == 2 else numbers
            if len(chosen) != 2 or None in chosen:
                cure = ", or a heading must name the columns x and y" if len(numbers) > 2 else ""
                raise ValueError(f"line {k + 1} of {name} must be two numbers x, y, not {line!r}{cure}")
            points.append(chosen)
    if not points:
        raise ValueError(f"{name} has no rows x, y")
    return np.array(points)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
