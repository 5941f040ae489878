"""The studio in headless Chromium: mechanisms are drawn by mouse and keyboard, move, are diagnosed, saved and simulated."""

import json

import numpy as np
import pytest

import udkjax as udk
from tests.studio.browsing import PATIENCE, studio_page
from udkjax.studio.tasks import LIBRARY_TEMPLATES

TOLERANCE = 1e-8  # of the page's runs
STEPS = 600  # moves of a pulling mouse: ten seconds at 60 frames per second
RECORD_FRAMES = """(() => {
    const {motion, parts} = studio, pull = motion.pullTo.bind(motion);
    window.frames = [];
    motion.pullTo = hand => { pull(hand); frames.push([motion.posed.violation, parts.status.textContent]); };
})()"""


def draw_five_bar(studio):
    """The paper's parallelogram: three equal cranks carry a coupler, one of them at its middle."""
    studio.link((30, 150), (80, 100))
    studio.link((190, 150), (240, 100))
    studio.link((80, 100), (240, 100))
    studio.link((110, 150), (160, 100))  # which ends on the coupler
    studio.tool("g")
    for x in (30, 110, 190):
        studio.click(x, 150)


def assert_moves_as_simulated(studio, text, atol=1e-9):
    """Compare the page's motion with `simulate` of the text."""
    mechanism, run = udk.loads(text), studio.run()
    q = np.array(run["q"]).reshape(len(run["ts"]), -1, 3)
    sol = udk.simulate(mechanism, np.array(run["ts"]), rtol=TOLERANCE, atol=TOLERANCE)
    order = [run["bodies"].index(body) for body in mechanism.bodies]
    assert np.ptp(q, axis=0).max() > 0.01
    np.testing.assert_allclose(q[:, order], np.asarray(sol.q), rtol=0, atol=atol)


def test_the_paper_five_bar_is_drawn_diagnosed_moved_and_saved(studio):
    draw_five_bar(studio)
    studio.settle()
    assert [link["pins"] for link in studio.document["link"]] == [["A", "B"], ["C", "D"], ["B", "F", "D"], ["E", "F"]]
    found = studio.findings
    assert "1 degree of freedom · 1 redundant constraint" in found
    assert "A, B, C, D, E, F: 1 redundant constraint in every position. Any one of these changes removes it:" in found
    for pin in "ABCDEF":
        assert f"{pin}: let the pin on " in found
    assert "not unique at A (x, y)" in found
    before = studio.pin("B")
    studio.page.keyboard.press(" ")
    studio.until("studio.motion.t > 0.2")
    studio.page.keyboard.press(" ")
    assert np.hypot(*np.subtract(studio.pin("B"), before)) > 10  # px
    studio.page.keyboard.press("Control+s")
    studio.page.keyboard.type("five_bar")
    studio.page.keyboard.press("Enter")
    studio.until("studio.files.path === 'five_bar.toml'")
    file = studio.folder / "five_bar.toml"
    assert_moves_as_simulated(studio, file.read_text())
    found = udk.diagnose(udk.load(file))
    assert (found.degrees_of_freedom, found.redundant) == (1, 1)
    studio.tool("m")
    studio.click(30, 150)
    studio.settle()
    assert "motor1 turns all the way round" in studio.findings


@pytest.mark.slow
def test_fifty_undos_return_to_the_first_state_to_the_bit_and_fifty_redos_to_the_last(studio):
    states = [studio.js("JSON.stringify(studio.state)")]
    draw_five_bar(studio)
    studio.tool("v")
    for k in range(43):  # to and fro
        ends = [(80, 100), (90, 100)] if k % 2 == 0 else [(90, 100), (80, 100)]
        studio.drag(*ends, steps=2)
    assert studio.js("studio.history.at") == 50
    studio.settle()
    last = studio.js("JSON.stringify([studio.state.document, studio.state.text])")
    for _ in range(50):
        studio.page.keyboard.press("Control+z")
    studio.settle()
    assert studio.js("JSON.stringify(studio.state)") == states[0]
    assert studio.js("studio.motion.pageEngine") is None
    assert studio.js("[studio.marked.size, studio.paths.length]") == [0, 0]
    for k in range(50):
        studio.page.keyboard.press("Control+y" if k % 2 else "Control+Shift+z")
    studio.settle()
    assert studio.js("JSON.stringify([studio.state.document, studio.state.text])") == last
    assert "1 redundant constraint" not in studio.findings  # one crank was made longer
    assert_moves_as_simulated(studio, studio.js("studio.state.text")) if "1 degree of freedom" in studio.findings else None


