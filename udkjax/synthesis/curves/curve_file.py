"""A curve from a file: rows x, y of a CSV file, or the path of an SVG file."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

PIECES = 48  # straight pieces for an arc or a Bézier curve
NUMBERS_OF = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
LINES = str.maketrans("Mm", "Ll")  # further numbers of a move are lines
FRACTIONS = np.arange(1, PIECES + 1) / PIECES


def read_curve_file(file: Path) -> np.ndarray:
    """Return the points (n, 2) of a curve in a file, in its unit, with y upwards.

    Args:
        file: rows x, y of numbers after an optional heading (`.csv`, `.txt`), or a drawing with one path in one stroke (`.svg`).

    Raises:
        ValueError: the file has no curve, or more than one; the message names the line or the element.
        OSError: the file cannot be read.
    """
    text = file.read_text(encoding="utf-8-sig")
    return _of_drawing(file.name, text) if file.suffix.lower() == ".svg" else _of_rows(file.name, text)


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


def _of_drawing(name: str, text: str) -> np.ndarray:
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as problem:
        raise ValueError(f"{name} is no SVG file: {problem}") from None
    moved = [one for one in root.iter() if "transform" in one.attrib]
    if moved:
        raise ValueError(f"{name} has a transform: apply it to the path (in Inkscape: ungroup, then Path > Flatten)")
    paths = [one.attrib.get("d", "") for one in root.iter() if one.tag.rpartition("}")[2] == "path"]
    if len(paths) != 1:
        raise ValueError(f"{name} must have one path, not {len(paths)}")
    return points_of_path(paths[0])


def points_of_path(text: str) -> np.ndarray:
    """Return the points (n, 2) of an SVG path in one stroke, with y upwards.

    Raises:
        ValueError: it is no path, or has more than one stroke.
    """
    z, start, handle, points = 0j, 0j, None, []
    for command, numbers in _commands(text):
        kind, origin = command.upper(), z if command.islower() else 0j
        if kind == "M" and len(points) > 1:
            raise ValueError("the path must be one stroke: it lifts the pen in between")
        if kind == "H":
            new, handle = [complex(numbers[0] + origin.real, z.imag)], None
        elif kind == "V":
            new, handle = [complex(z.real, numbers[0] + origin.imag)], None
        elif kind == "A":
            new, handle = _arc(z, origin + complex(*numbers[5:]), *numbers[:5]), None
        elif kind == "Z":
            new, handle = [start], None
        else:
            ends = [origin + complex(*numbers[k : k + 2]) for k in range(0, len(numbers), 2)]
            if kind in "ST":
                is_same = handle is not None and handle[0] == ("C" if kind == "S" else "Q")
                ends = [2 * z - handle[1] if is_same and handle else z, *ends]
            handle = None if kind in "ML" else ("C" if kind in "CS" else "Q", ends[-2])
            new = ends if kind in "ML" else _bezier([z, *ends])
        start = new[-1] if kind == "M" else start
        points = new if kind == "M" else [*points, *new]
        z = new[-1]
    if len(points) < 2:
        raise ValueError("the path draws nothing")
    return np.array([[p.real, 0.0 - p.imag] for p in points])


def _commands(text: str) -> Iterator[tuple[str, list[float]]]:
    """Return the commands of a path, with their numbers; further numbers repeat a command."""
    if re.sub(rf"{NUMBER}|[{''.join(NUMBERS_OF)}]|[\s,]", "", text, flags=re.IGNORECASE) or not re.match(r"\s*[Mm]", text):
        raise ValueError(f"this is no path of an SVG file: {text[:40]!r}")
    for letter, rest in re.findall(r"([A-DF-Za-df-z])([^A-DF-Za-df-z]*)", text):
        needed = NUMBERS_OF[letter.upper()]
        pattern = rf"({NUMBER})[\s,]*" if needed != 7 else None
        numbers = [float(n) for n in re.findall(pattern, rest)] if pattern else _arc_numbers(rest)
        if (len(numbers) % needed if needed else numbers) or (needed and not numbers):
            raise ValueError(f"command {letter} of the path needs {needed} numbers, not {len(numbers)}")
        for k in range(0, max(len(numbers), 1), needed or 1):
            yield str(letter).translate(LINES) if k else str(letter), numbers[k : k + needed]


def _arc_numbers(text: str) -> list[float]:
    """Return the numbers of arcs, whose flags, 0 or 1, may be written without separators."""
    separator = r"[\s,]*"
    found = re.findall(separator.join([rf"({NUMBER})"] * 3 + ["([01])"] * 2 + [rf"({NUMBER})"] * 2), text)
    return [float(n) for one in found for n in one]


def _bezier(handles: list[complex]) -> list[complex]:
    n = len(handles) - 1
    weights = np.stack([math.comb(n, k) * FRACTIONS**k * (1 - FRACTIONS) ** (n - k) for k in range(n + 1)])
    return list(np.array(handles) @ weights)


def _arc(start: complex, end: complex, rx: float, ry: float, turn: float, large: float, sweep: float) -> list[complex]:
    """Return points of an elliptic arc, by its images on the unit circle."""
    rx, ry = abs(rx), abs(ry)
    if start == end or not rx * ry:
        return [end]
    axis = complex(math.cos(math.radians(turn)), math.sin(math.radians(turn)))
    a, b = (complex((z / axis).real / rx, (z / axis).imag / ry) for z in (start, end))
    half = 0.5 * abs(b - a)
    size = max(half, 1.0)  # radii that are too small grow
    side = 1.0 if bool(large) != bool(sweep) else -1.0
    middle = 0.5 * (a + b) + side * 1j * (b - a) / (2 * half) * math.sqrt(max(size**2 - half**2, 0.0))
    first, last = math.atan2((a - middle).imag, (a - middle).real), math.atan2((b - middle).imag, (b - middle).real)
    angle = (last - first) % (2 * math.pi) if sweep else -((first - last) % (2 * math.pi))
    z = middle + size * np.exp(1j * (first + angle * FRACTIONS))
    return [*(axis * (rx * np.real(z) + 1j * ry * np.imag(z)))[:-1], end]
