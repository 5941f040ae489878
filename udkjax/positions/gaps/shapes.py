"""Outlines of links as convex parts: bars with round ends, discs, plates, drawn outlines, and cams.

The shapes are those by which a drawing computes masses: `Link.kind` and `Drawing.shapes`.
"""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from udkjax.arrays import by_numpy, library_for, without_derivatives
from udkjax.positions.assembling.channels import pins_of, point_of_pin
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Cam
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote, suggestion

_drawn_shapes = cached_by_identity(deferred(lambda drawing: drawing.shapes(), keeps_concrete=True))
CAM_CORNERS = 180  # of the outline of a cam: one each two degrees, as in pictures


class ConvexPart(NamedTuple):
    """A convex part of a link: corners (V, 2) in its frame (m), anticlockwise, and the radius around them (m)."""

    body: str
    corners: Any
    radius: Any


def parts_of(mechanism: Mechanism, shapes: Mapping[str, Any] | None, of: Collection[str]) -> list[ConvexPart]:
    """Return the convex parts of the links named in `of`, from given `shapes` by name or else as drawn; numbers may be traced.

    Raises a `SceneError` that names all links whose outlines are missing or wrong.
    """
    names, given, problems, found = mechanism.body_names, dict(shapes or {}), [], []
    for name in given:
        if name not in (*names, GROUND):
            problems.append(f"shapes: no link named {quote(name)}{suggestion(name, names)}")
    drawn = {} if mechanism.drawing is None else _drawn_shapes(mechanism.drawing)
    links = {} if mechanism.drawing is None else mechanism.drawing.groups["link"]
    cams = _cams(mechanism, given)
    for name in of:
        try:
            if name in given:
                found += _given_parts(mechanism, name, given[name])
            elif name in links:
                found += _drawn_parts(name, links[name], drawn[name], name in cams)
            elif name not in cams:
                raise ValueError(f"has no outline; give its width or corners, shapes={{{name!r}: 0.02}}")
        except (TypeError, ValueError) as error:
            problems.append(f"link {quote(name)}: {error}")
    if problems:
        raise SceneError(problems, mechanism.name)
    return [*found, *(part for name in of for part in cams.get(name, ()))]


def _drawn_parts(name: str, link: Any, points: Any, is_cam: bool) -> list[ConvexPart]:
    if link.kind in ("bar", "disc"):
        if link.width is None:
            if is_cam:
                return []
            raise ValueError(f"has no width; give width= to the link, or shapes={{{name!r}: 0.02}}")
        ends = [0] if link.kind == "disc" else [0, -1]
        return [ConvexPart(name, by_numpy(points)[np.array(ends)], 0.5 * by_numpy(link.width))]
    return [ConvexPart(name, corners, 0.0) for corners in convex_pieces(by_numpy(points))]


def _given_parts(mechanism: Mechanism, name: str, shape: Any) -> list[ConvexPart]:
    """Return the convex parts of a body from its given shape: a width around its pins, corners, or corners with a width.

    Raises a `ValueError` without the name of the body if the shape is wrong.
    """
    points, width = shape if isinstance(shape, tuple) and len(shape) == 2 and np.ndim(shape[1]) == 0 else (None, shape)
    if points is None and np.ndim(shape) == 2:
        points, width = shape, 0.0
    if points is None:
        points = _pins(mechanism, name)
    points, width = by_numpy(points), by_numpy(width)
    if np.ndim(width) or np.ndim(points) != 2 or np.shape(points)[1] != 2:
        raise ValueError("its shape must be a width (m), corners (n, 2) in its frame (m), or a tuple of both")
    size = without_derivatives(width)
    if isinstance(size, np.ndarray) and not 0 <= size < np.inf:
        raise ValueError(f"its width must be finite and not negative, not {float(size):g}")
    return [ConvexPart(name, corners, 0.5 * width) for corners in convex_pieces(points)]


