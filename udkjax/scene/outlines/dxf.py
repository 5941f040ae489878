"""Pieces of contours from a DXF file: lines, arcs, circles, ellipses, splines and polylines with bulges, in blocks, too."""

import os
from itertools import pairwise
from typing import Any

import numpy as np

from udkjax.extras import OptionalImport
from udkjax.scene.outlines.contours import DrawnPiece
from udkjax.scene.outlines.curves import Arc, Bezier, Piece, bulge, circle, line

UNIT_CODES = {1: "in", 2: "ft", 4: "mm", 5: "cm", 6: "m", 7: "km", 13: "um"}  # by the number in a file's header
IGNORED_ENTITIES = {"TEXT", "MTEXT", "DIMENSION", "POINT", "HATCH", "LEADER", "ATTDEF", "VIEWPORT"}


def read_dxf(path: str | os.PathLike[str], layers: tuple[str, ...] | None) -> tuple[list[DrawnPiece], str | None, list[str]]:
    """Return the pieces of the model space in the file's unit, that unit (None if the file does not name it), and mistakes."""
    with OptionalImport():
        import ezdxf
        from ezdxf import upright
        from ezdxf.disassemble import recursive_decompose
        from ezdxf.lldxf.const import DXFError
    try:
        file = ezdxf.readfile(os.fspath(path))  # pyright: ignore[reportPrivateImportUsage]
    except DXFError as error:
        return [], None, [f"not a DXF file that can be read: {error}"]
    drawn, problems = [], []
    for entity in recursive_decompose(file.modelspace()):
        layer, kind = entity.dxf.layer, entity.dxftype()
        if kind in IGNORED_ENTITIES or (layers is not None and layer not in layers):
            continue
        upright.upright(entity)  # pyright: ignore[reportArgumentType]
        pieces = _pieces(entity, kind)
        if pieces is None:
            cure = "convert it into arcs" if kind == "SPLINE" else "move it to another layer, and name layers"
            problems.append(f"{kind} in layer {layer!r} cannot be a part of a contour; {cure}")
        else:
            drawn += [DrawnPiece(piece, f"{kind} in layer {layer!r}") for piece in pieces]
    return drawn, UNIT_CODES.get(file.units), problems


def _pieces(entity: Any, kind: str) -> list[Piece] | None:
    dxf = entity.dxf
    if kind == "LINE":
        return [line(_plane(dxf.start), _plane(dxf.end))]
    if kind == "CIRCLE":
        return [circle(_plane(dxf.center), dxf.radius)]
    if kind == "ARC":
        start, sweep = np.deg2rad(dxf.start_angle), np.deg2rad((dxf.end_angle - dxf.start_angle) % 360 or 360.0)
        return [circle(_plane(dxf.center), dxf.radius)._replace(start=float(start), sweep=float(sweep))]
    if kind == "ELLIPSE":
        x, sweep = _plane(dxf.major_axis), (dxf.end_param - dxf.start_param) % (2 * np.pi)
        y = dxf.ratio * np.array([-x[1], x[0]]) * np.sign(dxf.extrusion.z)
        return [Arc(_plane(dxf.center), x, y, float(dxf.start_param), float(sweep or 2 * np.pi))]
    if kind in ("LWPOLYLINE", "POLYLINE"):
        if kind == "LWPOLYLINE":
            points = [(np.array([x, y]), b) for x, y, b in entity.get_points("xyb")]
        else:
            points = [(_plane(v.dxf.location), v.dxf.get("bulge", 0.0)) for v in entity.vertices]
        points += points[:1] if entity.is_closed else []
        return [bulge(p, q, b) for (p, b), (q, _) in pairwise(points) if (p != q).any()]
    if kind == "SPLINE" and not (curve := entity.construction_tool()).is_rational and curve.is_clamped:
        return [Bezier(np.array([_plane(p) for p in points])) for points in curve.bezier_decomposition()]
    return None


def _plane(point: Any) -> np.ndarray:
    return np.array([point.x, point.y], float)
