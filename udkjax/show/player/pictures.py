"""Animations as pictures and films: SVG, PNG and DXF of a pose, GIF and MP4 of the motion."""

import html
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from udkjax.extras import OptionalImport
from udkjax.show.player.sketch import THEMES, Circle, Line, Sketch, View, view_of

with OptionalImport():
    from PIL import Image, ImageDraw

SMOOTH = 3  # times: a picture of pixels is drawn so much larger, and made smaller
MOST_FRAMES = 1500  # of a film
GIF_TICK = 0.01  # s: what a GIF counts the time of a frame in
DXF_LAYERS = {
    "pin": "joints",
    "roller": "joints",
    "weld": "joints",
    "rail": "ground",
    "rack": "ground",
    "support": "ground",
}  # others: by their kind


def sketches(animation: Any, t: float | None, width: int, theme: str, times: int = 1) -> tuple[View, list[Sketch]]:
    """Return the view of each panel, `width` over all and so many times as large, and the sketch of each run at time t."""
    if theme not in THEMES:
        raise ValueError(f"theme {theme!r} is neither of {', '.join(THEMES)}")
    runs = animation.data["runs"]
    view = view_of(animation.data["bounds"], width // len(runs), times)
    return view, [Sketch(run["marks"], pose, view, theme) for run, pose in zip(runs, animation.pose(t), strict=True)]


def svg(animation: Any, t: float | None = None, width: int = 640, theme: str = "light") -> str:
    """Return one pose of each run, side by side, as the text of an SVG picture."""
    view, found = sketches(animation, t, width, theme)
    whole = view.width * len(found)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {whole} {view.height}" width="{whole}" height="{view.height}" '
        'stroke-linecap="round" stroke-linejoin="round">',
        f"<title>{html.escape(animation.data['title'])}</title>",
        f'<rect width="{whole}" height="{view.height}" fill="{THEMES[theme]["back"]}"/>',
    ]
    for k, sketch in enumerate(found):
        lines += [f'<g transform="translate({k * view.width} 0)">', *map(_svg, sketch.shapes), "</g>"]
    return "\n".join([*lines, "</svg>", ""])


def _svg(shape: Line | Circle) -> str:
    fill = shape.fill or "none"
    style = f'fill="{fill}"' + (
        f' stroke="{shape.stroke}" stroke-width="{shape.width:.2f}"' if shape.width and shape.stroke else ""
    )
    if isinstance(shape, Circle):
        x, y = shape.centre
        return f'<circle class="{shape.layer}" cx="{x:.2f}" cy="{y:.2f}" r="{shape.radius:.2f}" {style}/>'
    points = " ".join(f"{x:.2f},{y:.2f}" for x, y in shape.points)
    return f'<{"polygon" if shape.closed else "polyline"} class="{shape.layer}" points="{points}" {style}/>'


def image(animation: Any, t: float | None = None, width: int = 640, theme: str = "light") -> Image.Image:
    """Return one pose of each run, side by side, as a picture of pixels."""
    view, found = sketches(animation, t, width, theme, SMOOTH)
    whole = Image.new("RGB", (view.width * len(found), view.height), THEMES[theme]["back"])
    for k, sketch in enumerate(found):
        panel = Image.new("RGB", (view.width, view.height), THEMES[theme]["back"])
        draw = ImageDraw.Draw(panel)
        for shape in sketch.shapes:
            _paint(draw, shape)
        whole.paste(panel, (k * view.width, 0))
    small = whole.width // SMOOTH // 2 * 2, whole.height // SMOOTH // 2 * 2  # MP4 wants even numbers
    return whole.resize(small, Image.Resampling.LANCZOS)


