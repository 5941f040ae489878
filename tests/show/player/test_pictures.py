"""Pictures and films: everything is drawn in the right place."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image

import udkjax as udk
from udkjax.integrate.events.law.conditions import Gap
from udkjax.requirements import ArgumentError
from udkjax.show.player import films
from udkjax.show.player.marks.marks import marks
from udkjax.show.player.marks.sketch import THEMES, Sketch, Text, view_of
from udkjax.show.player.marks.symbols import SYMBOLS, symbols_of
from udkjax.show.player.page import module
from udkjax.show.player.picture_labels import Placing, labels_of
from udkjax.show.player.pictures import sketches

INK = np.array([int(THEMES["light"]["ink"][k : k + 2], 16) for k in (1, 3, 5)])
REACH = 7  # px around the centre of a pin that contain its ring


def ring_centre(picture, place):
    """The centroid of the ink near a pixel: the centre of a pin."""
    x, y = np.rint(place).astype(int)
    rows, columns = slice(y - REACH, y + REACH + 1), slice(x - REACH, x + REACH + 1)
    darkness = np.clip(1 - np.abs(np.asarray(picture, float)[rows, columns] - INK).max(axis=2) / 120, 0, 1)
    assert darkness.sum() > 8, "there is no pin"
    grid = np.mgrid[rows, columns]
    return np.array([(darkness * grid[1]).sum(), (darkness * grid[0]).sum()]) / darkness.sum()


@pytest.mark.parametrize("t", [0.0, 0.5125, 1.7])
def test_pins_of_a_picture_are_where_the_closed_form_says(animation, closed_form, t):
    view = view_of(animation.data["bounds"], 900)
    picture = films.image(animation, t, 900)
    pins = closed_form.pins(t)
    for name in ("P", "B"):  # O is under the arrow of its motor
        x, y = pins[name]
        expected = np.array([view.x + view.scale * x, view.y - view.scale * y])
        assert np.abs(ring_centre(picture, expected) - expected).max() < 1.2


def test_an_svg_has_its_pins_at_their_places(animation, closed_form, tmp_path):
    text = animation.save(tmp_path / "pose.svg", t=0.3, width=800).read_text()
    view = view_of(animation.data["bounds"], 800)
    found = re.findall(r'<circle class="pin" cx="([\d.]+)" cy="([\d.]+)"', text)
    places = sorted(tuple(map(float, place)) for place in found)
    expected = sorted((view.x + view.scale * x, view.y - view.scale * y) for x, y in closed_form.pins(0.3).values())
    np.testing.assert_allclose(places, expected, atol=0.02)
    assert text.startswith("<svg ") and "<title>slider-crank</title>" in text


def test_arrows_of_a_picture_are_the_reactions(tmp_path):
    """A hanging chain of 3 kg and 1 kg: its upper pin carries 4 kg, its lower pin 1 kg, upwards on the body below."""
    bodies = {"upper": udk.Body(3.0, 0.1, position=[0.0, -0.5]), "lower": udk.Body(1.0, 0.1, position=[0.0, -1.5])}
    ends = [[0.0, -0.5], [0.0, 0.5]]
    joints = {"A": udk.Revolute(["ground", "upper"], [[0.0, 0.0], ends[1]]), "B": udk.Revolute(["upper", "lower"], ends)}
    chain = udk.Mechanism(bodies, joints)
    shown = udk.animate(chain, udk.simulate(chain, np.linspace(0.0, 1.0, 11)), measures=(), reactions=True)
    view = view_of(shown.data["bounds"], 640, has_arrows=True)
    for t in (0.0, 0.55):
        text = shown.save(tmp_path / "pose.svg", t=t).read_text()
        heads = [
            np.array(re.findall(r"([\d.]+),([\d.]+)", head), float)
            for head in re.findall('<polygon class="reaction".*?"([^"]*)"', text)
        ]
        assert len(heads) == 2
        for head, pin, force in zip(heads, (0.0, -1.0), (4.0, 1.0), strict=True):
            tip = [view.x, view.y - view.scale * pin - 70.0 * view.pt * force / 4.0]
            np.testing.assert_allclose(head[0], tip, atol=0.05)
            assert 0 < tip[1] < view.height
    dark = np.asarray(films.image(shown, 0.0, 640, "dark"), float)
    force = [int(THEMES["dark"]["force"][k : k + 2], 16) for k in (1, 3, 5)]
    assert (np.abs(dark - force).max(axis=2) < 20).sum() > 50
    plain = udk.animate(chain, udk.simulate(chain, [0.0, 1.0]), measures=()).save(tmp_path / "plain.svg").read_text()
    assert "reaction" not in plain


def test_texts_of_an_svg_are_texts(hostile, tmp_path):
    text = udk.animate(hostile.mechanism, measures=()).save(tmp_path / "pose.svg").read_text()
    assert "<script" not in text and "&lt;/script&gt;" in text


@pytest.mark.parametrize(("fps", "speed", "frames", "duration"), [(10, 0.5, 40, 100), (30, 4.0, 17, 30), (60, 4.0, 25, 20)])
def test_a_gif_moves_as_long_as_the_run(animation, tmp_path, fps, speed, frames, duration):
    """Frames last whole hundredths of a second, and at least two: 30 a second become 33, 60 become 50."""
    path = animation.save(tmp_path / "motion.gif", fps=fps, width=200, speed=speed)
    with Image.open(path) as film:
        assert getattr(film, "n_frames", 1) == frames and film.info["duration"] == duration and film.info["loop"] == 0
        first = np.asarray(film.convert("RGB"), float)
        film.seek(10)
        later = np.asarray(film.convert("RGB"), float)
    assert np.abs(first - later).max() > 50
    assert (later[0] == 255).all()  # the background is as white as a page
    with pytest.raises(ValueError, match="more than 1500: give a higher speed"):
        animation.save(tmp_path / "motion.gif", speed=0.001)


def test_frames_are_of_times_from_the_start_of_the_run(linkage):
    run = udk.simulate(linkage, np.linspace(2.0, 3.0, 11))
    shown = udk.animate(linkage, run, measures=())
    np.testing.assert_allclose(films.film_times(shown, 10.0, 0.5), 2.0 + 0.05 * np.arange(20))


def test_an_mp4_is_a_film(animation, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed: pip install '.[video]'")
    path = animation.save(tmp_path / "motion.mp4", fps=5, width=160)
    assert path.read_bytes()[4:8] == b"ftyp" and path.stat().st_size > 1000


def test_a_dxf_is_in_metres_in_layers(animation, closed_form, tmp_path):
    ezdxf = pytest.importorskip("ezdxf", reason="ezdxf is not installed: pip install '.[dxf]'")
    drawing = ezdxf.readfile(animation.save(tmp_path / "pose.dxf", t=0.3))
    space = drawing.modelspace()
    places = sorted((c.dxf.center.x, c.dxf.center.y) for c in space.query('CIRCLE[layer=="joints"]'))
    np.testing.assert_allclose(places, sorted(closed_form.pins(0.3).values()), atol=2e-5)
    scale = view_of(animation.data["bounds"], 1000).scale
    text = animation.save(tmp_path / "pose.svg", t=0.3, width=1000).read_text()
    sizes = sorted(float(r) / scale for r in re.findall(r'<circle class="pin" [^>]*?\br="([\d.]+)"', text))
    np.testing.assert_allclose(sorted(c.dxf.radius for c in space.query('CIRCLE[layer=="joints"]')), sizes, rtol=1e-3)
    assert {"links", "joints", "ground", "motors", "blocks"} <= {layer.dxf.name for layer in drawing.layers}
    paths = space.query('LWPOLYLINE[layer=="paths"]')
    assert_paths_of_slider_crank([np.array([point[:2] for point in path.get_points()]) for path in paths], 1e-4)


@pytest.fixture(scope="module")
def four_bar():
    pins = {"O": [0, 0], "A": udk.polar("O", 40, 60), "C": [100, 0], "B": udk.circles(["A", "C"], [120, 80], "left")}
    links = {name: {"pins": [*ends], "mass": 1} for name, ends in {"crank": "OA", "coupler": "AB", "rocker": "CB"}.items()}
    return udk.Drawing(pins, links, ["O", "C"], units={"length": "mm", "angle": "deg"}, name="a < b").mechanism()


def test_names_and_lengths_are_written(four_bar, tmp_path):
    shown = udk.animate(four_bar, measures=())
    texts = re.findall(r"<text [^>]*>([^<]*)</text>", shown.save(tmp_path / "pose.svg", labels=True).read_text())
    assert sorted(texts) == ["100 mm", "120 mm", "40 mm", "80 mm", "A", "B", "C", "O"]
    assert "<text" not in shown.save(tmp_path / "plain.svg").read_text()
    plain, labelled = (np.asarray(films.image(shown, labels=on), float) for on in (False, True))
    assert (np.abs(plain - labelled).max(axis=2) > 100).sum() > 300


def test_texts_of_a_picture_cover_no_pin_and_no_other_text(four_bar):
    _, (sketch,) = sketches(udk.animate(four_bar, measures=()), None, 640, "light")
    placing = Placing(labels_of(four_bar, []), sketch)
    centres = np.array([middle for middle, *_ in placing.texts.boxes])
    apart = np.linalg.norm(centres[:, None] - centres, axis=2) + 99 * np.eye(len(centres))
    assert apart.min() > 10 * placing.pt
    low, high = centres.min(axis=0), centres.max(axis=0)
    assert (low > 0).all() and (high < [sketch.view.width, sketch.view.height]).all()


def test_lengths_are_dimensions_of_a_dxf(four_bar, tmp_path):
    ezdxf = pytest.importorskip("ezdxf", reason="ezdxf is not installed: pip install '.[dxf]'")
    space = ezdxf.readfile(udk.animate(four_bar, measures=()).save(tmp_path / "pose.dxf")).modelspace()
    lengths = {d.dxf.text: d.get_measurement() for d in space.query('DIMENSION[layer=="dimensions"]')}
    expected = {"40 mm": 0.04, "80 mm": 0.08, "100 mm": 0.1, "120 mm": 0.12}
    assert lengths == pytest.approx(expected, rel=2e-5)  # positions of a page are rounded to 1e-5
    assert sorted(t.dxf.text for t in space.query('TEXT[layer=="names"]')) == ["A", "B", "C", "O"]


def meshing(teeth, internal):
    """A pair of drawn wheels: their marks, and the frames in which they are drawn."""
    pins, wheels = {"O": [0, 0], "C": [60 if not internal else 20, 0]}, {"a": "O", "b": "C"}
    links = {name: {"pins": [pin], "mass": 1, "width": 10} for name, pin in wheels.items()}
    gears = [{"links": ["a", "b"], "teeth": teeth, "internal": internal}]
    mech = udk.Drawing(pins, links, ["O", "C"], gears=gears, units={"length": "mm"}).mechanism()
    return [mark for mark in marks(mech, mech.q0[None]) if mark["kind"] == "wheel"]


@pytest.mark.parametrize(("teeth", "internal"), [([20, 40], False), ([17, 31], False), ([40, 20], True)])
def test_wheels_have_their_teeth_which_mesh(teeth, internal):
    """On the line of centres, a tooth of one wheel stands in a gap of the other one: tooth and gap are half a pitch apart."""
    first, second = sorted(meshing(teeth, internal), key=lambda mark: mark["body"])
    assert [first["teeth"], second["teeth"]] == teeth
    for wheel in (first, second):
        outlines = [s["points"] for s in symbols_of([wheel], 1e-3) if s.get("closed")]
        assert len(outlines[-1]) == 5 * wheel["teeth"]
    towards = 0.0 if internal else np.pi
    shares = [(angle - w["phase"]) * w["teeth"] / (2 * np.pi) for w, angle in ((first, 0.0), (second, towards))]
    apart = shares[0] - shares[1] if internal else shares[0] + shares[1] - 0.5
    assert abs(apart - round(apart)) < 1e-9


def painted_by_script(symbols, pose, view, folder):
    """Symbols as painted by the player's script: points or a centre, a radius, stroke and fill of each."""
    if (node := shutil.which("node")) is None:
        pytest.skip("there is no node")
    script = """
        class Recorder extends SymbolPainter {
          line(points, width, stroke, {fill}) { this.painted.push([points, 0, stroke ?? "", fill ?? ""]); }
          circle(centre, radius, {stroke, fill}) { this.painted.push([centre, radius, stroke ?? "", fill ?? ""]); }
        }
        const painter = Object.assign(new Recorder({}, VIEW, THEMES.light, VIEW.pt, POSE), {painted: []});
        painter.draw(SYMBOLS);
        console.log(JSON.stringify(painter.painted));
    """
    for name, value in {"VIEW": view._asdict(), "POSE": pose.ravel().tolist(), "SYMBOLS": symbols}.items():
        script = script.replace(name, json.dumps(value))
    (folder / "script.mjs").write_text(module() + script, encoding="utf-8")
    return json.loads(subprocess.run([node, folder / "script.mjs"], capture_output=True, text=True, check=True).stdout)


