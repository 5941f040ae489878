"""The player in headless Chromium: the picture agrees with the closed form, and all controls work."""

import numpy as np
import pytest

import udkjax as udk
from tests.show.player.conftest import Motion
from tests.show.player.pages import PLAYER, on_screen, picture, plain, rgb, ring_centre, until
from udkjax.show.player.marks.sketch import THEMES


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_pixels_are_where_the_closed_form_says(opened, animation, closed_form, theme):
    with opened(animation, color_scheme=theme) as page:
        plain(page)
        for t in (0.0, 0.3125, 1.19, 2.0):
            page.evaluate(f"{PLAYER}.seek({t})")
            pixels = picture(page)
            for name in ("P", "B"):
                expected = on_screen(page, 0, closed_form.pins(t)[name])
                assert np.abs(ring_centre(pixels, expected, THEMES[theme]["ink"]) - expected).max() < 0.6, (t, name)
        np.testing.assert_allclose(pixels[90, 500], rgb(THEMES[theme]["back"]), atol=1)


def test_the_scale_is_the_same_in_both_directions_and_everything_is_in_view(opened, animation):
    left, bottom, right, top = animation.data["bounds"]
    with opened(animation, width=390, height=844) as page:
        (x0, y0), (x1, y1) = on_screen(page, 0, (left, bottom)), on_screen(page, 0, (right, top))
        assert (x1 - x0) / (right - left) == pytest.approx((y0 - y1) / (top - bottom))
        box = page.locator(".panel canvas").bounding_box()
        assert box["x"] <= x0 < x1 <= box["x"] + box["width"] and box["y"] <= y1 < y0 <= box["y"] + box["height"]
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        for button in page.get_by_role("button").all():
            area = button.bounding_box()
            assert area["x"] >= 0 and area["x"] + area["width"] <= 390 and area["height"] >= 30


def test_two_runs_move_in_step(opened, slider_crank, closed_form):
    one = closed_form.run(np.linspace(0, 2, 81))
    ts = np.linspace(0, 2, 41)  # the same motion a quarter of a second later, with other output times
    late = closed_form.run(ts + 0.25)
    animation = udk.animate(slider_crank, {"one": one, "late": Motion(ts=ts, q=late.q, v=late.v)}, measures=())
    with opened(animation) as page:
        plain(page)
        page.evaluate(f"{PLAYER}.seek(0.7)")
        pixels = picture(page)
        for panel, t in enumerate((0.7, 0.95)):
            expected = on_screen(page, panel, closed_form.pins(t)["P"])
            assert np.abs(ring_centre(pixels, expected, THEMES["light"]["ink"]) - expected).max() < 0.6
        assert page.locator("figcaption").all_text_contents() == ["one", "late"]


def test_it_plays_at_its_speed_and_pauses(opened, animation):
    with opened(animation) as page:
        assert page.evaluate(f"[{PLAYER}.time, {PLAYER}.playing]") == [0, False]
        page.get_by_role("combobox", name="speed").select_option("0.5")
        page.get_by_role("button", name="play").click()
        seconds, moved = page.evaluate(
            f"""async () => {{
                await new Promise(done => requestAnimationFrame(done));
                const before = performance.now(), t = {PLAYER}.time;
                await new Promise(done => setTimeout(done, 600));
                await new Promise(done => requestAnimationFrame(done));
                return [(performance.now() - before) / 1000, {PLAYER}.time - t];
            }}"""
        )
        assert moved == pytest.approx(0.5 * seconds, abs=0.1)
        page.keyboard.press("Space")  # goes to the focused button
        stopped = page.evaluate(f"{PLAYER}.time")
        page.wait_for_timeout(100)
        assert page.evaluate(f"[{PLAYER}.time, {PLAYER}.playing]") == [stopped, False]


def test_it_repeats_or_stops_at_the_end(opened, animation):
    with opened(animation) as page:
        page.evaluate(f"{PLAYER}.seek(1.95); {PLAYER}.speed = 1; {PLAYER}.play()")
        until(page, f"{PLAYER}.time < 1")
        page.get_by_role("button", name="repeat").click()
        page.evaluate(f"{PLAYER}.seek(1.9)")
        until(page, f"!{PLAYER}.playing")
        assert page.evaluate(f"{PLAYER}.time") == 2


