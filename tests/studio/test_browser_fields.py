"""Joins, fields, curves and tables in the studio's page, by mouse and keys."""

import csv

import numpy as np
import pytest

import udkjax as udk


def field(studio, label, typed):
    """Type into a field of the panel."""
    studio.page.get_by_label(label, exact=True).fill(typed)
    studio.page.keyboard.press("Enter")


@pytest.mark.slow
def test_bars_that_cross_are_pinned_and_a_pin_under_a_bar_is_joined(studio):
    studio.link((40, 60), (120, 140))
    studio.link((40, 140), (120, 60))
    studio.tool("p")
    studio.click(80.4, 100.4)
    assert studio.document["pins"]["E"] == pytest.approx([80, 100])
    assert [link["pins"] for link in studio.document["link"]] == [["A", "E", "B"], ["C", "E", "D"]]
    studio.tool("l")
    studio.drag((20, 100), (140, 100))  # across the crossing
    assert "E lies on link3, but does not belong to it." in studio.status()
    studio.page.get_by_role("button", name="Join them").click()
    assert studio.document["link"][2]["pins"] == ["F", "E", "G"]
    studio.page.keyboard.press("Control+z")
    studio.settle()
    assert "pin E lies on link3 but does not belong to it" in studio.findings
    studio.page.get_by_role("button", name="join E to link3").click()
    assert studio.document["link"][2]["pins"] == ["F", "E", "G"]
    studio.link((80, 200), (50.3, 100.2))  # ends near the middle of a half: no mark there
    studio.link((80, 30), (99.6, 100.3))
    ends = [studio.document["link"][k]["pins"][-1] for k in (3, 4)]
    assert all(abs(studio.document["pins"][pin][1] - 100) < 1e-9 for pin in ends)


@pytest.mark.slow
def test_a_bar_is_given_a_length_an_angle_and_a_mass_by_expressions(studio):
    studio.link((0, 0), (60, 80))
    studio.tool("v")
    studio.js("studio.select([{kind: 'link', index: 0}])")
    field(studio, "length", "40 + 50*cos(60)")
    field(studio, "angle", "20*3")
    np.testing.assert_allclose(studio.document["pins"]["B"], [65 * 0.5, 65 * np.sin(np.pi / 3)], atol=1e-9)
    assert studio.page.get_by_label("mass", exact=True).count() == 0
    studio.page.get_by_label("more", exact=True).select_option("mass")
    field(studio, "mass", "0.2 kg")
    assert studio.document["link"][0].get("density") is None and studio.document["link"][0]["mass"] == "0.2 kg"
    studio.js("studio.select([{kind: 'pin', name: 'B'}])")
    field(studio, "x", "50 @ 60")
    np.testing.assert_allclose(studio.document["pins"]["B"], [25, 50 * np.sin(np.pi / 3)], atol=1e-9)


