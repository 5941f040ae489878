"""Exercises of a course by mouse and keys: drawn, given numbers by their dimensions, and answered beside the drawing.

An act is a key of a tool, a click, a drag, or a typed number with Enter.
"""

import math

import pytest

import udkjax as udk

MOST_ACTS = 18  # until a four-bar moves with the numbers of the book


class Hand:
    """A hand that draws in a studio's page, and counts its acts."""

    def __init__(self, studio):
        self.studio, self.acts = studio, 0
        studio.js("studio.files.startNew()")
        if (discard := studio.page.get_by_role("button", name="Discard changes")).is_visible():
            discard.click()
        studio.js("studio.setView({x: 300, y: 260, scale: 2000}, false)")
        studio.settle()

    def tool(self, key):
        self.acts += 1
        self.studio.tool(key)

    def click(self, *places):
        for place in places:
            self.acts += 1
            self.studio.click(*place)

    def drag(self, *pairs):
        for start, end in pairs:
            self.acts += 1
            self.studio.drag(start, end)

    def dimension(self, nearest, text):
        """Click the dimension whose value is nearest to a number, and type another one."""
        self.acts += 2
        self.studio.settle()
        index, box = self.studio.js(
            f"(() => {{ const off = studio.dimensions.boxes.map(({{mark}}) => Math.abs(parseFloat(mark.typed) - {nearest}));"
            " const k = off.indexOf(Math.min(...off)); return [k, studio.dimensions.boxes[k].box]; })()"
        )
        assert index >= 0
        canvas = self.studio.page.locator("main canvas").bounding_box()
        self.studio.page.mouse.click(canvas["x"] + (box[0] + box[2]) / 2, canvas["y"] + (box[1] + box[3]) / 2)
        self.studio.page.keyboard.type(text)
        self.studio.page.keyboard.press("Enter")

    def answers(self):
        """Return the answers beside the drawing by their titles, once the mechanism moves, and the text of the file."""
        studio = self.studio
        studio.settle()
        studio.until("studio.motion.run?.count > 1 && studio.answers.element.querySelectorAll('dt').length > 0")
        titles, words = (
            studio.js(f"[...document.querySelectorAll('.answers {tag}')].map(one => one.textContent)") for tag in ("dt", "dd")
        )
        assert not studio.problems
        return dict(zip(titles, words, strict=True)), studio.js("studio.state.text")


def numbers(words):
    """Return all numbers of an answer that stand between spaces."""
    return [float(word) for word in words.replace(",", " ").split() if word.lstrip("-")[:1].isdigit()]


def lengths(text):
    """Return the lengths (mm) in a file, by link."""
    found = udk.loads(text).drawing.lengths()
    return {name: [1e3 * float(x) for x in sides.values()] for name, sides in found.items()}


@pytest.mark.slow
def test_a_crank_rocker(studio):
    hand = Hand(studio)
    hand.tool("g")
    hand.click((0, 0), (100, 0))
    hand.tool("l")
    hand.drag(((0, 0), (20, 30)), ((20, 30), (120, 90)), ((120, 90), (100, 0)))
    hand.tool("m")
    hand.click((0, 0))
    hand.tool("v")
    for nearest, text in ((36, "40"), (117, "120"), (92, "80")):
        hand.dimension(nearest, text)
    found, text = hand.answers()
    assert hand.acts <= MOST_ACTS
    kept = lengths(text)
    assert [kept[name][0] for name in ("link1", "link2", "link3")] == pytest.approx([40, 120, 80], rel=1e-9)
    # Crank and coupler in line, both ways: the law of cosines.
    inner, outer = (math.acos((100**2 + r**2 - 80**2) / (200 * r)) for r in (120 - 40, 120 + 40))
    ends = [math.acos((100**2 + 80**2 - r**2) / (2 * 100 * 80)) for r in (120 - 40, 120 + 40)]
    assert numbers(found["link3"])[0] == pytest.approx(math.degrees(ends[1] - ends[0]), rel=1e-5)
    turned = math.pi + inner - outer  # of the crank, from one dead point to the other
    assert numbers(found["time ratio of link3"])[0] == pytest.approx(
        max(turned, 2 * math.pi - turned) / min(turned, 2 * math.pi - turned), rel=1e-5
    )


@pytest.mark.slow
def test_an_offset_slider_crank(studio):
    hand = Hand(studio)
    hand.tool("g")
    hand.click((0, 0))
    hand.tool("l")
    hand.drag(((0, 0), (20, 40)), ((20, 40), (150, -10)))
    hand.tool("s")
    hand.drag(((150, -10), (190, -10)))
    hand.tool("m")
    hand.click((0, 0))
    hand.tool("v")
    for nearest, text in ((45, "50"), (139, "150"), (10, "20")):
        hand.dimension(nearest, text)
    found, text = hand.answers()
    assert hand.acts <= MOST_ACTS
    kept = lengths(text)
    assert [kept[name][0] for name in ("link1", "link2")] == pytest.approx([50, 150], rel=1e-9)
    stroke = math.sqrt(200**2 - 20**2) - math.sqrt(100**2 - 20**2)
    assert numbers(found["slider1"])[0] == pytest.approx(stroke, rel=1e-5)


@pytest.mark.slow
def test_whitworths_quick_return(studio):
    """The pin of the crank runs in the slot of a lever, which turns about another pin of the ground."""
    hand = Hand(studio)
    hand.tool("g")
    hand.click((0, 0))
    hand.tool("l")
    hand.drag(((0, 0), (30, 40)), ((-15, -80), (45, 80)))  # the crank, and the lever through its pin
    hand.tool("g")
    hand.click((3.75, -30))
    hand.tool("k")
    hand.drag(((30, 40), (-11.25, -70)))
    hand.tool("m")
    hand.click((0, 0))
    found, text = hand.answers()
    assert hand.acts <= MOST_ACTS
    crank, apart = (lengths(text)[name][0] for name in ("link1", "ground"))
    assert crank == pytest.approx(50.0, rel=1e-9)
    assert "turns all the way round" in found["link2"]
    slowest, _, fastest, _ = numbers(found["speed ratio of link2"])
    # The pin of the crank is farthest from the lever's, and nearest to it.
    assert [slowest, fastest] == pytest.approx([crank / (crank + apart), crank / (crank - apart)], rel=1e-5)
