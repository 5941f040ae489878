"""A course in the studio's page: answers beside the drawing, and expressions of named numbers in fields."""

import tomllib

import numpy as np
import pytest

import udkjax as udk
from tests.contrast import CONTRAST, LEAST_CONTRAST
from tests.studio.browsing import studio_page
from udkjax.study.worked.loops import drawing_of

FOUR_BAR = """format = 2
units = {length = "mm", angle = "deg"}
ground = ["O", "C"]

[numbers]
r = 40

[pins]
O = [0, 0]
C = ["2.5*r", 0]
A = {from = "O", length = "r", angle = 60}
B = {from = ["A", "C"], length = ["3*r", 80], side = "left"}

[[link]]
name = "crank"
pins = ["O", "A"]
mass = 1

[[link]]
name = "coupler"
pins = ["A", "B"]
mass = 1

[[link]]
name = "rocker"
pins = ["C", "B"]
mass = 1

[[motor]]
pin = "O"
speed = "60 rpm"
"""


@pytest.mark.slow
def test_answers_and_named_numbers_stand_in_the_panels(studio):
    (studio.folder / "course.toml").write_text(FOUR_BAR, encoding="utf-8")
    studio.js("studio.files.openFile('course.toml')")
    studio.settle()
    panel = studio.page.locator("details.answers")
    text = panel.inner_text()
    for line, words in udk.characteristics(udk.loads(FOUR_BAR)).lines().items():
        assert line in text and words in text
    assert "instant centres" in text
    studio.js("studio.select([])")
    studio.page.get_by_label("r", exact=True).fill("42")
    studio.page.keyboard.press("Enter")
    studio.settle()
    assert studio.document["numbers"] == {"r": 42}
    studio.js("studio.select([{kind: 'link', index: 2}])")
    studio.page.get_by_label("length", exact=True).fill("2*r")
    studio.page.keyboard.press("Enter")
    studio.settle()
    assert studio.document["pins"]["B"]["length"] == ["3*r", "2*r"]
    lengths = drawing_of(udk.loads(studio.js("studio.state.text"))).length_texts()
    assert [lengths[name] for name in ("crank", "coupler", "rocker")] == ["O-A 42 mm", "A-B 126 mm", "C-B 84 mm"]
    before = studio.document["pins"]
    studio.js("studio.commit({...studio.document, pins: {...studio.document.pins}})")
    assert studio.document["pins"] == before
    studio.js("studio.motion.seek(0.25 * studio.motion.end)")
    studio.until("!document.querySelector('details.answers figcaption').textContent.startsWith('at 60 deg')")
    row = studio.js("[...document.querySelectorAll('details.answers tbody tr')].map(row => row.cells[0].textContent)")
    assert row[:2] == ["A", "B"]
    title = studio.js("document.querySelector('details.answers figcaption').textContent")
    shown = float(title.split()[1])
    x = studio.js("+document.querySelector('details.answers tbody tr').cells[1].textContent")
    np.testing.assert_allclose(x, 42 * np.cos(np.radians(shown)), atol=1e-3)
    assert not studio.problems


def edit_dimension(studio, words, text):
    """Click a dimension on the drawing, and type another value in its place."""
    box, canvas = (
        studio.js(f"studio.dimensions.boxes.find(({{mark}}) => mark.words === {words!r}).box"),
        studio.page.locator("main canvas").bounding_box(),
    )
    studio.page.mouse.click(canvas["x"] + (box[0] + box[2]) / 2, canvas["y"] + (box[1] + box[3]) / 2)
    studio.page.keyboard.type(text)
    studio.page.keyboard.press("Enter")
    studio.settle()


