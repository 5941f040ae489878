"""Profiles with holes in DXF files, whose areas, centroids and radii of gyration are known in closed form."""

from typing import Any, NamedTuple

import numpy as np


def document(unit: int = 4) -> tuple[Any, Any]:
    """Return a new file, by default in mm, and its model space."""
    import ezdxf

    file = ezdxf.new("R2010")  # pyright: ignore[reportPrivateImportUsage]
    file.header["$INSUNITS"] = unit
    return file, file.modelspace()


def disc(r, at):
    return np.pi * r**2, np.array(at, float), r**2 / 2


def slot(length, r, at, angle):
    """A rectangle with two half discs: area, centre, squared radius of gyration about it."""
    half = 4 * r / (3 * np.pi)
    area = 2 * length * r + np.pi * r**2
    moment = 2 * length * r * (length**2 + 4 * r**2) / 12
    moment += np.pi * r**2 * (r**2 / 2 - half**2 + (length / 2 + half) ** 2)
    return area, np.array(at, float), moment / area


def segment(R, angle, at, turn):
    """The part of a disc beyond a chord."""
    area = R**2 * (angle - np.sin(angle)) / 2
    d = 4 * R * np.sin(angle / 2) ** 3 / (3 * (angle - np.sin(angle)))
    about_centre = R**4 / 4 * (angle - np.sin(angle) * (2 + np.cos(angle)) / 3)
    return area, np.array(at) + d * np.array([np.cos(turn), np.sin(turn)]), about_centre / area - d**2


def rectangle(a, b, at):
    return a * b, np.array(at, float), (a**2 + b**2) / 12


def combined(parts: Any) -> tuple[Any, Any, Any]:
    """Area, centroid and squared radius of gyration of figures with signs."""
    area = sum(sign * A for sign, (A, _, _) in parts)
    centre = sum(sign * A * c for sign, (A, c, _) in parts) / area
    moment = sum(sign * A * (k + (c - centre) @ (c - centre)) for sign, (A, c, k) in parts)
    return area, centre, moment / area


def add_slot(space, length, r, at, angle, bulged, rng):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    p = [np.array(at) + turn @ x for x in ([-length / 2, -r], [length / 2, -r], [length / 2, r], [-length / 2, r])]
    if bulged:
        space.add_lwpolyline([(*p[0], 0), (*p[1], 1), (*p[2], 0), (*p[3], 1)], format="xyb", close=True)
        return
    deg = np.rad2deg(angle)
    pieces = [
        lambda: space.add_line(p[0], p[1]),
        lambda: space.add_line(p[2], p[3]),
        lambda: space.add_arc(np.array(at) + turn @ [length / 2, 0], r, deg - 90, deg + 90),
        lambda: space.add_arc(np.array(at) - turn @ [length / 2, 0], r, deg + 90, deg + 270),
    ]
    for k in rng.permutation(4):
        pieces[k]()


class Profile(NamedTuple):
    """A profile in mm with two round holes and a slot."""

    file: Any
    area: float
    centre: np.ndarray
    square: float
    places: list[np.ndarray]
    radii: np.ndarray

    def errors(self, found: Any) -> tuple[float, float, float]:
        """Return the relative errors of area, centroid and squared radius of gyration of an outline in m."""
        size, mm = np.sqrt(self.area) + np.abs(self.centre).max(), 1e-3
        return (
            abs(found.area / mm**2 / self.area - 1),
            float(np.abs(found.centroid / mm - self.centre).max() / size),
            abs(found.square_radius / mm**2 / self.square - 1),
        )


def profile(seed: int) -> Profile:
    """Return a bar with round ends, a rectangle with bulged sides, an ellipse or a disc, drawn in one of several ways."""
    rng = np.random.default_rng(seed)
    (file, space), at, kind = document(), rng.uniform(-500, 500, 2), seed % 4
    if kind == 0:  # a bar with round ends, by bulges or by loose lines and arcs
        length, r, angle = rng.uniform(60, 200), rng.uniform(15, 30), rng.uniform(0, 2 * np.pi)
        add_slot(space, length, r, at, angle, seed % 8 == 0, rng)
        outer, along = slot(length, r, at, angle), np.array([np.cos(angle), np.sin(angle)])
        places = [at - along * length / 2, at + along * length / 2]
    elif kind == 1:  # a rectangle with bulged sides
        a, b, bulge = rng.uniform(80, 120), rng.uniform(50, 70), rng.uniform(0.001, 0.9)
        corners = at + 0.5 * np.array([[-a, -b], [a, -b], [a, b], [-a, b]])
        order = corners if seed % 8 == 1 else corners[::-1]
        sign = 1 if seed % 8 == 1 else -1
        space.add_lwpolyline([(*p, sign * bulge) for p in order], format="xyb", close=True)
        outer, angle = [(1, rectangle(a, b, at))], 4 * np.arctan(bulge)
        for k, (side, off) in enumerate(((b, a / 2), (a, b / 2), (b, a / 2), (a, b / 2))):
            R, turn = side / (2 * np.sin(angle / 2)), k * np.pi / 2
            way = np.array([np.cos(turn), np.sin(turn)])
            outer.append((1, segment(R, angle, at + way * (off - R * np.cos(angle / 2)), turn)))
        outer, places = combined(outer), [at - [a / 3, 0], at + [a / 3, 0]]
    elif kind == 2:  # an ellipse
        a, b = rng.uniform(60, 90), rng.uniform(30, 50)
        space.add_ellipse(at, major_axis=(a, 0), ratio=b / a)
        outer, places = (np.pi * a * b, at, (a**2 + b**2) / 4), [at - [a / 2, 0], at + [a / 2, 0]]
    else:  # a disc
        r = rng.uniform(50, 100)
        space.add_circle(at, r)
        outer, places = disc(r, at), [at - [r / 2, 0], at + [r / 2, 0]]
    radii, parts = rng.uniform(3, 8, 2), [(1, outer)]
    for place, radius in zip(places, radii, strict=True):
        space.add_circle(place, radius)
        parts.append((-1, disc(radius, place)))
    add_slot(space, 8.0, 2.0, at, 0.3, seed % 2 == 0, rng)
    return Profile(file, *combined([*parts, (-1, slot(8.0, 2.0, at, 0.3))]), places, radii)
