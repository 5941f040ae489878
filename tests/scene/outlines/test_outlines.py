"""Outlines from DXF files: areas, centroids and inertias against closed forms, pins from circles, and mistakes by name."""

import numpy as np
import pytest

pytest.importorskip("experiments", reason="not in a source tree")
pytest.importorskip("ezdxf")

import udkjax as udk
from experiments.parts.outline_profiles import add_slot, combined, disc, document, profile, slot

MM = 1e-3


def drawing_of(mechanism: udk.Mechanism) -> udk.Drawing:
    assert isinstance(mechanism.drawing, udk.Drawing)
    return mechanism.drawing


def read(file, tmp_path, **options):
    file.saveas(tmp_path / "link.dxf")
    return udk.read_outline(tmp_path / "link.dxf", **options)


@pytest.mark.parametrize("seed", range(20))
def test_areas_centroids_and_inertias_are_those_of_closed_forms(seed, tmp_path):
    wanted = profile(seed)
    found = read(wanted.file, tmp_path)
    assert max(wanted.errors(found)) < 1e-12
    assert len(found.holes) == 3 and len(found.circles) == 2
    want = sorted(zip(wanted.places, wanted.radii, strict=True), key=lambda x: tuple(x[0]))
    for circle, (place, radius) in zip(found.circles, want, strict=True):
        np.testing.assert_allclose([*circle.centre, circle.radius], np.array([*place, radius]) * MM, rtol=1e-12)
    assert "round hole" in repr(found)


def test_a_spline_has_the_area_of_its_polynomials(tmp_path):
    """Under x = 3 t^2 - 2 t^3, y = 3 t (1 - t) the area is the integral of y dx/dt = 18 t^2 (1 - t)^2, 0.6."""
    file, space = document(6)
    space.add_open_spline([(0, 0), (0, 1), (1, 1), (1, 0)])
    space.add_line((0, 0), (1, 0))
    found = read(file, tmp_path)
    assert found.area == pytest.approx(0.6, rel=1e-13) and found.centroid[0] == pytest.approx(0.5, rel=1e-13)
    polygon = found.polygon(1e-4)
    x, y = polygon.T
    assert 0 < 0.6 - abs(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) < 2e-4


def test_a_link_has_the_mass_of_its_outline_and_its_gaps(tmp_path):
    file, space = document()
    add_slot(space, 100.0, 10.0, (50.0, 0.0), 0.0, True, None)
    for x in (0.0, 100.0):
        space.add_circle((x, 0.0), 3.0)
    outline = read(file, tmp_path)
    pins = {"O": outline.circles[0].centre, "A": outline.circles[1].centre, "D": [0.2, 0.05]}
    links = {
        "arm": outline.link(["O", "A"], density=7850, thickness=0.005, chord=1e-7),
        "wheel": udk.Link(["D"], mass=1, width=0.1),
    }
    motors = {name: {"pin": pin, "speed": 1.0} for name, pin in (("motor", "O"), ("other", "D"))}
    mech = udk.Drawing(pins=pins, links=links, ground=["O", "D"], motors=motors).mechanism()
    area, _, square = combined([(1, slot(100, 10, (50, 0), 0)), (-1, disc(3, (0, 0))), (-1, disc(3, (100, 0)))])
    mass = 7850 * 0.005 * area * MM**2
    assert float(mech.bodies["arm"].mass) == pytest.approx(mass, rel=1e-12)
    assert float(mech.bodies["arm"].inertia) == pytest.approx(mass * square * MM**2, rel=1e-12)
    gap = udk.gaps(mech, "motor", values=[0, 2 * np.pi]).least.distance
    assert gap == pytest.approx(np.hypot(0.2, 0.05) - 0.1 - 0.01 - 0.05, abs=2e-7)


def open_contour(space):
    space.add_line((0, 0), (10, 0))
    space.add_line((10, 0), (10, 5))
    space.add_line((10, 5.2), (0, 0))


def branching(space):
    space.add_lwpolyline([(0, 0), (10, 0), (10, 5)])
    space.add_line((10, 5), (0, 0))
    space.add_line((10, 5), (5, 8))