def test_every_kind_of_mark_is_drawn(tmp_path):
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    B, names = udk.Body, ("cam", "follower", "pinion", "rack", "free", "plate")
    spots = ((0, 0), (0, 0.5), (1.5, 0.2), (1.5, 0), (2.7, 0.6), (2.6, 0))
    mech = udk.Mechanism(
        {name: B(1, 0.1, spot) for name, spot in zip(names, spots, strict=True)},
        {
            "c": udk.Cam(("cam", "follower"), [(0, 0), (0, 0)], udk.Profile(angle, 0.5 + 0.1 * np.cos(angle))),
            "o": udk.Revolute(("ground", "cam"), [(0, 0), (0, 0)]),
            "way": udk.Prismatic(("ground", "rack"), [(1.5, 0), (0, 0)], 0.0),
            "slot": udk.Slot(("ground", "plate"), [(2.6, 0.2), (0, 0.2)], 0.5),
            "rack": udk.Rack(("rack", "pinion"), 0.2, 0.0),
            "rod": udk.Distance(("ground", "plate"), [(2.6, 0.5), (0, 0.2)]),
            "weld": udk.Weld(("plate", "free"), [(0.1, 0.2), (0.0, -0.4)]),
            "gear": udk.Gear(("cam", "pinion"), (0.4, 0.2)),
        },
        {
            "m": udk.Driver(("ground", "cam"), "angle", udk.Polynomial([0, 2.0])),
            "d": udk.Driver(("ground", "free"), "distance", udk.Polynomial([1.0]), [(3, 1), (0, 0)]),
        },
        [
            udk.TorsionSpring(("ground", "plate"), 1.0),
            udk.Spring(("ground", "plate"), [(3.2, 0.6), (0.1, -0.1)], 20.0, 0.5, 1.0),
            udk.Force("plate", (3.0, 1.0), frame="body"),
            udk.Friction("o", 0.1, 0.1),
            udk.Torque(("ground", "pinion"), udk.Held([-1.0, 1.0], 0.1)),
        ],
    )
    (contact,) = udk.Contact("free").expand(mech)
    assert isinstance(contact.condition, Gap)
    every = marks(mech, mech.q0[None], gaps=[contact.condition], targets=[(1.0, 2.0)], traced=[[5, 0.05, -0.3]])
    found = {mark["kind"] for mark in every}
    assert found == SYMBOLS.keys()
    view = view_of((-1, -1, 4, 2), 600)
    sketch = Sketch(every, np.asarray(mech.q0), view)
    assert {shape.layer for shape in sketch.shapes} == found
    assert all(np.isfinite(shape[1]).all() for shape in sketch.shapes)  # points or centre
    painted = painted_by_script(symbols_of(every, view.pt / view.scale), np.asarray(mech.q0), view, tmp_path)
    for shape, (points, radius, *look) in zip(sketch.shapes, painted, strict=True):
        assert not isinstance(shape, Text)
        np.testing.assert_allclose(points, shape[1], atol=1e-6)
        assert look == [shape.stroke, shape.fill] and radius == pytest.approx(getattr(shape, "radius", 0.0))