@pytest.mark.slow
def test_a_slider_crank_is_drawn_and_its_text_is_edited_beside_it(studio):
    studio.link((40, 100), (70, 140))
    studio.link((70, 140), (190, 100))
    studio.tool("g")
    studio.click(40, 100)
    studio.tool("s")
    studio.drag((190, 100), (230, 100))
    studio.tool("m")
    studio.click(40, 100)
    studio.settle()
    assert studio.document["slide"] == [{"name": "slide1", "link": "slider1", "direction": [1, 0]}]
    assert "1 degree of freedom, 0 with motors held · no redundant constraints" in studio.findings
    assert "motor1 turns all the way round" in studio.findings
    assert_moves_as_simulated(studio, studio.js("studio.state.text"))
    text = studio.js("studio.state.text")
    area = studio.page.locator("textarea")
    area.fill(text.replace('"60 rpm"', '"30 rpm" # half as fast'))
    studio.until("studio.document.motor[0].speed === '30 rpm'")
    studio.settle()
    assert studio.js("studio.motion.end") == 4.0  # two turns
    studio.tool("Escape")
    studio.page.locator("main canvas").focus()
    studio.tool("v")
    studio.drag((70, 140), (60, 150))
    studio.settle()
    assert studio.document["pins"]["B"] == [60, 150]
    changed = studio.js("studio.state.text")
    assert changed == text.replace('"60 rpm"', '"30 rpm" # half as fast').replace("B = [70, 140]", "B = [60, 150]")
    assert area.input_value() == changed
    assert_moves_as_simulated(studio, changed)


@pytest.mark.slow
def test_a_pin_in_a_slot_of_a_link_is_drawn_and_held_by_its_motor(studio):
    """A quick return: the crank's pin in a slot of the lever."""
    studio.link((60, 100), (60, 130))
    studio.link((60, 60), (60, 160))
    studio.tool("g")
    studio.click(60, 100)
    studio.click(60, 60)
    studio.tool("k")
    studio.drag((60, 130), (60, 150))
    studio.tool("m")
    studio.click(60, 100)
    studio.settle()
    assert studio.document["slot"] == [{"pin": "B", "along": ["C", "D"], "on": "link2"}]
    text = studio.js("studio.state.text")
    assert_moves_as_simulated(studio, text)
    studio.page.get_by_role("tab", name="Statics").click()
    studio.page.get_by_role("button", name="compute the holding torques").click()
    studio.until("studio.curves.servedFor() !== null")
    assert {"motor1: holding torque", "A: force on link1", "slot1: force on link2"} <= set(studio.js("studio.curves.names()"))


@pytest.mark.slow
def test_a_drag_released_over_a_panel_has_ended_and_escape_takes_one_away(studio):
    draw_five_bar(studio)
    studio.tool("v")
    x, y = studio.pixel(80, 100)
    studio.page.mouse.move(x, y)
    studio.page.mouse.down()
    studio.page.mouse.move(1100, 400)
    studio.page.mouse.up()
    place = studio.document["pins"]["B"]
    studio.page.mouse.move(400, 400)
    assert studio.document["pins"]["B"] == place != [80, 100]
    studio.page.keyboard.press("Control+z")
    studio.page.mouse.move(x, y)
    studio.page.mouse.down()
    studio.page.mouse.move(x + 80, y)
    studio.page.keyboard.press("Escape")
    studio.page.mouse.up()
    assert studio.js("studio.document.pins.B") == [80, 100]


