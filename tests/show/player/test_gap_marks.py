"""Gaps between links in the player: links that touch are those that the exact distances tell, and what the page is given."""

import json
import shutil
import subprocess

import numpy as np
import pytest

import udkjax as udk
from tests.command_line import udkjax
from tests.show.player.pages import PLAYER, on_screen, picture
from udkjax.positions.gaps.convex import signed_distance
from udkjax.positions.gaps.shapes import hull
from udkjax.show.player.page import module, page


def four_bar(widths=("60 mm", "70 mm")):
    crank, rocker = widths
    return udk.Drawing(
        pins={"O": [0, 0], "A": [30, 40], "B": [140, 90], "C": [110, 0]},
        links={
            "crank": {"pins": ["O", "A"], "mass": 1, "width": crank},
            "coupler": {"pins": ["A", "B"], "mass": 1, "width": 10},
            "rocker": {"pins": ["B", "C"], "mass": 1, "width": rocker},
        },
        ground=["O", "C"],
        motors={"motor": {"pin": "O", "speed": "60 rpm"}},
        units={"length": "mm"},
    ).mechanism()


@pytest.fixture(scope="module")
def wide():
    mech = four_bar()
    return mech, udk.simulate(mech, np.linspace(0.0, 2.0, 201))


def in_node(script, folder):
    if (node := shutil.which("node")) is None:
        pytest.skip("there is no node")
    (folder / "script.mjs").write_text(module() + script, encoding="utf-8")
    return json.loads(subprocess.run([node, folder / "script.mjs"], capture_output=True, text=True, check=True).stdout)


def test_outlines_touch_where_their_signed_distance_is_less_than_their_radii(tmp_path):
    rng, cases = np.random.default_rng(4), []
    for count, other in [(1, 1), (1, 2), (2, 2), (2, 5), (4, 6), (1, 5)] * 40:
        shapes = [
            points[hull(points)] if len(points) > 2 else points for points in (rng.normal(size=(n, 2)) for n in (count, other))
        ]
        shapes[1] = shapes[1] + rng.normal(size=2)
        cases.append((*(x.tolist() for x in shapes), rng.uniform(0, 1)))
    found = in_node(f"console.log(JSON.stringify({json.dumps(cases)}.map(([a, b, reach]) => touch(a, b, reach))));", tmp_path)
    exact = [float(signed_distance(np.array(a)[:, :, None], np.array(b)[:, :, None])[0]) <= reach for a, b, reach in cases]
    assert found == exact and 50 < sum(exact) < 190


def test_a_page_has_the_outlines_the_least_gap_and_the_ends_of_contacts(wide):
    mech, run = wide
    plain, marked = udk.animate(mech, run), udk.animate(mech, run, gaps=True)
    found = udk.gaps(mech, run=run)
    record, words = marked.data["runs"][0], f"crank and rocker overlap by {-1e3 * found.least.distance:.6g} mm"
    assert record["gaps"]["t"] == found.least.value and record["gaps"]["words"] == words
    assert [event["name"] for event in record["events"]] == [
        "crank and rocker touch", words, "crank and rocker part", "crank and rocker touch", "crank and rocker part"
    ]  # fmt: skip
    assert [event["t"] for event in record["events"]][::2] == [
        found.contacts[0].begins,
        found.contacts[0].ceases,
        found.contacts[1].ceases,
    ]
    bars = {part["body"]: part for part in record["gaps"]["parts"]}
    assert bars[0]["radius"] == 0.03 and bars[2]["radius"] == 0.035 and record["gaps"]["pairs"] == [[[0], [1]]]
    assert np.ptp(bars[0]["points"], axis=0) == pytest.approx([0.05, 0.0], abs=1e-15)
    seen = ("gaps", "symbols")  # symbols have the size of the picture
    assert {k: v for k, v in plain.data["runs"][0].items() if k != "symbols"} == {
        k: v for k, v in record.items() if k not in seen
    } | {"events": []}
    assert marked.data["bounds"][0] < plain.data["bounds"][0] - 0.02 and marked.data["bounds"][3] > plain.data["bounds"][3] + 0.02
    assert "paintTouching(painter, {" in page(marked.data) and "paintTouching(painter, {" not in page(plain.data)
    assert len(page(marked.data)) < len(page(plain.data)) + 4000


def test_gaps_of_several_runs_are_given_by_label(wide):
    mech, run = wide
    chosen = udk.gaps(mech, run=run, pairs=[("crank", "rocker")], shapes={"crank": 0.01})
    shown = udk.animate(mech, {"one": run, "other": run}, gaps={"other": chosen})
    assert ["gaps" in record for record in shown.data["runs"]] == [False, True]
    assert shown.data["runs"][1]["gaps"]["words"] == "least gap of crank and rocker: 20 mm"