def test_keys_and_scrubbing(opened, animation):
    with opened(animation) as page:
        time = lambda: page.evaluate(f"{PLAYER}.time")  # noqa: E731
        page.locator(".panel canvas").focus()
        page.keyboard.press("End")
        assert time() == 2
        page.keyboard.press("Shift+ArrowLeft")
        assert time() == pytest.approx(1.9)
        page.keyboard.press("Home")
        page.keyboard.press("ArrowRight")
        assert 0 < time() < 0.1
        page.keyboard.press(" ")
        assert page.evaluate(f"{PLAYER}.playing")
        page.keyboard.press(" ")
        speed = page.evaluate(f"{PLAYER}.speed")
        page.keyboard.press("+")
        assert page.evaluate(f"{PLAYER}.speed") > speed
        page.keyboard.press("?")
        assert page.get_by_text("one frame back, forward").is_visible()
        page.keyboard.press("Escape")
        assert page.get_by_text("one frame back, forward").is_hidden()
        page.get_by_role("slider", name="time").fill("5000")
        assert time() == pytest.approx(1.0)
        strip = page.locator(".strip canvas").bounding_box()
        page.mouse.click(strip["x"] + 12 + 0.25 * (strip["width"] - 80), strip["y"] + 70)
        assert time() == pytest.approx(0.5, abs=0.01)
        page.get_by_role("button", name="Names").click()
        page.keyboard.press(" ")  # would press the button again if a click had left it focused
        assert page.evaluate(f"{PLAYER}.playing")


def test_the_view_moves_zooms_and_is_restored(opened, animation):
    with opened(animation) as page:
        before = on_screen(page, 0, (1, 0))
        page.mouse.move(*before)
        page.mouse.wheel(0, -400)
        page.wait_for_timeout(50)
        np.testing.assert_allclose(on_screen(page, 0, (1, 0)), before, atol=1.0)  # the point under the pointer stays there
        assert on_screen(page, 0, (1.5, 0))[0] > before[0] + 100
        page.mouse.down()
        page.mouse.move(*(before + [60, 30]), steps=4)
        page.mouse.up()
        assert np.abs(on_screen(page, 0, (1, 0)) - before - [60, 30]).max() < 5
        page.locator(".panel canvas").press("0")
        np.testing.assert_allclose(on_screen(page, 0, (1, 0)), before, atol=0.1)


def test_a_finger_plays_pauses_and_seeks(opened, animation):
    with opened(animation, width=390, height=844, has_touch=True, is_mobile=True, device_scale_factor=2) as page:
        page.locator(".panel canvas").tap()
        assert page.evaluate(f"{PLAYER}.playing")
        page.locator(".panel canvas").tap()
        assert not page.evaluate(f"{PLAYER}.playing")
        page.locator(".strip canvas").tap(position={"x": 12 + (390 - 80) / 2, "y": 70})
        assert page.evaluate(f"{PLAYER}.time") == pytest.approx(1.0, abs=0.02)


def test_dark_and_light_by_the_system_and_by_hand(opened, animation):
    with opened(animation, color_scheme="dark") as page:
        back = lambda: picture(page)[90, 500]  # noqa: E731
        np.testing.assert_allclose(back(), rgb(THEMES["dark"]["back"]), atol=1)
        page.emulate_media(color_scheme="light")
        np.testing.assert_allclose(back(), rgb(THEMES["light"]["back"]), atol=1)
        page.get_by_role("button", name="switch between dark and light").click()
        np.testing.assert_allclose(back(), rgb(THEMES["dark"]["back"]), atol=1)


def test_the_strip_shows_the_measure(opened, animation):
    """The curve of the crank's angle, 4 t, meets the line of the current time at half its height at half the time."""
    with opened(animation) as page:
        page.evaluate(f"{PLAYER}.seek(1.0)")
        strip = page.locator(".strip canvas").bounding_box()
        pixels = picture(page)
        x = round(strip["x"] + 12 + 0.75 * (strip["width"] - 80))
        column = pixels[round(strip["y"] + 38) : round(strip["y"] + strip["height"]), x]
        curve = np.flatnonzero(np.abs(column - rgb(THEMES["light"]["bodies"][0])).max(axis=1) < 60) + 38
        top, bottom = 40, strip["height"] - 10
        assert curve.mean() == pytest.approx(bottom - 0.75 * (bottom - top), abs=1.5)
        assert page.get_by_role("combobox", name="measure").locator("option").all_text_contents() == ["crank angle", "speed"]