@pytest.mark.slow
@pytest.mark.parametrize("template", LIBRARY_TEMPLATES)
def test_a_pin_that_is_pulled_takes_the_mechanism_along_and_loops_stay_closed(studio, template):
    studio.js(f"studio.files.openTemplate({json.dumps(template)})")
    studio.until("studio.motion.run !== null")  # then the view shows its paths, and stays
    studio.tool("h")
    carried = "studio.canvas.carrier(studio.document, p) >= 0 && studio.canvas.places.has(p)"
    moving = studio.js(f"Object.keys(studio.document.pins).filter(p => {carried})")
    studio.js(RECORD_FRAMES)  # the constraint violation of each state shown, in units of the scene, and the status line
    x, y = studio.pin(moving[0]) if moving else studio.link_end(0)
    studio.page.mouse.move(x, y)
    studio.page.mouse.down()
    for k in range(STEPS):
        angle = 4 * np.pi * k / STEPS
        studio.page.mouse.move(x + 90 * np.sin(angle), y + 60 * (1 - np.cos(angle)))
    studio.page.mouse.up()
    frames = studio.js("frames")
    assert len(frames) > STEPS / 4
    assert max(violation for violation, _ in frames) < 1e-9
    moved = studio.js("Math.max(...studio.motion.motions.map(Math.abs))") > 0
    assert moved or any("Home" not in words for _, words in frames)


@pytest.mark.slow
def test_the_view_stays_under_a_hand_that_pulls_before_the_first_run_is_there(studio):
    studio.js("window.take = studio.motion.take.bind(studio.motion); studio.motion.take = run => { window.held = run; }; null")
    studio.js("studio.files.openTemplate('peaucellier')")
    studio.until("window.held !== undefined")
    studio.tool("h")
    name = studio.js("Object.keys(studio.document.pins).find(p => studio.canvas.carrier(studio.document, p) >= 0)")
    before = studio.js("studio.view")
    x, y = studio.pin(name)
    studio.page.mouse.move(x, y)
    studio.page.mouse.down()
    studio.page.mouse.move(x + 10, y)
    studio.js("take(held)")
    studio.page.mouse.move(x + 20, y)
    assert studio.js("studio.motion.posed !== null") and studio.js("studio.view") == before
    studio.page.mouse.up()


@pytest.mark.slow
def test_hostile_names_are_texts(studio):
    evil = "<img src=x onerror=hit=1>"
    text = f"""format = 2
name = "{evil}"
ground = ["</script><script>hit=2</script>"]
[pins]
"</script><script>hit=2</script>" = [0, 0]
"__proto__" = [0.1, 0]
"constructor" = [0.2, 0.1]
[[link]]
name = "{evil}"
pins = ["</script><script>hit=2</script>", "__proto__"]
mass = 1
[[link]]
name = "toString"
pins = ["__proto__", "constructor"]
mass = 1
"""
    (studio.folder / "evil.toml").write_text(text)
    studio.js("studio.files.openFile('evil.toml')")
    studio.settle()
    assert "2 degrees of freedom" in studio.findings
    studio.tool("v")
    for name in ("__proto__", "constructor"):
        studio.page.mouse.click(*studio.pin(name))
        assert studio.page.locator(".properties h3").inner_text() == f"pin {name}"
    assert studio.js("window.hit") is None
    assert studio.js("document.querySelectorAll('img, script:not([src])').length") == 0
    assert_moves_as_simulated(studio, text)


@pytest.mark.slow
def test_a_file_that_changed_on_disk_is_not_overwritten_without_asking(studio):
    file = studio.folder / "shared.toml"
    text = 'format = 2\nground = ["A"]\n[pins]\nA = [0, 0]\nB = [0.1, 0]\n[[link]]\nname = "a"\npins = ["A", "B"]\nmass = 1\n'
    file.write_text(text)
    studio.js("studio.files.openFile('shared.toml')")
    studio.settle()
    studio.tool("v")
    studio.page.mouse.click(*studio.pin("B"))
    studio.page.get_by_label("x", exact=True).fill("0.2")
    studio.page.keyboard.press("Enter")
    theirs = text + "# by another editor\n"
    file.write_text(theirs)
    studio.page.locator("main canvas").focus()
    studio.page.keyboard.press("Control+s")
    studio.until("document.querySelector('dialog[open] h2')?.textContent === 'Changed on disk'")
    studio.problems[:] = [words for words in studio.problems if "409" not in words]
    assert file.read_text() == theirs
    studio.page.get_by_role("button", name="Overwrite it").click()
    studio.until("studio.files.isChanged === false")
    assert file.read_text() == text.replace("B = [0.1, 0]", "B = [0.2, 0]")


