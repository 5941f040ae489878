"""The outline of a link from a file."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.printing import PrintedTable, format_number, prints_table
from udkjax.requirements import ArgumentError, require_names, require_number, require_text
from udkjax.scene.drawing.link import Link
from udkjax.scene.numbers.quantities import conversion_factor
from udkjax.scene.outlines.contours import Contour, DrawnPiece, contains, contours_of
from udkjax.scene.outlines.curves import Arc, Bezier, moments
from udkjax.scene.outlines.dxf import read_dxf
from udkjax.scene.outlines.svg import read_svg
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote

DEFAULT_CHORD = 1e-4  # of the square root of the area: the largest distance of a polygon from its outline, by default


class RoundHole(NamedTuple):
    """A round hole of an outline.

    Attributes:
        centre: in m.
        radius: in m.
    """

    centre: Float[np.ndarray, "2"]
    radius: float


@prints_table
class Outline(NamedTuple):
    """A plane figure within a closed contour, with holes.

    Attributes:
        outer: the contour around it.
        holes: the contours of its holes.
        area: in m^2.
        centroid: in m.
        square_radius: the squared radius of gyration about the centroid (m^2); mass times it is the inertia.
    """

    outer: Contour
    holes: tuple[Contour, ...]
    area: float
    centroid: Float[np.ndarray, "2"]
    square_radius: float

    @property
    def circles(self) -> tuple[RoundHole, ...]:
        """The round holes, from left to right: places of pins."""
        found = [RoundHole(*circle) for circle in (hole.circle for hole in self.holes) if circle is not None]
        return tuple(sorted(found, key=lambda x: tuple(x.centre)))

    def polygon(self, chord: float | None = None) -> Float[np.ndarray, "n 2"]:
        """Return corners (m) of a polygon whose sides are nearer to the outer contour than `chord` (m)."""
        if chord is not None:
            require_number("chord", chord, "positive")
        return self.outer.polygon(DEFAULT_CHORD * float(np.sqrt(self.area)) if chord is None else float(chord))

    def hole_polygons(self, chord: float | None = None) -> Float[np.ndarray, "holes n 2"] | None:
        """Return corners (m) of polygons of the holes, the same number for each, since corners may be repeated.

        The sides are nearer to the holes than `chord` (m). The result is None if the outline has no holes.
        """
        chord = DEFAULT_CHORD * float(np.sqrt(self.area)) if chord is None else float(chord)
        found = [hole.polygon(chord) for hole in self.holes]
        most = max(map(len, found), default=0)
        return np.stack([np.append(x, np.repeat(x[-1:], most - len(x), 0), 0) for x in found]) if found else None

    def link(
        self,
        pins: Sequence[str],
        density: float | None = None,
        thickness: float | None = None,
        mass: float | None = None,
        chord: float | None = None,
    ) -> Link:
        """Return a link of this outline with its exact mass, centre of mass and inertia, holes included; drawn as a polygon.

        Args:
            pins: the names of its pins, in order.
            density: in kg/m^3, together with `thickness`.
            thickness: in m.
            mass: in kg, instead of both.
            chord: the largest distance (m) of the drawn polygon from the outline, which also bounds the error of its gaps.
        """
        given = {"density": density, "thickness": thickness, "mass": mass}
        for name, value in given.items():
            if value is not None:
                require_number(name, value, "positive")
        if (mass is None) == (density is None) or (density is None) != (thickness is None):
            raise ArgumentError("give mass, or density and thickness")
        m = float(mass) if mass is not None else float(density or 0) * float(thickness or 0) * self.area
        return Link(
            pins,
            mass=m,
            inertia=m * self.square_radius,
            centre=self.centroid,
            outline=self.polygon(chord),
            holes=self.hole_polygons(chord),
        )

    def _table(self) -> PrintedTable:
        size = float(np.sqrt(self.area))
        rows: list[tuple[Any, ...]] = [
            ("area", f"{self.area:.6g} m²"),
            ("centroid", ", ".join(format_number(x, "m", size) for x in self.centroid)),
            ("radius of gyration", format_number(np.sqrt(self.square_radius), "m")),
            ("holes", len(self.holes)),
        ]
        for hole in self.circles:
            place = ", ".join(format_number(x, "m", size) for x in hole.centre)
            rows.append(("round hole", f"of radius {format_number(hole.radius, 'm')} at {place}"))
        return PrintedTable("outline", rows)


def read_outline(path: str | os.PathLike[str], unit: str | None = None, layers: Sequence[str] | None = None) -> Outline:
    """Return the outline that a DXF or SVG file draws: one closed contour of lines, arcs and splines, with its holes.

    Area, centroid and inertia are exact up to rounding. Pieces may be drawn in any order and direction; ends nearer than 1e-6 of
    the drawing's size meet.

    Args:
        path: the file; reading it needs ezdxf (extra `dxf`) or svgelements (extra `svg`). The y axis of an SVG file is turned
            up.
        unit: the unit of the file, such as "mm", if it has none; otherwise it must be that of the file: of the header of a DXF
            file, mm for an SVG file whose width has a unit.
        layers: the names of the layers of a DXF file that have contours; by default all.

    Returns:
        The `Outline`.

    Raises:
        SceneError: a contour is open, branches or crosses itself or another one, there is not one outer contour, or the unit is
            missing or another one; the error names contours and places.
        OSError: the file cannot be read.
    """
    name = os.fspath(path)
    if unit is not None:
        require_text("unit", unit)
    if layers is not None:
        require_names("layers", layers)
    suffix = Path(path).suffix.lower()
    if suffix not in (".dxf", ".svg"):
        raise SceneError([f"{quote(name)} must be a file .dxf or .svg"], name)
    if suffix == ".svg" and layers is not None:
        raise SceneError(["layers: those of a DXF file; leave out other shapes of an SVG file"], name)
    drawn, own, problems = read_svg(path) if suffix == ".svg" else read_dxf(path, None if layers is None else tuple(layers))
    if problems and not drawn:
        raise SceneError(problems, name)
    if unit is None and own is None:
        problems.append('the file has no unit of length; give it, unit="mm"')
    elif unit is not None and own is not None and unit != own:
        problems.append(f"the file's unit is {quote(own)}, not {quote(unit)}; leave out unit, or mend the file")
    problems += [] if drawn else ["there are no lines, arcs or other curves" + (f" in the layers {layers}" if layers else "")]
    if problems:
        raise SceneError(problems, name)
    chosen = unit or own or "m"
    try:
        scale = float(conversion_factor(chosen, "m"))
    except ValueError as error:
        raise SceneError([f"unit: {error}"], name) from None
    contours, problems = contours_of([_scaled(x, scale) for x in drawn], scale, chosen)
    if problems:
        raise SceneError(problems, name)
    return outline_of_contours(contours, name)


def _scaled(drawn: DrawnPiece, scale: float) -> DrawnPiece:
    piece = drawn.piece
    if isinstance(piece, Arc):
        return DrawnPiece(Arc(piece.centre * scale, piece.x * scale, piece.y * scale, piece.start, piece.sweep), drawn.name)
    return DrawnPiece(Bezier(piece.points * scale), drawn.name)


def outline_of_contours(contours: Sequence[Contour], name: str) -> Outline:
    """Return the outline of one contour with holes; `name` is that of the file, for messages."""
    areas = [moments(x.pieces, x.polygon(np.inf)[0])[0] for x in contours]
    k = int(np.argmax(np.abs(areas)))
    outer, fine = contours[k], contours[k].polygon(DEFAULT_CHORD * float(np.sqrt(abs(areas[k]))))
    polygons = [x.polygon(np.inf) for x in contours]
    problems = []
    for j, contour in enumerate(contours):
        place = f"contour {j + 1} ({contour.name})"
        if j != k and not contains(fine, polygons[j][0]):
            problems.append(f"{place} lies outside of contour {k + 1} ({outer.name}): a link has one outline; name its layers")
        if any(contains(polygons[i], polygons[j][0]) for i in range(len(contours)) if i not in (j, k)):
            problems.append(f"{place} lies within a hole: a link is one piece")
    if problems:
        raise SceneError(problems, name)
    about, total = fine.mean(0), [0.0, np.zeros(2), 0.0]
    for j, contour in enumerate(contours):
        sign = np.sign(areas[j]) * (1 if j == k else -1)
        total = [x + sign * y for x, y in zip(total, moments(contour.pieces, about), strict=True)]
    area, first, second = total
    arm = first / area
    holes = tuple(x for j, x in enumerate(contours) if j != k)
    if areas[k] < 0:
        outer = Contour(tuple(piece.reverse() for piece in outer.pieces[::-1]), outer.name)
    return Outline(outer, holes, float(area), about + arm, float(second / area - arm @ arm))