@pytest.mark.slow
def test_dimensions_on_the_drawing_are_changed_by_a_click(studio):
    (studio.folder / "dimensions.toml").write_text(FOUR_BAR, encoding="utf-8")
    studio.js("studio.files.openFile('dimensions.toml')")
    studio.settle()
    assert sorted(studio.js("studio.dimensions.marks.map(({words}) => words)")) == [
        "2.5*r = 100",
        "3*r = 120",
        "60°",
        "80",
        "r = 40",
    ]
    for words, text in (("80", "85"), ("60°", "75"), ("2.5*r = 100", "2.75*r"), ("r = 40", "44 mm")):
        edit_dimension(studio, words, text)
    assert studio.document["pins"] == {
        "O": [0, 0],
        "C": ["2.75*r", 0],
        "A": {"from": "O", "length": 44, "angle": 75},
        "B": {"from": ["A", "C"], "length": ["3*r", 85], "side": "left"},
    }
    edit_dimension(studio, "85", "-5")
    assert "is not a length above 0" in studio.status()
    studio.page.keyboard.press("Escape")
    edit_dimension(studio, "85", "500")
    assert "cannot be 500 mm long: coupler is 120 mm" in studio.status()
    studio.js("studio.motion.seek(0.25 * studio.motion.end)")
    studio.settle()
    assert studio.js("studio.dimensions.boxes.length") == 0  # of the drawn position alone
    assert not studio.problems


@pytest.mark.slow
def test_a_mechanism_is_copied_by_keys_and_its_copy_moves(studio):
    (studio.folder / "copied.toml").write_text(FOUR_BAR, encoding="utf-8")
    studio.js("studio.files.openFile('copied.toml')")
    studio.settle()
    studio.page.locator("main canvas").focus()
    for keys in ("a", "c", "v"):
        studio.page.keyboard.press(f"Control+{keys}")
    studio.settle()
    assert len(studio.document["link"]) == 6
    assert [motor["pin"] for motor in studio.document["motor"]] == ["O", studio.document["link"][3]["pins"][0]]
    mechanism = udk.loads(studio.js("studio.state.text"))
    lengths = drawing_of(mechanism).length_texts()
    assert [lengths[link["name"]].split()[-2] for link in studio.document["link"]] == ["40", "120", "80"] * 2
    studio.page.keyboard.press("Control+x")
    studio.settle()
    assert studio.document["link"] == udk_links(FOUR_BAR)
    x, y = studio.pin("A")
    studio.page.keyboard.press("Control+a")
    studio.page.mouse.click(x, y)  # one of several that are selected: it alone
    assert studio.js("studio.selection") == [{"kind": "pin", "name": "A"}]
    assert not studio.problems


def udk_links(text):
    return tomllib.loads(text)["link"]


@pytest.mark.slow
def test_motors_move_slides_and_cylinders_by_mouse(studio):
    studio.tool("g")
    studio.click(0, 0)
    studio.link((0, 0), (100, 0))
    studio.tool("s")
    studio.drag((100, 0), (150, 0))
    studio.js("studio.select([])")
    studio.tool("m")
    x = studio.js("studio.canvas.outlines.filter(({of}) => of?.kind === 'slide').map(({points}) => points.at(-1))")
    canvas = studio.page.locator("main canvas").bounding_box()
    studio.page.mouse.click(canvas["x"] + x[0][0] - 2, canvas["y"] + x[0][1])
    assert studio.document["motor"] == [{"slide": "slide1", "speed": "0.1 m/s"}]
    studio.page.keyboard.press("Control+z")
    studio.tool("m")
    studio.drag((20, 60), (100, 0))
    studio.settle()
    assert studio.document["motor"] == [{"between": ["C", "B"], "speed": "0.1 m/s"}]
    assert studio.document["ground"] == ["A", "C"]
    assert not studio.problems


@pytest.mark.slow
def test_a_sheet_is_printed_with_drawing_and_answers(studio):
    (studio.folder / "printed.toml").write_text(FOUR_BAR, encoding="utf-8")
    studio.js("studio.files.openFile('printed.toml')")
    studio.settle()
    studio.page.emulate_media(media="print", color_scheme="dark")
    studio.js("window.dispatchEvent(new Event('beforeprint'))")
    sheet = studio.page.locator(".print-sheet")
    assert "time ratio of rocker" in sheet.inner_text()
    ratios = studio.js(
        "Promise.all([...document.querySelectorAll('.print-sheet img')].map(image => image.decode().then(() =>"
        " [image.naturalWidth / image.naturalHeight, image.clientWidth / image.clientHeight])))"
    )
    assert len(ratios) == 2
    for natural, shown in ratios:  # circles stay circles
        np.testing.assert_allclose(shown, natural, rtol=0.01)
    assert not studio.page.locator("header").is_visible()
    studio.js("window.dispatchEvent(new Event('afterprint'))")
    assert studio.js("document.querySelectorAll('.print-sheet').length") == 0
    studio.page.emulate_media(media="screen", color_scheme="light")
    assert not studio.problems