@pytest.mark.slow
def test_a_finger_drags_and_two_zoom(browser, server):
    with studio_page(browser, *server, width=390, height=844, has_touch=True) as studio:
        studio.js("studio.files.openTemplate('four_bar')")
        studio.settle()
        cdp = studio.page.context.new_cdp_session(studio.page)

        def touch(kind, *points):
            cdp.send(
                "Input.dispatchTouchEvent",
                {"type": kind, "touchPoints": [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]},
            )

        name = studio.js("Object.keys(studio.document.pins)[1]")
        x, y = studio.pin(name)
        before = studio.document["pins"][name]
        touch("touchStart", (x, y))
        for k in range(1, 6):
            touch("touchMove", (x + 8 * k, y))
        touch("touchEnd")
        studio.settle()
        assert studio.document["pins"][name] != before
        scale = studio.js("studio.view.scale")
        box = studio.page.locator("main canvas").bounding_box()
        cx, cy = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        touch("touchStart", (cx - 30, cy), (cx + 30, cy))
        for k in range(1, 6):
            touch("touchMove", (cx - 30 - 6 * k, cy), (cx + 30 + 6 * k, cy))
        touch("touchEnd")
        assert studio.js("studio.view.scale") / scale == pytest.approx(2.0, rel=0.05)


def test_these_tests_wait_longer_than_the_server_may_take():
    from udkjax.studio.limits import COMPILE_SECONDS

    assert PATIENCE >= COMPILE_SECONDS


@pytest.mark.slow
def test_a_picture_is_brought_to_scale_by_two_of_its_points(studio):
    from PIL import Image

    file = studio.folder / "sketch.png"
    Image.new("RGB", (200, 100), "white").save(file)
    studio.page.get_by_label("background picture").set_input_files(str(file))
    studio.until("studio.picture !== null && studio.tool === 'scale'")
    picture = studio.js("({x: studio.picture.x, y: studio.picture.y, width: studio.picture.width})")
    ends = [1e3 * picture["x"], 1e3 * picture["y"]], [1e3 * (picture["x"] + picture["width"]), 1e3 * picture["y"]]
    studio.drag([ends[0][0] + 20, ends[0][1] - 10], [ends[1][0] - 20, ends[1][1] - 10])  # the picture's width less 40 mm
    studio.page.keyboard.type("300 mm")
    studio.page.keyboard.press("Enter")
    studio.until("studio.tool === 'select'")
    scaled = studio.js("studio.picture.width") / picture["width"]
    assert scaled == pytest.approx(300 / (1e3 * picture["width"] - 40), rel=0.01)  # the error of a pixel
    assert studio.document == {"format": 2, "units": {"length": "mm", "angle": "deg"}, "ground": [], "pins": {}}


@pytest.mark.slow
def test_curves_scrub_and_forces_and_rest_are_computed_when_asked_for(studio):
    studio.js("studio.files.openTemplate('parallelogram')")
    studio.settle()
    box = studio.page.locator(".strip canvas").bounding_box()
    studio.page.mouse.click(box["x"] + 58 + (box["width"] - 70) / 4, box["y"] + 60)  # without the margins of its axes
    assert studio.js("studio.motion.t / studio.motion.end") == pytest.approx(0.25, abs=0.002)
    studio.page.get_by_role("tab", name="Dynamics").click()
    studio.page.get_by_role("button", name="compute forces").click()
    studio.until("studio.curves.servedFor() !== null")
    assert studio.js("studio.curves.name").endswith("(not unique)")  # the linkage has a redundant link
    studio.page.get_by_role("tab", name="Statics").click()
    studio.page.get_by_role("button", name="find the stable equilibrium").click()
    studio.until("studio.curves.fact.textContent.startsWith('stable equilibrium, natural frequencies')")
    drawn = udk.loads(studio.js("studio.state.text"))
    rest = np.asarray(udk.equilibrium(drawn, stable=True).q)
    np.testing.assert_allclose(np.reshape(studio.js("Array.from(studio.motion.posed.q)"), (-1, 3)), rest, atol=1e-9)
    assert "Hz" in studio.page.locator(".fact").inner_text()
    studio.page.get_by_role("button", name="compute the holding torques").click()
    studio.until("studio.curves.fact.textContent.startsWith('motors do not hold')")
    studio.page.keyboard.press("Home")
    assert studio.js("studio.motion.posed") is None
    studio.page.keyboard.press(" ")  # plays, and does not press the last button again
    studio.until("studio.motion.t > 0")