def test_arrows_of_reactions(opened, slider_crank, run):
    animation = udk.animate(slider_crank, run, measures=(), reactions=True)
    colour = rgb("#b3261e")
    with opened(animation) as page:
        red = lambda: (np.abs(picture(page)[60:620] - colour).max(axis=2) < 40).sum()  # noqa: E731
        with_arrows = red()
        page.get_by_role("button", name="Reactions").click()
        assert with_arrows > red() + 100


def test_modes_oscillate(opened, slider_crank):
    q, shape = np.asarray(slider_crank.q0), np.zeros((1, 3, 3))
    shape[0, 2, 0] = 1.0  # only the slider moves, along x
    animation = udk.animate_modes(slider_crank, q, shape, [1.25])
    with opened(animation) as page:
        assert page.locator("figcaption").text_content() == "mode 1 1.25 Hz"
        for t, amplitude in ((0.25, 1.0), (0.75, 1.0), (0.25, 0.5)):
            page.evaluate(f"{PLAYER}.seek({t})")
            page.get_by_role("slider", name="amplitude").fill(str(amplitude))
            place = (q[2, 0] + amplitude * np.sin(2 * np.pi * t) * 0.12 * float(udk.analyse(slider_crank).length), 0.0)
            expected = on_screen(page, 0, place)
            block = rgb(THEMES["light"]["bodies"][2])
            pixels = picture(page)
            row = pixels[round(expected[1]) - 7, round(expected[0]) - 40 : round(expected[0]) + 41]
            edges = np.flatnonzero(np.abs(row - block).max(axis=1) < 90)
            assert (edges[0] + edges[-1]) / 2 + 0.5 - 40 == pytest.approx(expected[0] - round(expected[0]), abs=1.0)


def test_markup_and_script_in_names_are_text(opened, hostile):
    still = Motion(ts=np.zeros(1), q=np.asarray(hostile.mechanism.q0)[None], v=np.zeros((1, 1, 3)))
    animation = udk.animate(
        hostile.mechanism, dict.fromkeys(hostile.names[:2], still), measures={"<u>x</u> (<i>)": {hostile.names[0]: np.ones(1)}}
    )
    with opened(animation) as page:
        page.get_by_role("button", name="Names").click()
        page.wait_for_timeout(100)
        assert page.evaluate("window.hit") is None
        assert page.locator("h1").text_content() == page.title() == hostile.names[0]
        assert page.locator("figcaption b").all_text_contents() == hostile.names[:2]
        assert page.locator("option").all_text_contents()[-1] != "" and page.locator("img, b b, u").count() == 0
        assert page.get_by_role("combobox", name="measure").locator("option").text_content() == "<u>x</u>"


def test_a_frame_in_another_page(browser, animation):
    page = browser.new_page()
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.set_content(f"<p>before</p>{animation._repr_html_()}")
    frame = page.frame_locator("iframe")
    frame.get_by_role("button", name="play").click()
    frame.get_by_role("button", name="pause").wait_for()
    assert problems == []
    page.close()


def test_the_widgets_module_follows_its_model(opened, animation):
    """In a page with the interface of anywidget's model; test_notebook.py runs the widget in a real notebook."""
    with opened.widget(animation.data) as page:
        player = "document.getElementById('one').player"
        assert page.evaluate(f"{player}.time") == 0.5
        page.evaluate("model.change('time', 1.25)")
        assert page.evaluate(f"{player}.time") == 1.25
        page.evaluate("model.change('playing', true)")
        assert page.evaluate(f"{player}.playing")
        page.evaluate(f"{player}.pause(); {player}.seek(0.75)")
        assert page.evaluate("[saved.time, saved.playing]") == [0.75, False]
        page.evaluate("cleanup()")
        assert page.evaluate("Object.keys(listeners).length") == 0 and page.locator("canvas").count() == 0
