"""Vector pictures of a pose of an animation: SVG and DXF."""

import html
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from udkjax.annotations import JsonObject
from udkjax.extras import OptionalImport
from udkjax.requirements import require_count
from udkjax.show.player.marks.mark_kinds import MarkKind
from udkjax.show.player.marks.sketch import (
    THEMES,
    TOUCHING_LAYER,
    Circle,
    ForceArrow,
    Line,
    Sketch,
    Text,
    TracedPath,
    View,
    view_of,
)
from udkjax.show.player.picture_labels import PictureLabels, Placing

DXF_LAYERS: dict[str, str] = {
    MarkKind.PIN: "joints",
    MarkKind.ROLLER: "joints",
    MarkKind.WELD: "joints",
    MarkKind.RAIL: "ground",
    MarkKind.FLOOR: "ground",
    MarkKind.RACK: "ground",
    MarkKind.SUPPORT: "ground",
    "sticking": "sticking",
}  # other layers are named by their kind


class Posed(Protocol):
    """The interface of an animation that the writers of pictures use."""

    data: JsonObject

    def pose(self, t: float | None = None) -> list[Float[np.ndarray, "bodies 3"]]:
        """Return the coordinates of each run at time t."""
        ...

    def paths(self) -> list[list[TracedPath]]:
        """Return the paths of the traced points of each run."""
        ...

    def arrows(self, t: float | None = None) -> list[list[ForceArrow]]:
        """Return the arrows of the reactions of each run at time t."""
        ...

    def sticking(self, t: float | None = None) -> list[list[list[float]]]:
        """Return the places of the joints of each run that stick at time t."""
        ...

    def touching(self, t: float | None = None) -> list[list[JsonObject]]:
        """Return the outlines of the links of each run that touch at time t."""
        ...

    def labels(self) -> list[PictureLabels]:
        """Return the names of points and the lengths of links of each run."""
        ...


def sketches(
    animation: Posed, t: float | None, width: int, theme: str, times: int = 1, labels: bool = False
) -> tuple[View, list[Sketch]]:
    """Return the view that all panels share, and the sketch of each run at time t, one for each panel.

    Args:
        animation: the animation.
        t: time (s); None for the start.
        width: total width of the panels (px).
        theme: "light" or "dark".
        times: factor by which the panels are enlarged.
        labels: True to add the names of points and the lengths of links to the sketches.
    """
    require_count("width", width)
    if theme not in THEMES:
        raise ValueError(f"theme {theme!r} must be {' or '.join(THEMES)}")
    runs = animation.data["runs"]
    view = view_of(animation.data["bounds"], width // len(runs), times, any(run["reactions"] for run in runs))
    parts = animation.paths(), animation.arrows(t), animation.sticking(t), animation.touching(t)
    shown = zip(runs, animation.pose(t), *parts, strict=True)
    found = [Sketch(run["marks"], pose, view, theme, *rest) for run, pose, *rest in shown]
    for sketch, words in zip(found, animation.labels() if labels else [], strict=labels):
        sketch.shapes += Placing(words, sketch).shapes()
    return view, found


def svg(animation: Posed, t: float | None = None, width: int = 640, theme: str = "light", labels: bool = False) -> str:
    """Return one pose of each run, side by side, as the text of an SVG picture; t is the time (s), by default the start."""
    view, panels = sketches(animation, t, width, theme, labels=labels)
    back = THEMES[theme]["back"]
    total = view.width * len(panels)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {total} {view.height}" width="{total}" height="{view.height}" '
        'stroke-linecap="round" stroke-linejoin="round">',
        f"<title>{html.escape(animation.data['title'])}</title>",
        f'<rect width="{total}" height="{view.height}" fill="{back}"/>',
    ]
    for k, sketch in enumerate(panels):
        lines += [f'<g transform="translate({k * view.width} 0)">', *(_svg(shape, back) for shape in sketch.shapes), "</g>"]
    return "\n".join([*lines, "</svg>", ""])