@pytest.mark.slow
def test_a_pin_is_freed_by_a_click_and_the_motion_stays(studio):
    draw_five_bar(studio)
    studio.settle()
    studio.tool("v")
    studio.drag((160, 100), (150, 100))  # changes masses and centres, but not the structure
    studio.drag((110, 150), (100, 150))
    studio.settle()
    before, bodies = np.reshape(studio.run()["q"], (-1, 4, 3)), studio.run()["bodies"]
    studio.page.get_by_role("button", name="apply the change at F").click()
    studio.settle()
    assert "1 degree of freedom · no redundant constraints" in studio.findings and "all unique" in studio.findings
    assert studio.document["slot"][0]["pin"] == "F"
    after = studio.run()
    order = [after["bodies"].index(body) for body in bodies]
    q = np.reshape(after["q"], (-1, 4, 3))[:, order]
    np.testing.assert_allclose(q[:, :, :2], before[:, :, :2], atol=1e-7)  # the two runs have different equations
    assert_moves_as_simulated(studio, studio.js("studio.state.text"))
    studio.page.keyboard.press("Control+z")
    studio.settle()
    assert "1 redundant constraint" in studio.findings


@pytest.mark.slow
def test_arrows_move_what_is_selected_by_steps_of_the_grid(studio):
    studio.link((40, 100), (60, 130))
    studio.tool("v")
    studio.click(60, 130)
    step = 1e3 * studio.js("studio.gridUnit()")
    for key in ("ArrowRight", "ArrowRight", "ArrowUp", "ArrowLeft"):
        studio.page.keyboard.press(key)
    assert studio.document["pins"]["B"] == pytest.approx([60 + step, 130 + step])
    for _ in range(4):
        studio.page.keyboard.press("Control+z")
    assert studio.document["pins"]["B"] == [60, 130]


@pytest.mark.slow
def test_exports_are_chosen_and_named_in_a_dialog(studio):
    studio.js("studio.files.openTemplate('four_bar')")
    studio.settle()
    for ending in ("csv", "svg", "py"):
        studio.page.get_by_role("button", name="export as").click()
        studio.page.get_by_label("format", exact=True).select_option(ending)
        studio.page.get_by_label("file name").fill(f"exported.{ending}")
        studio.page.get_by_label("file name").press("Enter")
        studio.until(f"studio.parts.status.textContent.startsWith('wrote exported.{ending}')")
        assert (studio.folder / f"exported.{ending}").stat().st_size > 500
    studio.page.keyboard.press("Control+n")  # the dialog has returned the keyboard to the page
    studio.settle()
    assert studio.document["pins"] == {}


@pytest.mark.slow
def test_gestures_that_cross_each_other_leave_no_trace(studio):
    draw_five_bar(studio)
    studio.tool("v")
    entries = studio.js("studio.history.at")
    x, y = studio.pin("B")
    studio.page.mouse.move(x, y)
    studio.page.mouse.down()
    studio.page.mouse.move(x + 50, y)
    studio.page.keyboard.press("Delete")
    studio.page.mouse.move(x + 90, y)
    studio.page.mouse.up()
    assert "B" not in studio.document["pins"] and studio.js("studio.history.at") == entries + 1
    studio.page.keyboard.press("Control+z")
    for button in ("right", "middle"):
        studio.page.mouse.move(*studio.pin("B"))
        studio.page.mouse.down(button=button)
        studio.page.mouse.move(x + 50, y)
        studio.page.mouse.up(button=button)
        assert studio.document["pins"]["B"] == [80, 100]
    studio.tool("l")
    studio.page.mouse.dblclick(*studio.pixel(60, 40))
    assert len(studio.document["link"]) == 4 and "needs two pins" in studio.status()
    studio.tool("v")
    studio.page.mouse.click(*studio.pin("B"))
    studio.page.get_by_label("x", exact=True).fill("7 cm")
    x, y = studio.pin("D")
    studio.drag((x, y), (x + 30, y), pixels=True)
    assert studio.document["pins"]["B"][0] == "7 cm" and studio.document["pins"]["D"] != [240, 100]


