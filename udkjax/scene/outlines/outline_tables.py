"""Links of a scene file whose outline is the name of a DXF or SVG file, with the numbers that follow from it instead.

The numbers of the file are part of the mechanism from then on: it is saved with the corners, and needs the file no more.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from udkjax.requirements import ArgumentError
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.outlines.outline import Outline, read_outline
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import abbreviate, quote, suggestion

KEYS = "file", "unit", "layers", "chord"
FROM_AREA = {"density": "kg/m3", "thickness": "m"}  # with which the area gives a mass


def with_outlines(scene: Mapping[str, Any], source: str) -> Mapping[str, Any]:
    """Return the tables of a drawing with corners, holes, mass, centre and inertia of outlines that are files.

    Args:
        scene: the tables. `outline` of a link is a name, relative to the folder of the scene, or a table with `file`, and
            `unit`, `layers` and `chord` (m) as for `read_outline` and `Outline.link`.
        source: the path of the scene.

    Raises:
        SceneError: lists all mistakes of all files.
    """
    links, problems = scene.get("link"), []
    if not isinstance(links, list) or not any(isinstance(x, dict) and isinstance(x.get("outline"), str | dict) for x in links):
        return scene
    units, found = Units(scene.get("units", {})), []
    for k, link in enumerate(links):
        if isinstance(link, dict) and isinstance(link.get("outline"), str | dict):
            where = f"link[{k}]" + (f" {quote(link['name'])}" if isinstance(link.get("name"), str) else "")
            link = _with_outline(link, f"{where}.outline", Path(source).parent, units, problems)
        found.append(link)
    if problems:
        raise SceneError(problems, source)
    return {**scene, "link": found}


def _with_outline(link: dict[str, Any], path: str, folder: Path, units: Units, problems: list[str]) -> dict[str, Any]:
    given = link["outline"] if isinstance(link["outline"], dict) else {"file": link["outline"]}
    unknown = [f"{path}.{key}: unknown key{suggestion(key, KEYS)}" for key in given if key not in KEYS]
    if unknown or not isinstance(given.get("file"), str):
        problems += unknown or [f"{path}: needs the name of a file, not {abbreviate(link['outline'])}"]
        return link
    chord = given.get("chord")
    chord = None if chord is None else units.convert(f"{path}.chord", chord, "m", problems)
    try:
        outline = read_outline(folder / given["file"], given.get("unit"), given.get("layers"))
        corners = outline.polygon(chord), outline.hole_polygons(chord)  # pyright: ignore[reportArgumentType]
    except SceneError as error:
        problems += [f"{path}: {given['file']}: {problem}" for problem in error.problems]
        return link
    except (OSError, ArgumentError) as error:
        problems.append(f"{path}: {given['file']}: {error}")
        return link
    table = {key: value for key, value in link.items() if key not in FROM_AREA}
    table |= _masses(link, outline, path.removesuffix(".outline"), units, problems)
    for key, points in zip(("outline", "holes"), corners, strict=True):
        if points is not None:
            table[key] = np.vectorize(lambda x: units.write(float(x), "m"), otypes=[object])(points).tolist()
    return table


def _masses(link: dict[str, Any], outline: Outline, path: str, units: Units, problems: list[str]) -> dict[str, Any]:
    """Return mass, inertia and centre of a link, exact for its outline, where they are not given."""
    if "mass" in link:
        mass = units.convert(f"{path}.mass", link["mass"], "kg", problems)
    else:
        parts = [units.convert(f"{path}.{key}", link[key], unit, problems) for key, unit in FROM_AREA.items() if key in link]
        if len(parts) < len(FROM_AREA):
            problems.append(f"{path}: needs a mass, or a density and a thickness")
        mass = None if len(parts) < len(FROM_AREA) or None in parts else parts[0] * parts[1] * outline.area  # pyright: ignore
    if mass is None or not isinstance(mass, float | int):
        return {}
    found = {"mass": units.write(mass, "kg"), "inertia": units.write(mass * outline.square_radius, "kg m2")}
    return found | {"centre": [units.write(float(x), "m") for x in outline.centroid]} | {k: link[k] for k in found if k in link}
