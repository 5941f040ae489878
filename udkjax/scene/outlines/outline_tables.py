"""Links of a scene file whose outline is the name of a DXF or SVG file, with the numbers that follow from it instead.

The numbers of the file are part of the mechanism from then on: it is saved with the corners, and needs the file no more.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from udkjax.requirements import ArgumentError
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.outlines.hole_pins import HolePins, names_of_links
from udkjax.scene.outlines.outline import Outline, read_outline
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import abbreviate, quote, suggestion

OUTLINE_KEYS = "file", "unit", "layers", "chord", "pin"
FROM_AREA = {"density": "kg/m3", "thickness": "m"}  # with which the area gives a mass


def with_outlines(scene: Mapping[str, Any], source: str) -> Mapping[str, Any]:
    """Return the tables of a drawing in which outlines from files are replaced by corners, holes, mass, centre and inertia.

    A link without `pins` has the pins at its round holes (hole_pins.py).

    Args:
        scene: the tables. `outline` of a link is a name, relative to the folder of the scene, or a table with `file`, and
            `unit`, `layers` and `chord` (m) as for `read_outline` and `Outline.link`, and `pin`, the diameter of its holes with
            pins (m).
        source: the path of the scene.

    Raises:
        SceneError: lists all mistakes of all files.
    """
    found = _with_files(scene, source)
    if found is None:
        return scene
    tables, outlines, units, problems = found
    links = list(tables["link"])
    for k, file in outlines.items():
        links[k] = _with_outline(links[k], file, units, problems)
    if problems:
        raise SceneError(problems, source)
    return {**tables, "link": links}


class _File(NamedTuple):
    """The outline of a link from a file, the distance `chord` (m) for its polygon, and the path of the link for messages."""

    outline: Outline
    chord: float | None
    path: str


def _with_files(scene: Mapping[str, Any], source: str) -> tuple[dict[str, Any], dict[int, _File], Units, list[str]] | None:
    """Return tables with pins at holes, outlines from files by index of the link, units, and mistakes; None without files."""
    links, problems = scene.get("link"), []
    if not isinstance(links, list) or not any(isinstance(x, dict) and isinstance(x.get("outline"), str | dict) for x in links):
        return None
    units, outlines = Units(scene.get("units", {})), {}
    units.read_numbers(scene.get("numbers", {}), [])  # mistakes are found with the drawing
    pins = HolePins(scene["pins"] if isinstance(scene.get("pins"), dict) else {}, units)
    found = list(links)
    for k, (link, name) in enumerate(zip(links, names_of_links(links), strict=True)):
        if not isinstance(link, dict) or not isinstance(link.get("outline"), str | dict):
            continue
        path = f"link[{k}]" + (f" {quote(link['name'])}" if isinstance(link.get("name"), str) else "")
        read = _read(link["outline"], path, Path(source).parent, units, problems)
        if read is None:
            continue
        outlines[k], diameter = read
        if "pins" not in link:
            mistakes: list[str] = []
            found[k] = {**link, "pins": pins.of_link(name, outlines[k].outline, diameter, mistakes)}
            problems += [f"{path}.outline: {mistake}" for mistake in mistakes]
    return {**scene, "link": found, "pins": pins.pins}, outlines, units, problems


def _read(
    outline: str | dict[str, Any], path: str, folder: Path, units: Units, problems: list[str]
) -> tuple[_File, float | None] | None:
    """Return the outline of a file, and the diameter of its holes with pins (m); None, with problems, on failure."""
    given = outline if isinstance(outline, dict) else {"file": outline}
    unknown = [f"{path}.outline.{key}: unknown key{suggestion(key, OUTLINE_KEYS)}" for key in given if key not in OUTLINE_KEYS]
    if unknown or not isinstance(given.get("file"), str):
        problems += unknown or [f"{path}.outline: needs the name of a file, not {abbreviate(outline)}"]
        return None
    sizes: list[Any] = []
    for key in ("chord", "pin"):
        size = given.get(key)
        size = None if size is None else units.convert(f"{path}.outline.{key}", size, "m", problems)
        if size is not None and not (isinstance(size, int | float) and 0.0 < size < np.inf):
            problems.append(f"{path}.outline.{key}: must be a positive length, not {abbreviate(given[key])}")
            size = None
        sizes.append(size)
    try:
        read = read_outline(folder / given["file"], given.get("unit"), given.get("layers"))
    except SceneError as error:
        problems += [f"{path}.outline: {given['file']}: {problem}" for problem in error.problems]
        return None
    except (OSError, ArgumentError) as error:
        problems.append(f"{path}.outline: {given['file']}: {error}")
        return None
    return _File(read, sizes[0], path), sizes[1]


def _with_outline(link: dict[str, Any], file: _File, units: Units, problems: list[str]) -> dict[str, Any]:
    table = {key: value for key, value in link.items() if key not in FROM_AREA}
    table |= _masses(link, file.outline, file.path, units, problems)
    corners = file.outline.polygon(file.chord), file.outline.hole_polygons(file.chord)
    for key, points in zip(("outline", "holes"), corners, strict=True):
        if points is not None:
            table[key] = np.vectorize(lambda x: units.write(float(x), "m"), otypes=[object])(points).tolist()
    return table


def _masses(link: dict[str, Any], outline: Outline, path: str, units: Units, problems: list[str]) -> dict[str, Any]:
    """Return keys of the table of a link: its mass, inertia and centre of mass, given or exact for its outline.

    The result is empty if the mass is unknown, which is a problem.
    """
    if "mass" in link:
        mass = units.convert(f"{path}.mass", link["mass"], "kg", problems)
    else:
        parts = [units.convert(f"{path}.{key}", link[key], unit, problems) for key, unit in FROM_AREA.items() if key in link]
        if len(parts) < len(FROM_AREA):
            problems.append(f"{path}: needs a mass, or a density and a thickness")
        mass = None if len(parts) < len(FROM_AREA) or None in parts else parts[0] * parts[1] * outline.area  # pyright: ignore
    if mass is None or not isinstance(mass, float | int):
        return {}
    found = {
        "mass": units.write(mass, "kg"),
        "inertia": units.write(mass * outline.square_radius, "kg m2"),
        "centre": [units.write(float(x), "m") for x in outline.centroid],
    }
    return found | {key: link[key] for key in found if key in link}
