"""Animations in pixels: PNG of a pose, GIF and MP4 of the motion."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from udkjax.extras import OptionalImport
from udkjax.requirements import ArgumentError, require_number
from udkjax.show.player.marks.sketch import THEMES, Circle, Line, Text
from udkjax.show.player.pictures import Posed, sketches

with OptionalImport():
    from PIL import Image, ImageDraw, ImageFont

OVERSAMPLING = 3  # factor by which pictures are drawn larger and then reduced, to smooth edges
MOST_FRAMES = 1500  # largest number of frames of a film
SAME_COLOUR = 8  # largest difference (of 255) of colours that count as the background
GIF_TICK = 0.01  # unit of a GIF's frame times (s)


def image(animation: Posed, t: float | None = None, width: int = 640, theme: str = "light", labels: bool = False) -> Image.Image:
    """Return one pose of each run, side by side, as a bitmap of about `width` px; t is the time (s), by default the start."""
    view, sketches_at_t = sketches(animation, t, width, theme, OVERSAMPLING, labels)
    large = Image.new("RGB", (view.width * len(sketches_at_t), view.height), THEMES[theme]["back"])
    for k, sketch in enumerate(sketches_at_t):
        panel = Image.new("RGB", (view.width, view.height), THEMES[theme]["back"])
        draw = ImageDraw.Draw(panel)
        for shape in sketch.shapes:
            if isinstance(shape, Text):
                _write(panel, shape, THEMES[theme]["back"])
            else:
                _paint(draw, shape)
        large.paste(panel, (k * view.width, 0))
    small = large.width // OVERSAMPLING // 2 * 2, large.height // OVERSAMPLING // 2 * 2  # MP4 needs even sizes
    return large.resize(small, Image.Resampling.LANCZOS)


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


def _write(panel: Image.Image, text: Text, back: str) -> None:
    """Write a text with a rim in the colour of the background, so that it stands out from the lines that it covers."""
    font, rim = ImageFont.load_default(text.size), round(text.size / 8)
    left, top, right, bottom = font.getbbox(text.words, anchor="mm", stroke_width=rim)
    half = int(np.hypot(max(-left, right), max(-top, bottom))) + 1
    for colour, width in ((back, rim), (text.colour, 0)):
        mask = Image.new("L", (2 * half, 2 * half), 0)
        ImageDraw.Draw(mask).text((half, half), text.words, 255, font, anchor="mm", stroke_width=width)
        mask = mask.rotate(text.angle, Image.Resampling.BICUBIC)
        x, y = (round(float(c)) - half for c in text.place)
        panel.paste(Image.new("RGB", mask.size, colour), (x, y), mask)


def film_times(animation: Posed, fps: float, speed: float | None) -> np.ndarray:
    """Return the time (s) of the motion at each frame; `speed` is that of the player by default.

    Raises:
        ArgumentError: the film would be too long, or `fps` or `speed` is not positive.
    """
    data = animation.data
    speed = float(data["speed"] if speed is None else speed)
    for name, value in (("fps", fps), ("speed", speed)):
        require_number(name, value, "positive")
    count = max(1, round((data["end"] - data["start"]) / speed * fps))
    if count > MOST_FRAMES:
        raise ArgumentError(
            f"{count} frames are more than {MOST_FRAMES}: give a higher speed than {speed:g}, or fewer fps than {fps:g}"
        )
    return data["start"] + speed / fps * np.arange(count)


def save_gif(
    animation: Posed, path: Path, fps: float = 25.0, width: int = 480, theme: str = "light", speed: float | None = None
) -> None:
    """Write the motion as a GIF that repeats forever; `fps` is rounded to 100 divided by an integer, the resolution of GIFs."""
    require_number("fps", fps, "positive")
    tick = max(2, round(1 / fps / GIF_TICK))  # browsers play faster GIFs slowly
    times = film_times(animation, 1 / (tick * GIF_TICK), speed)
    palette = _palette(image(animation, times[0], width, theme))  # the same for all frames, to avoid flicker
    frames = [image(animation, t, width, theme).quantize(palette=palette, dither=Image.Dither.NONE) for t in times]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=10 * tick, loop=0, optimize=True)


def _palette(picture: Image.Image) -> Image.Image:
    """Return a picture in 64 colours; colours that look like its background become exactly the background."""
    reduced = picture.quantize(64)
    colours, back = np.reshape(reduced.getpalette(), (-1, 3)), np.array(picture.getpixel((0, 0)))
    colours[np.abs(colours - back).max(axis=1) <= SAME_COLOUR] = back
    reduced.putpalette(colours.ravel().tolist())
    return reduced


def save_mp4(
    animation: Posed, path: Path, fps: float = 30.0, width: int = 960, theme: str = "light", speed: float | None = None
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


def _frames(animation: Posed, times: np.ndarray, width: int, theme: str) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    for t in times:
        yield np.asarray(image(animation, float(t), width, theme))