SIZES = {"laptop": (1280, 800), "small": (800, 600), "phone": (390, 844)}
# Texts and fields that stick out of the page or of the bar in which they are; dimensions whose texts share pixels.
CUT_OFF = """(() => {
    const bars = ["header", ".strip-bar", "footer", ".answers dl"].map(kind => document.querySelector(kind)), wide = [];
    for (const bar of bars) for (const one of bar.children) {
        const box = one.getBoundingClientRect(), {left, right} = bar.parentElement.getBoundingClientRect();
        const isOut = box.right > Math.min(right, innerWidth) + 1 || box.left < left - 1;
        if (box.width && isOut) wide.push(one.outerHTML.slice(0, 60));
    }
    const boxes = studio.dimensions.boxes.map(({mark, box}) => [mark.key, ...box]);
    boxes.forEach(([name, left, top, right, bottom], k) => boxes.slice(0, k).forEach(([other, a, b, c, d]) => {
        const [across, along] = [Math.min(right, c) - Math.max(left, a), Math.min(bottom, d) - Math.max(top, b)];
        if (across > 2 && along > 2) wide.push(`${name} on ${other}`);
    }));
    return wide;
})()"""


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_cut_off_beside_the_answers_and_text_has_contrast(browser, server, scheme):
    address, folder = server
    for name, size in SIZES.items():
        with studio_page(browser, address, folder, *size, color_scheme=scheme) as studio:
            for template in ("quick_return", "toggle_press"):
                studio.js(f"studio.files.openTemplate('{template}')")
                studio.settle()
                studio.until("studio.motion.run?.count > 1 && studio.answers.element.querySelectorAll('dt').length > 0")
                studio.page.keyboard.press("f")
                studio.settle()
                assert studio.js(CUT_OFF) == [], (name, template)
                assert studio.js("studio.curves.canvas.clientHeight") > 100, name
                found = studio.js(CONTRAST)
                assert found["ratio"] >= LEAST_CONTRAST, (name, found)


@pytest.mark.slow
def test_links_that_touch_are_red_and_a_click_shows_where_they_are_closest(studio):
    wide = FOUR_BAR.replace('name = "crank"', 'name = "crank"\nwidth = 70').replace(
        'name = "rocker"', 'name = "rocker"\nwidth = 70'
    )
    (studio.folder / "wide.toml").write_text(wide, encoding="utf-8")
    studio.js("studio.files.openFile('wide.toml')")
    studio.settle()
    found = udk.gaps(udk.loads(wide))
    studio.page.get_by_role("button", name="find how close links come").click()
    studio.until("studio.answers.gaps.found !== null")
    text = studio.page.locator("details.answers").inner_text()
    (row,) = found.rows()
    assert all(words in text for words in (*row, *found.remarks()))
    painted = "studio.answers.gaps.draw(studio.canvas.painter).size"
    studio.page.get_by_role("button", name=f"show {row[0]} where they are closest").click()
    studio.page.wait_for_timeout(100)
    q = studio.js("Array.from(studio.motion.pageEngine.at(studio.motion.run, studio.motion.t).q)")
    np.testing.assert_allclose(np.reshape(q, (-1, 3)), found.least.q, atol=1e-5)
    assert found.least.distance < 0 and studio.js(painted) == 2
    studio.js("studio.files.export('touching.svg', null)")
    assert 'class="touching"' in (studio.folder / "touching.svg").read_text()
    assert found.count is not None
    away = found.least.value + np.pi  # half a turn later, links are apart
    studio.js(f"studio.motion.goTo('{np.degrees(away + found.count.offset):.6f} deg')")
    studio.page.wait_for_timeout(100)
    assert studio.js(painted) == 0
    studio.js("studio.files.export('apart.svg', null)")
    assert 'class="touching"' not in (studio.folder / "apart.svg").read_text()
    studio.js("studio.commit({...studio.document, pins: {...studio.document.pins, E: [10, 10]}})")
    assert studio.js("studio.answers.gaps.found") is None
    assert not studio.problems