MISTAKES = {
    "open": (open_contour, {}, r"contour 1 \(LINE in layer '0'\) is open at \(10, 5\) mm: the nearest other end is 0.2 mm away"),
    "branch": (branching, {}, r"contour 1 .* branches at \(10, 5\) mm, where 3 ends meet"),
    "bow": (lambda s: s.add_lwpolyline([(0, 0), (10, 10), (10, 0), (0, 10)], close=True), {}, r"crosses itself at \(5, 5\) mm"),
    "crossing": (lambda s: [s.add_circle((x, 0), 5) for x in (0, 6)], {}, r"contour 1 .* and contour 2 .* cross at \(2\.99"),
    "apart": (lambda s: [s.add_circle((0, 0), 5), s.add_circle((20, 0), 2)], {}, "contour 2 .* lies outside of contour 1"),
    "island": (
        lambda s: [s.add_circle((0, 0), r) for r in (5, 3, 1)],
        {},
        "contour 3 .* lies within a hole: a link is one piece",
    ),
    "empty": (lambda s: s.add_text("link"), {}, "there are no lines, arcs or other curves"),
    "layer": (lambda s: s.add_circle((0, 0), 5), {"layers": ["cut"]}, r"in the layers \['cut'\]"),
    "unit": (lambda s: s.add_circle((0, 0), 5), {"unit": "in"}, 'the file\'s unit is "mm", not "in"'),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_name_the_contour_and_the_place(case, tmp_path):
    draw, options, message = MISTAKES[case]
    file, space = document()
    draw(space)
    with pytest.raises(udk.SceneError, match=message):
        read(file, tmp_path, **options)


def test_a_file_without_unit_is_asked_for_it(tmp_path):
    file, space = document(0)
    space.add_circle((0, 0), 5)
    with pytest.raises(udk.SceneError, match='no unit of length; give it, unit="mm"'):
        read(file, tmp_path)
    assert read(file, tmp_path, unit="in").area == pytest.approx(np.pi * (5 * 0.0254) ** 2, rel=1e-13)
    with pytest.raises(udk.SceneError, match="unit: "):
        read(file, tmp_path, unit="kg")
    with pytest.raises(udk.SceneError, match=r"must be a file \.dxf or \.svg"):
        udk.read_outline(tmp_path / "link.step")
    (tmp_path / "damaged.dxf").write_text("0\nSECTION\n2\nHEADER\nnonsense\n")
    with pytest.raises(udk.SceneError, match="not a DXF file that can be read"):
        udk.read_outline(tmp_path / "damaged.dxf")


def svg(tmp_path, body, size='width="200mm" height="100mm" viewBox="0 0 200 100"', **options):
    pytest.importorskip("svgelements")
    (tmp_path / "link.svg").write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{body}</svg>')
    return udk.read_outline(tmp_path / "link.svg", **options)


def test_svg_files_have_the_areas_of_closed_forms(tmp_path):
    bar = '<path d="M20,30 h100 a20,20 0 0 1 0,40 h-100 a20 20 0 0 1 0,-40 z"/>'
    holes = '<circle cx="20" cy="50" r="5"/><circle cx="120" cy="50" r="8"/><ellipse cx="70" cy="45" rx="10" ry="4"/>'
    found = svg(tmp_path, f'<g transform="rotate(30 50 50) translate(3 4)">{bar}{holes}</g>')
    turn = np.array([[np.cos(np.pi / 6), -np.sin(np.pi / 6)], [np.sin(np.pi / 6), np.cos(np.pi / 6)]])
    at = lambda x, y: (np.array([50, 50]) + turn @ (np.array([x + 3, y + 4]) - 50)) * [1, -1]  # noqa: E731
    area, centre, square = combined(
        [(1, slot(100, 20, at(70, 50), 0)), (-1, disc(5, at(20, 50))), (-1, disc(8, at(120, 50)))]
        + [(-1, (np.pi * 40, at(70, 45), (10**2 + 4**2) / 4))]
    )
    assert found.area == pytest.approx(area * MM**2, rel=1e-12) and found.square_radius == pytest.approx(
        square * MM**2, rel=1e-12
    )
    np.testing.assert_allclose(found.centroid, centre * MM, rtol=1e-12)
    np.testing.assert_allclose([c.centre for c in found.circles], [at(20, 50) * MM, at(120, 50) * MM], rtol=1e-11)
    curve = svg(tmp_path, '<path d="M0,0 C0,1 1,1 1,0 z"/>', "", unit="m")
    assert curve.area == pytest.approx(0.6, rel=1e-13) and curve.centroid[1] < 0
    half = svg(tmp_path, '<path d="M0,0 Q1,2 2,0 z"/>', "", unit="m")
    assert half.area == pytest.approx(4 / 3, rel=1e-13)


@pytest.mark.parametrize("centre", [50, 55])
def test_a_circle_of_svg_may_have_a_circle_as_its_hole(tmp_path, centre):
    """Each circle of a file ends with a line whose length is rounding, which is no contour."""
    found = svg(tmp_path, f'<circle cx="50" cy="50" r="30"/><circle cx="{centre}" cy="50" r="10"/>')
    assert len(found.holes) == 1
    assert found.area == pytest.approx(np.pi * (0.03**2 - 0.01**2), rel=1e-12)
    assert found.circles[0].radius == pytest.approx(0.01, rel=1e-12)


def test_mistakes_in_svg_files_are_named(tmp_path):
    with pytest.raises(udk.SceneError, match='no unit of length; give it, unit="mm"'):
        svg(tmp_path, '<circle r="5"/>', 'width="200" height="100"')
    with pytest.raises(udk.SceneError, match=r"contour 1 \(path 'arm'\) is open at \(10, -5\) mm"):
        svg(tmp_path, '<path id="arm" d="M0,0 L10,0 L10,5"/>')
    with pytest.raises(udk.SceneError, match="layers: those of a DXF file"):
        svg(tmp_path, '<circle r="5"/>', layers=["cut"])
    with pytest.raises(udk.SceneError, match="not an SVG file that can be read"):
        svg(tmp_path, "<circle")


SCENE = """format = 2
units = {length = "mm"}
ground = ["O"]
link = [{name = "arm", pins = ["O", "A"], %s}]
motor = [{pin = "O", speed = "60 rpm"}]
[pins]
O = [0, 0]
A = [100, 0]
"""


def scene_with(tmp_path, arm):
    file, space = document()
    add_slot(space, 100.0, 10.0, (50.0, 0.0), 0.0, True, None)
    for x in (0.0, 100.0):
        space.add_circle((x, 0.0), 3.0 + x / 100)
    file.saveas(tmp_path / "arm.dxf")
    (tmp_path / "scene.toml").write_text(SCENE % arm)
    return udk.load(tmp_path / "scene.toml")


@pytest.mark.parametrize("outline", ['"arm.dxf"', '{file = "arm.dxf", unit = "mm", layers = ["0"], chord = 0.002}'])
def test_a_scene_names_the_file_of_an_outline(outline, tmp_path):
    mech = scene_with(tmp_path, f"density = 7850, thickness = 5, outline = {outline}")
    area, centre, square = combined([(1, slot(100, 10, (50, 0), 0)), (-1, disc(3, (0, 0))), (-1, disc(4, (100, 0)))])
    mass, link = 7850 * 5e-3 * area * MM**2, drawing_of(mech).links["arm"]
    assert float(mech.bodies["arm"].mass) == pytest.approx(mass, rel=1e-12)
    assert float(mech.bodies["arm"].inertia) == pytest.approx(mass * square * MM**2, rel=1e-12)
    np.testing.assert_allclose(mech.bodies["arm"].position, centre * MM, atol=1e-14)
    drawn = link.shape({})  # of the polygons alone
    assert drawn.area == pytest.approx(area * MM**2, rel=1e-3) and drawn.square_radius == pytest.approx(square * MM**2, rel=1e-3)
    again = udk.loads(udk.dumps(mech))
    for name, value in mech.parameters().items():
        np.testing.assert_array_equal(value, again.parameters()[name])
    symbols = udk.animate(mech, udk.kinematics(mech, None, [0.0, 0.1])).data["runs"][0]["symbols"]
    assert sum(x["fill"] == "back" and len(x.get("points", ())) > 12 for x in symbols) == 2


def test_numbers_that_are_given_count_more_than_those_of_the_outline(tmp_path):
    """A measured mass, inertia or centre, as of a link with a motor on it, in the units of the drawing."""
    given = 'mass = 2.5, inertia = "0.031 kg m2", centre = [30, 2], outline = "arm.dxf"'
    arm = scene_with(tmp_path, given).bodies["arm"]
    np.testing.assert_allclose([arm.mass, arm.inertia, *arm.position], [2.5, 0.031, 0.03, 0.002], rtol=1e-12)


def test_mistakes_of_named_outlines_are_listed(tmp_path):
    for arm, message in {
        'outline = "arm.dxf"': r'link\[0\] "arm": needs a mass, or a density and a thickness',
        'mass = 1, outline = "amr.dxf"': r"outline: amr.dxf: .*No such file",
        'mass = 1, outline = {fle = "arm.dxf"}': r'outline\.fle: unknown key; did you mean "file"',
        'mass = 1, outline = {unit = "mm"}': "needs the name of a file",
        'mass = 1, outline = {file = "arm.dxf", unit = "in"}': 'the file\'s unit is "mm"',
        "mass = 1, width = 9, holes = [[[1, 0], [2, 0], [2, 1]]]": "a link without an outline has no holes",
        "mass = 1, outline = [[0, 0], [9, 0], [9, 9]], holes = [[[20, 1], [1, 0], [2, 0]]]": r"holes\[0\]: lies outside",
    }.items():
        with pytest.raises(udk.SceneError, match=message):
            scene_with(tmp_path, arm)


FROM_FILES = """format = 2
units = {length = "mm"}
numbers = {d = 110}
ground = ["O", "C"]
motor = [{pin = "O", speed = "60 rpm"}]
link = [
  {name = "crank", outline = "crank.dxf", density = 7850, thickness = 5},
  {name = "coupler", outline = {file = "coupler.dxf", pin = 8}, density = 7850, thickness = 5},
  {name = "rocker", outline = "rocker.dxf", density = 7850, thickness = 5},
]
[pins]
O = [0, 0]
C = ["d", 0]
"""


def four_bar_of_files(tmp_path, text=FROM_FILES, shift=0.0):
    """A four-bar whose links are drawn where they are, the coupler with a third hole of another size."""
    for name, (a, b), more in (
        ("crank", ((0, 0), (30, 40)), []),
        ("coupler", ((30 + shift, 40), (140, 90)), [((85, 65), 6)]),
        ("rocker", ((140, 90), (110, 0)), []),
    ):
        file, space = document()
        middle, (dx, dy) = np.mean([a, b], axis=0), np.subtract(b, a)
        add_slot(space, float(np.hypot(dx, dy)), 9.0, tuple(middle), float(np.arctan2(dy, dx)), True, None)
        for place, radius in [(a, 4), (b, 4), *more]:
            space.add_circle(place, radius)
        file.saveas(tmp_path / f"{name}.dxf")
    (tmp_path / "scene.toml").write_text(text)
    return udk.load(tmp_path / "scene.toml")


def test_round_holes_of_files_are_pins_by_position(tmp_path):
    mech = four_bar_of_files(tmp_path)
    links = drawing_of(mech).links
    assert [link.pins for link in links.values()] == [("O", "crank2"), ("crank2", "coupler2"), ("C", "coupler2")]
    assert {name: np.asarray(place).round(12).tolist() for name, place in drawing_of(mech).pins.items()} == {
        "O": [0, 0], "C": [0.11, 0], "crank2": [0.03, 0.04], "coupler2": [0.14, 0.09]
    }  # fmt: skip
    found = udk.characteristics(mech)
    assert found.turns and [len(link.holes) for link in links.values() if link.holes is not None] == [2, 3, 2]
    every = four_bar_of_files(tmp_path, FROM_FILES.replace('{file = "coupler.dxf", pin = 8}', '"coupler.dxf"'))
    assert drawing_of(every).links["coupler"].pins == ("crank2", "coupler2", "coupler3")
    named = four_bar_of_files(tmp_path, FROM_FILES.replace('name = "rocker", ', 'name = "rocker", pins = ["C", "coupler2"], '))
    assert drawing_of(named).links["rocker"].pins == ("C", "coupler2")


def test_mistakes_of_pins_at_holes_are_named(tmp_path):
    lengths = '\nB = {from = ["O", "C"], length = [50, 90], side = "left"}\n'
    for old, new, message in (
        ("pin = 8", "pin = 9", r'"coupler".outline: no round hole for a pin of diameter 9 mm; there are holes of 8 mm, 12 mm'),
        ("pin = 8", "pin = -8", r"outline.pin: must be a positive length, not -8"),
        ("d = 110", "d = 110.5", r'"rocker".outline: pin "C" is 0.5 mm off the centre of its hole, \[110, 0\] mm: move one'),
        ('C = ["d", 0]', 'C = ["d", 0]' + lengths, "found by coordinates, which B has not: name the pins of the link"),
    ):
        with pytest.raises(udk.SceneError, match=message):
            four_bar_of_files(tmp_path, FROM_FILES.replace(old, new))
    with pytest.raises(udk.SceneError, match=r'pin "crank2" is 1 mm off the centre of its hole, \[31, 40\] mm'):
        four_bar_of_files(tmp_path, shift=1.0)


def test_the_studio_names_pins_at_holes_and_draws_the_outlines(tmp_path, monkeypatch):
    pytest.importorskip("tomlkit")
    from udkjax.studio import tasks

    drawing = drawing_of(four_bar_of_files(tmp_path))
    monkeypatch.chdir(tmp_path)
    opened = tasks.open_text(FROM_FILES)
    assert opened["document"]["pins"] == {"O": [0, 0], "C": ["d", 0], "crank2": [30.0, 40.0], "coupler2": [140.0, 90.0]}
    assert [link["pins"] for link in opened["document"]["link"]] == [list(link.pins) for link in drawing.links.values()]
    assert opened["document"]["link"][0]["outline"] == "crank.dxf" and not opened["drawn"]
    compiled = tasks.compile_drawing(opened["text"])
    assert compiled["problems"] == [] and compiled["text"] == opened["text"]
    assert [shape["file"] for shape in compiled["outlines"]] == [link["outline"] for link in opened["document"]["link"]]
    for shape, link in zip(compiled["outlines"], drawing.links.values(), strict=True):
        np.testing.assert_array_equal(shape["outline"], link.outline)
        np.testing.assert_array_equal(shape["holes"], link.holes)
    (tmp_path / "crank.dxf").unlink()
    assert tasks.open_text(FROM_FILES)["text"] == FROM_FILES
    assert "No such file" in tasks.compile_drawing(FROM_FILES)["problems"][0]