def test_gaps_over_values_of_a_driver_are_shown(wide):
    mech, _ = wide
    motion = udk.kinematics(mech, "motor", np.linspace(1.2, 0.2, 11), rate=-2.0)
    found, (record,) = udk.gaps(mech, run=motion), udk.animate(mech, motion, gaps=True).data["runs"]
    assert record["gaps"]["t"] == found.least.value and 0.2 <= found.least.value <= 1.2


def test_wrong_gaps_are_refused_by_name(wide, tmp_path, capsys):
    mech, run = wide
    with pytest.raises(ValueError, match=r"over values in rad and time: give udk.gaps\(mechanism, run=solution\)"):
        udk.animate(mech, run, gaps=udk.gaps(mech))
    with pytest.raises(ValueError, match="leave out gaps or live"):
        udk.animate(mech, run, gaps=True, live=True)
    with pytest.raises(udk.SceneError, match="has no outline"):
        udk.animate(udk.library.parallelogram(), udk.simulate(udk.library.parallelogram(), [0.0, 0.1]), gaps=True)
    udk.save(mech, scene := tmp_path / "scene.toml")
    assert udkjax("animate", scene, "--gaps", "--out", tmp_path / "x.dxf") == 2
    assert "--out must be a page, a film or a picture, not x.dxf" in capsys.readouterr().err
    assert udkjax("animate", scene, "--gaps", "--t1", 1, "--out", out := tmp_path / "x.html") == 0
    assert "crank and rocker touch" in out.read_text()


def test_links_that_touch_are_red_in_pictures_and_films(wide, tmp_path):
    from udkjax.show.player.films import image
    from udkjax.show.player.pictures import sketches

    mech, run = wide
    plain, marked, least = udk.animate(mech, run), udk.animate(mech, run, gaps=True), udk.gaps(mech, run=run).least
    contacts = udk.gaps(mech, run=run).contacts
    for t in (*np.linspace(0.03, 1.97, 20), least.value):
        names = {mech.body_names[part["body"]] for part in marked.touching(t)[0]}
        assert names == ({"crank", "rocker"} if any(touch.begins < t < touch.ceases for touch in contacts) else set()), t
    red, view = {}, sketches(marked, 0.0, 640, "light")[0]
    for t in (0.0, least.value):
        svg = marked.save(tmp_path / "x.svg", t).read_text()
        assert plain.touching(t) == [[]] and "touching" not in plain.save(tmp_path / "y.svg", t).read_text()
        lines = [line for line in svg.splitlines() if 'class="touching"' in line]
        assert [f'stroke-width="{2 * view.scale * radius:.2f}"' in line for line, radius in zip(lines, (0.03, 0.035))] == [
            True
        ] * len(lines)
        pixels = np.asarray(image(marked, t), float)
        red[t] = np.mean((pixels[..., 0] - pixels[..., 1:].max(-1)) > 60)
        red[t, "plain"] = np.mean((np.asarray(image(plain, t), float) @ [1, -0.5, -0.5]) > 60)
        marked.save(tmp_path / "x.dxf", t)
    assert red[least.value] > 0.05 > red[0.0] and red[least.value] > 3 * red[least.value, "plain"]
    areas = [part | {"points": part["points"] + [[0.1, 0.2]]} for part in marked.touching(least.value)[0]]  # of plates
    discs = [part | {"points": part["points"][:1]} for part in areas]
    from udkjax.show.player.marks.sketch import Circle, Line, Sketch

    shapes = Sketch([], marked.pose(0.0)[0], view, touching=[*areas, *discs]).shapes
    assert [type(shape) for shape in shapes] == [Line, Line, Circle, Circle]
    area, disc = shapes[0], shapes[2]
    assert isinstance(area, Line) and area.closed and area.fill
    assert isinstance(disc, Circle) and disc.radius == pytest.approx(view.scale * 0.03)


def test_the_button_leads_to_the_least_gap_and_links_that_touch_are_red(opened, wide):
    mech, run = wide
    with opened(udk.animate(mech, run, gaps=True)) as shown:

        def redness():
            x, y = np.round(on_screen(shown, 0, (-0.02, 0.0))).astype(int)  # within the round end of the crank
            red, *others = picture(shown)[y, x]
            return red - max(others)

        away = redness()
        shown.get_by_role("button", name="crank and rocker overlap by").click()
        least = udk.gaps(mech, run=run).least.value
        assert shown.evaluate(f"{PLAYER}.time") == pytest.approx(least, abs=1e-12)
        assert redness() > 40 > 5 > away
        shown.evaluate(f"{PLAYER}.seek(0)")
        shown.keyboard.press("g")
        assert shown.evaluate(f"{PLAYER}.time") == pytest.approx(least, abs=1e-12)