@pytest.mark.slow
def test_a_chosen_curve_stays_and_the_table_has_the_curves_in_the_units_of_the_drawing(studio):
    studio.js("studio.files.openTemplate('four_bar')")
    studio.settle()
    pins = list(studio.document["pins"])
    moving = [pin for pin in pins if pin not in studio.document["ground"]]
    studio.page.get_by_label("curve", exact=True).select_option(f"{moving[0]}: acceleration")
    studio.page.mouse.click(*studio.pin(moving[1]))
    assert studio.js("studio.curves.name") == f"{moving[0]}: acceleration"
    studio.page.get_by_role("button", name="export as").click()
    studio.page.get_by_label("format", exact=True).select_option("csv")
    studio.page.get_by_label("file name").fill("table.csv")
    studio.page.get_by_label("file name").press("Enter")
    studio.until("studio.parts.status.textContent.startsWith('wrote table.csv')")
    with (studio.folder / "table.csv").open() as file:
        head, *rows = csv.reader(file)
    table = np.array(rows, float)
    mechanism = udk.loads(studio.js("studio.state.text"))
    sol = udk.simulate(mechanism, table[:, 0], rtol=1e-9, atol=1e-9)
    for k in (0, len(table) // 3, len(table) - 1):
        a = np.asarray(udk.accelerations(mechanism, table[k, 0], sol.q[k], sol.v[k]))
        for body, (_, _, turning) in zip(mechanism.bodies, a.reshape(-1, 3), strict=True):
            shown = table[k, head.index(f"{body}: angular acceleration (rad/s²)")]
            assert shown == pytest.approx(turning, rel=1e-5, abs=1e-5 * np.abs(a).max())
    assert f"{moving[0]}: acceleration ({studio.js('studio.document.units?.length ?? `m`')}/s²)" in head


@pytest.mark.slow
def test_a_four_bar_is_drawn_by_keys_alone(studio):
    def typed(tool, *places):
        studio.tool(tool)
        studio.page.keyboard.press("Enter")
        for place in places:
            studio.page.keyboard.type(place)
            studio.page.keyboard.press("Enter")
        studio.page.keyboard.press("Escape")

    typed("l", "0, 0", "40 @ 60", "B", "120, 90", "100, 0", "C")
    typed("g", "A", "D")
    typed("m", "A")
    document = studio.document
    assert [link["pins"] for link in document["link"]] == [["A", "B"], ["B", "C"], ["D", "C"]]
    np.testing.assert_allclose(document["pins"]["B"], [20, 20 * np.sqrt(3)], atol=1e-9)
    assert document["ground"] == ["A", "D"] and document["motor"] == [{"pin": "A", "speed": "60 rpm"}]
    studio.settle()
    studio.page.keyboard.press(" ")
    studio.until("studio.motion.t > 0.1")
    studio.tool("a")
    studio.page.keyboard.press("3")
    studio.page.keyboard.type("00, 0")
    studio.page.keyboard.press("Enter")
    for place in ("350, 0", "320, 50", ""):
        studio.page.keyboard.type(place)
        studio.page.keyboard.press("Enter")
    assert studio.document["link"][3]["pins"] == ["E", "F", "G"]


@pytest.mark.slow
def test_the_crank_goes_to_an_angle_and_several_curves_are_shown_over_it(studio):
    studio.js("studio.files.openTemplate('crank_rocker')")
    studio.settle()
    arm = "const [a, b] = ['O', 'A'].map(p => studio.canvas.places.get(p));"
    angle = f"(() => {{ {arm} return Math.atan2(a[1] - b[1], b[0] - a[0]); }})()"
    for typed, turned in (("90 deg", 90), ("-30", -30), ("0.25 turns", 90), ("1 rad", np.degrees(1)), ("0.25 s", 150)):
        studio.page.get_by_label("go to", exact=True).fill(typed)
        studio.page.keyboard.press("Enter")
        studio.page.wait_for_timeout(60)
        assert np.degrees(studio.js(angle)) == pytest.approx(turned, abs=1e-3)
    studio.page.get_by_label("go to", exact=True).fill("9 s")
    studio.page.keyboard.press("Enter")
    assert 'the motion does not come to "9 s"' in studio.status()
    studio.page.get_by_label("curve", exact=True).select_option("P: speed")
    studio.page.get_by_role("button", name="keep this curve").click()
    studio.page.get_by_label("curve", exact=True).select_option("rocker: angle")
    studio.page.get_by_label("over", exact=True).select_option("motor1")
    studio.until("studio.curves.cache?.curves.length === 2 && studio.curves.along.unit === '°'")
    low, high = studio.js("studio.curves.along.range")
    assert high - low == pytest.approx(720) and low == pytest.approx(60)  # two turns from the drawn position
    box = studio.page.locator(".strip canvas").bounding_box()
    studio.page.mouse.click(box["x"] + 58 + (box["width"] - 120) / 2, box["y"] + 60)  # a speed and an angle: two axes
    studio.page.wait_for_timeout(60)
    assert studio.js("studio.motion.t") == pytest.approx(1.0, abs=0.01)
    studio.page.get_by_role("button", name="show one curve alone").click()
    studio.until("studio.curves.cache.curves.length === 1")


@pytest.mark.slow
def test_arrows_of_velocities_are_those_of_the_pins(studio):
    studio.js("studio.files.openTemplate('crank_rocker')")
    studio.settle()
    studio.page.get_by_role("button", name="arrows of the velocities").click()
    found = studio.js("studio.vectors.at('velocities', 0.3).map(({place, vector}) => [...place, ...vector])")
    turn = np.radians(60) + 2 * np.pi * 0.3
    crank = next(x for x in found if np.hypot(x[0], x[1]) == pytest.approx(0.04))
    np.testing.assert_allclose(crank[:2], [0.04 * np.cos(turn), 0.04 * np.sin(turn)], atol=1e-6)
    np.testing.assert_allclose(crank[2:], 2 * np.pi * np.array([-crank[1], crank[0]]), atol=1e-5)
    still = studio.js("studio.vectors.at('accelerations', 0.3).length")
    assert still == len(found) == 3 and studio.js("studio.vectors.largest('velocities')") >= np.hypot(*crank[2:])
    assert studio.js("studio.vectors.at('forces', 0.3)") == []
    studio.page.get_by_role("tab", name="Dynamics").click()
    studio.page.get_by_role("button", name="compute forces").click()
    studio.until("studio.vectors.at('forces', 0.3).length === 4")