@pytest.mark.slow
def test_a_click_selects_while_it_runs_and_what_is_selected_can_be_deleted(studio):
    studio.js("studio.files.openTemplate('four_bar')")
    studio.settle()
    studio.page.keyboard.press(" ")
    studio.until("studio.motion.t > 0.1")
    studio.js("studio.motion.speed = 0.01")  # so that the click meets the pin
    name = studio.js("Object.keys(studio.document.pins)[1]")
    studio.page.mouse.click(*studio.pin(name))
    assert studio.js("[studio.motion.playing, studio.motion.posed, studio.selection[0].name]") == [True, None, name]
    assert studio.js("getComputedStyle(studio.canvas.element).outlineStyle") == "none"  # no focus ring after a click
    studio.page.keyboard.press("Delete")
    assert name not in studio.document["pins"]
    assert studio.js("[studio.motion.playing, studio.motion.t]") == [False, 0]
    studio.settle()


@pytest.mark.slow
def test_taken_names_and_texts_that_are_not_lengths_are_refused_in_words(studio):
    studio.link((40, 100), (60, 130))
    studio.tool("v")
    studio.click(60, 130)
    before = studio.document
    for label, typed, said in (
        ("name", "A", "another pin is called A"),
        ("name", "", "a pin needs a name"),
        *(("x", typed, "is not a length") for typed in ("abc", "", "nan", "5 kg", "1e400", "[1, 2]")),
    ):
        field = studio.page.get_by_label(label, exact=True)
        shown = field.input_value()
        field.fill(typed)
        studio.page.keyboard.press("Enter")
        assert said in studio.status()
        assert field.input_value() == shown and studio.document == before
    for typed, written in (("5 cm", "5 cm"), ("1e3 mm", "1e3 mm"), ("7", 7)):
        studio.page.get_by_label("x", exact=True).fill(typed)
        studio.page.keyboard.press("Enter")
        assert studio.document["pins"]["B"][0] == written


@pytest.mark.slow
def test_a_text_that_cannot_be_read_is_kept_and_not_saved(studio):
    studio.link((40, 100), (60, 130))
    studio.settle()
    area, text = studio.page.locator("textarea"), studio.js("studio.state.text")
    broken = text.replace("[[link]]", "[[link")
    area.fill(broken)
    studio.until("studio.source.isBroken")
    studio.click(150, 150)  # selects nothing
    assert area.input_value() == broken and studio.document["link"]
    area.focus()
    studio.page.keyboard.press("Control+s")
    studio.page.keyboard.press("Enter")
    studio.until("studio.parts.status.textContent.includes('cannot be read')")
    studio.page.locator("main canvas").focus()
    studio.tool("v")
    studio.drag((60, 130), (70, 130))
    studio.until("studio.source.area.value === studio.state.text")
    studio.page.get_by_role("button", name="Restore the edit").click()
    studio.until("studio.source.isBroken")
    assert area.input_value() == broken
    studio.page.get_by_role("button", name="Back to the text").click()
    studio.until("!studio.source.isBroken && studio.source.area.value === studio.state.text")
    assert studio.document["pins"]["B"] == [70, 130]


@pytest.mark.slow
def test_a_pin_is_given_lengths_and_a_drag_changes_them(studio):
    studio.link((0, 0), (30, 40))
    studio.link((30, 40), (120, 90))
    studio.link((100, 0), (120, 90))
    studio.tool("v")
    page = studio.page
    page.mouse.click(*studio.pin("C"))
    page.get_by_label("given by").select_option(label="lengths from B and D")
    page.mouse.click(*studio.pin("B"))
    page.get_by_label("given by").select_option(label="length and angle from A")
    pins = studio.document["pins"]
    assert pins["B"]["length"] == 50 and pins["C"]["from"] == ["B", "D"] and pins["C"]["side"] == "left"
    page.get_by_label("angle", exact=True).fill("60")
    page.keyboard.press("Enter")
    page.get_by_label("from A", exact=True).fill("4 cm")
    page.keyboard.press("Enter")
    assert studio.document["pins"]["B"] == {"from": "A", "length": "4 cm", "angle": 60}
    assert studio.document["pins"]["C"] == pins["C"]  # the coupler and the rocker keep their lengths
    studio.settle()
    assert "from = [" in studio.js("studio.state.text") and studio.js("studio.motion.pageEngine.engine !== undefined")
    studio.drag(studio.pin("B"), studio.pixel(50, 0), pixels=True)
    moved = studio.document["pins"]["B"]
    np.testing.assert_allclose([float(moved["length"].split()[0]), moved["angle"]], [5, 0], atol=1e-6)
    studio.js("studio.select([{kind: 'link', index: 1}])")
    assert page.get_by_label("length", exact=True).input_value() == "102.956301"