def _pins(mechanism: Mechanism, name: str) -> Any:
    """Return the corners of the convex hull of the pins of a body, in its frame (m)."""
    if mechanism.drawing is not None and name in mechanism.drawing.groups["link"]:
        points = list(by_numpy(mechanism.drawing.shapes()[name]))
    else:
        named = [by_numpy(point) for body, point in (point_of_pin(mechanism, pin) for pin in pins_of(mechanism)) if body == name]
        held = [j for j in mechanism.joints.values() if getattr(j, "points", None) is not None and name in j.bodies]
        points = [*named, *(by_numpy(joint.points)[joint.bodies.index(name)] for joint in held)]
    if not points:
        raise ValueError("has no pins; give the corners of its outline")
    xp = library_for(points)
    return xp.stack(points)[hull(np.stack([np.asarray(without_derivatives(x)) for x in points]))]


def hull(points: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "corners"]:
    """Return the indices of the corners of the convex hull of points, anticlockwise, without points on its edges."""
    near = 1e-12 * float(np.ptp(points, axis=0).max()) ** 2
    _, kept = np.unique(points, axis=0, return_index=True)  # in the order of x, then y, as Andrew's chains need them

    def chain(ordered: np.ndarray) -> list[int]:
        found: list[int] = []
        for k in ordered.tolist():
            while len(found) > 1 and _turn(*points[[*found[-2:], k]]) <= near:
                found.pop()
            found.append(k)
        return found[:-1]

    return np.array([*chain(kept), *chain(kept[::-1])] if len(kept) > 1 else kept)


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def convex_pieces(corners: Any) -> list[Any]:
    """Return convex pieces of a polygon, anticlockwise: the polygon if it is convex, else triangles, by cutting off ears."""
    points = np.asarray(without_derivatives(corners))
    if len(points) < 3:
        return [corners]
    twice = float((points[:, 0] * np.roll(points[:, 1], -1) - np.roll(points[:, 0], -1) * points[:, 1]).sum())
    order = list(range(len(points))) if twice > 0 else list(range(len(points)))[::-1]
    near = 1e-12 * abs(twice)
    if _is_convex(points[order], near):
        return [corners[np.array(order)]]
    pieces = []
    while len(order) > 3:
        for k in range(len(order)):
            a, b, c = order[k - 1], order[k], order[(k + 1) % len(order)]
            others = points[[i for i in order if i not in (a, b, c)]]
            if _turn(points[a], points[b], points[c]) > near and not _contains(points[[a, b, c]], others):
                pieces.append(corners[np.array([a, b, c])])
                break
        else:  # only corners on straight lines are left
            k = 0
        order.pop(k)
    return [*pieces, corners[np.array(order)]]


def _is_convex(points: np.ndarray, near: float) -> bool:
    """Return True if a polygon turns left at each corner, by one full turn in total; `near` is the rounding error of areas."""
    ways = np.roll(points, -1, axis=0) - points
    after = np.roll(ways, -1, axis=0)
    turns = np.arctan2(ways[:, 0] * after[:, 1] - ways[:, 1] * after[:, 0], (ways * after).sum(1))
    cross = ways[:, 0] * after[:, 1] - ways[:, 1] * after[:, 0]
    return bool((cross >= -near).all() and turns.sum() < 3 * np.pi)


def _contains(triangle: np.ndarray, points: np.ndarray) -> bool:
    ways = np.roll(triangle, -1, axis=0) - triangle
    off = points[:, None] - triangle
    return bool((ways[:, 0] * off[..., 1] - ways[:, 1] * off[..., 0] >= 0).all(1).any())


def _cams(mechanism: Mechanism, given: Mapping[str, Any]) -> dict[str, list[ConvexPart]]:
    """Return the convex parts of cams by body, unless its shape is given; a cam with a roller has the path of its centre."""
    found: dict[str, list[ConvexPart]] = {}
    for joint in mechanism.joints.values():
        if isinstance(joint, Cam) and joint.bodies[0] not in given:
            rim = joint.profile.rim(CAM_CORNERS, joint.face is not None) + by_numpy(joint.points)[0]
            found.setdefault(joint.bodies[0], []).extend(ConvexPart(joint.bodies[0], x, 0.0) for x in convex_pieces(rim))
    return found