def _svg(shape: Line | Circle | Text, back: str) -> str:
    if isinstance(shape, Text):
        x, y = shape.place
        turn = f' transform="rotate({-shape.angle:.2f} {x:.2f} {y:.2f})"' if shape.angle else ""
        style = f'fill="{shape.colour}" stroke="{back}" stroke-width="{shape.size / 4:.2f}" paint-order="stroke"'
        font = (
            f'font-family="system-ui, sans-serif" font-size="{shape.size:.2f}" text-anchor="middle" dominant-baseline="central"'
        )
        return f'<text class="{shape.layer}" x="{x:.2f}" y="{y:.2f}" {font} {style}{turn}>{html.escape(shape.words)}</text>'
    fill = shape.fill or "none"
    style = f'fill="{fill}"' + (
        f' stroke="{shape.stroke}" stroke-width="{shape.width:.2f}"' if shape.width and shape.stroke else ""
    )
    if isinstance(shape, Circle):
        x, y = shape.centre
        return f'<circle class="{shape.layer}" cx="{x:.2f}" cy="{y:.2f}" r="{shape.radius:.2f}" {style}/>'
    points = " ".join(f"{x:.2f},{y:.2f}" for x, y in shape.points)
    return f'<{"polygon" if shape.closed else "polyline"} class="{shape.layer}" points="{points}" {style}/>'


def save_dxf(animation: Posed, path: Path, t: float | None = None, labels: bool = True) -> None:
    """Write a pose of the first run as a DXF drawing in metres, with a layer for each kind of mark; needs ezdxf (extra `dxf`).

    Names of points and dimensions of links are in the layers "names" and "dimensions".
    """
    with OptionalImport():
        from ezdxf import units
        from ezdxf.filemanagement import new
    view, panels = sketches(animation, t, 1000, "light")
    drawing = new("R2010", units=units.M)
    space = drawing.modelspace()
    if labels:
        _label(drawing, Placing(animation.labels()[0], panels[0]), view)
    for shape in panels[0].shapes:
        if isinstance(shape, Text) or shape.layer == TOUCHING_LAYER:  # an area without lines
            continue
        layer = DXF_LAYERS.get(shape.layer, f"{shape.layer}s")
        if layer not in drawing.layers:
            drawing.layers.add(layer)
        if isinstance(shape, Circle):
            space.add_circle(_metres(view, shape.centre[None])[0], shape.radius / view.scale, dxfattribs={"layer": layer})
        elif shape.layer != MarkKind.LINK or shape.fill != shape.stroke or not shape.closed:  # the fill of a link is left out
            space.add_lwpolyline(_metres(view, shape.points), close=shape.closed, dxfattribs={"layer": layer})
    drawing.saveas(path)


def _label(drawing: Any, placing: Placing, view: View) -> None:
    """Add the names of points, and the lengths of links as dimensions of the drawing."""
    space, height = drawing.modelspace(), placing.size / view.scale
    for layer in ("names", "dimensions"):
        drawing.layers.add(layer)
    from ezdxf.enums import TextEntityAlignment

    for text in placing.names:
        entity = space.add_text(text.words, height=height, dxfattribs={"layer": "names"})
        entity.set_placement(_metres(view, text.place[None])[0], align=TextEntityAlignment.MIDDLE_CENTER)
    sizes = {"dimtxt": height, "dimasz": height / 2, "dimexe": height / 3, "dimexo": height / 2, "dimgap": height / 4}
    for words, start, end, off in placing.dimensions:
        (a, b), attributes = _metres(view, np.stack([start, end])), {"layer": "dimensions"}
        dimension = space.add_aligned_dim(
            a, b, off / view.scale, text=words, override={**sizes, "dimtad": 1}, dxfattribs=attributes
        )
        dimension.render()


def _metres(view: View, points: np.ndarray) -> list[tuple[float, float]]:
    return [((x - view.x) / view.scale, (view.y - y) / view.scale) for x, y in points.tolist()]