def test_wrong_names_and_themes(animation, tmp_path):
    with pytest.raises(ValueError, match=r"motion.bmp: the suffix must be .html, .gif"):
        animation.save(tmp_path / "motion.bmp")
    with pytest.raises(ValueError, match="theme 'blue'"):
        animation.save(tmp_path / "pose.png", theme="blue")


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("motion.gif", {"fps": 0}, "fps must be positive"),
        ("motion.gif", {"speed": np.nan}, "speed must be positive"),
        ("motion.mp4", {"fps": -1}, "fps must be positive"),
        ("motion.gif", {"width": 0}, "width must be at least 1"),
        ("pose.png", {"width": 0}, "width must be at least 1"),
        ("pose.svg", {"width": -5}, "width must be at least 1"),
        ("pose.svg", {"t": 1e3}, "t must be a time of the motion, from 0 to 2 s, not 1000 s"),
        ("pose.png", {"t": -0.1}, "t must be a time of the motion"),
        ("pose.dxf", {"t": np.nan}, "t must be a time of the motion"),
    ],
)
def test_sizes_and_times_that_cannot_be_drawn_are_refused_by_name(animation, tmp_path, name, given, message):
    with pytest.raises(ArgumentError, match=message):
        animation.save(tmp_path / name, **given)


def assert_paths_of_slider_crank(paths, atol):
    """Require that the crank pin moves on a circle, and the wrist pin back and forth on a line (m)."""
    line, circle = sorted(paths, key=lambda path: np.ptp(path[:, 1]))
    np.testing.assert_allclose(np.hypot(*circle.T), 0.5, atol=atol)
    np.testing.assert_allclose([circle.min(axis=0), circle.max(axis=0)], [[-0.5, -0.5], [0.5, 0.5]], atol=1e-3)
    np.testing.assert_allclose(line[:, 1], 0.0, atol=atol)
    np.testing.assert_allclose([line[:, 0].min(), line[:, 0].max()], [1.0, 2.0], atol=1e-3)


def test_paths_are_those_of_the_closed_form(animation, run, slider_crank, tmp_path):
    text = animation.save(tmp_path / "pose.svg", t=0.3, width=800).read_text()
    view = view_of(animation.data["bounds"], 800)
    found = re.findall(r'"path" points="([^"]+)"', text)
    pixels = [np.array([pair.split(",") for pair in points.split()], float) for points in found]
    assert_paths_of_slider_crank([(p - [view.x, view.y]) * [1, -1] / view.scale for p in pixels], 0.02 / view.scale)
    plain = udk.animate(slider_crank, run, traces=[], measures=()).save(tmp_path / "plain.svg").read_text()
    assert '"path"' not in plain


def test_a_path_is_painted(animation, closed_form):
    view = view_of(animation.data["bounds"], 900)
    x, y = closed_form.pins(1.0)["P"]
    place = round(view.x + view.scale * x), round(view.y - view.scale * y)
    assert films.image(animation, 0.0, 900).getpixel(place) != (255, 255, 255)
