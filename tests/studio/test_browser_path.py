"""A wanted path is drawn in the studio's page, and becomes a mechanism."""

import time

import numpy as np
import pytest


@pytest.mark.slow
def test_a_drawn_path_becomes_a_mechanism(studio):
    studio.tool("t")
    angles = np.linspace(0.0, 2 * np.pi, 40)
    places = [studio.pixel(120 + 50 * np.cos(a) + 8 * np.cos(2 * a), 120 + 25 * np.sin(a)) for a in angles]
    studio.page.mouse.move(*places[0])
    studio.page.mouse.down()
    for place in places[1:]:
        studio.page.mouse.move(*place)
    studio.page.mouse.up()
    start = time.perf_counter()
    studio.page.get_by_role("button", name="find a mechanism with").click()
    studio.until("studio.wanted.designs.length > 0")
    assert time.perf_counter() - start < 30.0  # about 3 s on a machine without other work
    assert studio.page.get_by_label("progress of the search").is_visible()
    assert " mm off, the crank turns, transmission angle at least " in studio.page.locator(".wanted").inner_text()
    studio.until("studio.wanted.designs.length > 1")
    studio.page.get_by_role("button", name="stop looking for mechanisms").click()
    studio.until("!studio.wanted.busy")
    assert studio.js(
        "studio.wanted.at === 0 && studio.wanted.designs.every((one, k, all) => !k || one.deviation >= all[k - 1].deviation)"
    )
    count, first = studio.js("studio.wanted.designs.length"), studio.document["pins"]
    assert studio.js("studio.wanted.designs[0].deviation") < 0.004  # m; the path is 125 mm long
    studio.page.get_by_role("button", name="the next mechanism").click()
    assert studio.page.locator(".wanted").inner_text().startswith(f"2 of {count}") and studio.document["pins"] != first
    studio.page.keyboard.press("Control+z")
    assert studio.document["pins"] == first
    studio.page.get_by_role("button", name="keep this mechanism").click()
    assert not studio.page.locator(".wanted").is_visible()
    studio.settle()
    assert studio.js("studio.motion.end") == 2.0 and "motor1 turns all the way round" in studio.findings


@pytest.mark.slow
def test_a_wanted_path_is_read_from_a_table(studio):
    file = studio.folder / "path.csv"
    file.write_text("time;x;y\n0;10;20\n1;30;40,5\n2;50\n")
    studio.page.get_by_label("table of a wanted path").set_input_files(str(file))
    studio.page.get_by_text("line 4 of path.csv must be two numbers x, y").wait_for()
    studio.problems[:] = [words for words in studio.problems if "400" not in words]
    file.write_text("time;x;y\n0;10;20\n1;30;40,5\n2;50;20\n")
    studio.page.get_by_label("table of a wanted path").set_input_files(str(file))
    studio.until("studio.wanted.points?.length === 3")
    np.testing.assert_allclose(studio.js("studio.wanted.points"), [[0.01, 0.02], [0.03, 0.0405], [0.05, 0.02]])
    studio.page.get_by_role("button", name="remove the wanted path").click()
    assert studio.js("studio.wanted.points") is None
