"""A course in the studio's page: answers beside the drawing, and expressions of named numbers in fields."""

import numpy as np
import pytest

import udkjax as udk

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
    lengths = udk.loads(studio.js("studio.state.text")).drawing.length_texts()
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