def _paint(draw: ImageDraw.ImageDraw, shape: Line | Circle) -> None:
    width = round(shape.width)
    if isinstance(shape, Circle):
        (x, y), r = shape.centre, shape.radius + (shape.width / 2 if shape.stroke else 0)
        draw.ellipse((x - r, y - r, x + r, y + r), shape.fill or None, shape.stroke or None, width if shape.stroke else 0)
        return
    points = [(float(x), float(y)) for x, y in shape.points]
    if shape.fill:
        draw.polygon(points, shape.fill)
    if shape.stroke and width:
        draw.line([*points, points[0]] if shape.closed else points, shape.stroke, width, joint="curve")
        for x, y in points:  # round ends and corners
            r = width / 2 - 0.5
            draw.ellipse((x - r, y - r, x + r, y + r), shape.stroke)


def film_times(animation: Any, fps: float, speed: float | None) -> np.ndarray:
    """Return the time on the timeline of each frame; a film that would be too long is refused."""
    data = animation.data
    speed = float(data["speed"] if speed is None else speed)
    if not (0 < fps < np.inf and 0 < speed < np.inf):
        raise ValueError(f"fps {fps:g} and speed {speed:g} must be positive")
    count = max(1, round((data["end"] - data["start"]) / speed * fps))
    if count > MOST_FRAMES:
        raise ValueError(
            f"{count} frames are more than {MOST_FRAMES}: give a higher speed than {speed:g}, or fewer fps than {fps:g}"
        )
    return data["start"] + speed / fps * np.arange(count)


def save_gif(
    animation: Any, path: Path, fps: float = 25.0, width: int = 480, theme: str = "light", speed: float | None = None
) -> None:
    """Write the motion as a GIF that repeats for ever. It counts in hundredths of a second: fps is 100 over a whole number."""
    tick = max(2, round(1 / fps / GIF_TICK))  # browsers slow down what is faster
    times = film_times(animation, 1 / (tick * GIF_TICK), speed)
    palette = image(animation, times[0], width, theme).quantize(64)  # one for all frames, so that nothing flickers
    frames = [image(animation, t, width, theme).quantize(palette=palette, dither=Image.Dither.NONE) for t in times]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=10 * tick, loop=0, optimize=True)


def save_mp4(
    animation: Any, path: Path, fps: float = 30.0, width: int = 960, theme: str = "light", speed: float | None = None
) -> None:
    """Write the motion as an H.264 film; needs the extra `video` (imageio-ffmpeg)."""
    with OptionalImport():
        import imageio_ffmpeg
    frames = _frames(animation, film_times(animation, fps, speed), width, theme)
    first = next(frames)
    size = first.shape[1], first.shape[0]
    film = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=fps,  # pyright: ignore[reportArgumentType]
        macro_block_size=2,
        quality=7,
        output_params=["-movflags", "+faststart"],
    )
    film.send(None)
    film.send(first.tobytes())
    for frame in frames:
        film.send(frame.tobytes())
    film.close()


def _frames(animation: Any, times: np.ndarray, width: int, theme: str) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    for t in times:
        yield np.asarray(image(animation, float(t), width, theme))


def save_dxf(animation: Any, path: Path, t: float | None = None) -> None:
    """Write one pose of the first run as a DXF drawing in metres, a layer for each kind of mark; needs ezdxf (extra `dxf`)."""
    with OptionalImport():
        from ezdxf import units
        from ezdxf.filemanagement import new
    view, found = sketches(animation, t, 1000, "light")
    drawing = new("R2010", units=units.M)
    space = drawing.modelspace()
    for shape in found[0].shapes:
        layer = DXF_LAYERS.get(shape.layer, f"{shape.layer}s")
        if layer not in drawing.layers:
            drawing.layers.add(layer)
        if isinstance(shape, Circle):
            space.add_circle(_metres(view, shape.centre[None])[0], shape.radius / view.scale, dxfattribs={"layer": layer})
        elif shape.layer != "link" or shape.fill != shape.stroke or not shape.closed:  # the filling of a link is no line of it
            space.add_lwpolyline(_metres(view, shape.points), close=shape.closed, dxfattribs={"layer": layer})
    drawing.saveas(path)


def _metres(view: View, points: np.ndarray) -> list[tuple[float, float]]:
    return [((x - view.x) / view.scale, (view.y - y) / view.scale) for x, y in points.tolist()]
