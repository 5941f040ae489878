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

    def field(self, label, text):
        """Click a field of the selected element, and type."""
        self.acts += 2
        self.studio.page.locator(".properties").get_by_label(label, exact=True).fill(text)
        self.studio.page.keyboard.press("Enter")

    def choose(self, label, value):
        self.acts += 2
        self.studio.page.get_by_label(label, exact=True).select_option(value)

    def select(self, kind):
        """Select the first element of a kind."""
        self.acts += 1
        self.studio.js(f"studio.select([{{kind: '{kind}', index: 0}}])")

    def tables(self):
        """Return the rows of all tables of the answers."""
        return self.studio.js(
            "[...document.querySelectorAll('.answers figure')].map(one =>"
            " [...one.querySelectorAll('tr')].map(row => [...row.children].map(cell => cell.textContent)))"
        )

    def table(self, title):
        """Return the rows of a table of the answers by their first cells."""
        rows = self.studio.js(
            f"[...document.querySelectorAll('.answers figure')].filter(one => one.firstChild.textContent === '{title}')"
            ".flatMap(one => [...one.querySelectorAll('tbody tr')].map(row => [...row.children].map(cell => cell.textContent)))"
        )
        return {first: cells for first, *cells in rows}

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


def drawing(text):
    """Return the drawing of a file."""
    found = udk.loads(text).drawing
    assert isinstance(found, udk.Drawing)
    return found


def lengths(text):
    """Return the lengths (mm) in a file, by link."""
    found = drawing(text).lengths()
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
    """The pin of the crank runs in the slot of a lever, which turns about another pin of the ground, and a rod moves a ram."""
    hand = Hand(studio)
    hand.tool("g")
    hand.click((0, 0))
    hand.tool("l")
    hand.drag(((0, 0), (30, 40)), ((-15, -80), (45, 80)), ((-15, -80), (120, -30)))  # crank, lever, rod
    hand.tool("g")
    hand.click((3.75, -30))
    hand.tool("k")
    hand.drag(((30, 40), (-11.25, -70)), ((120, -30), (150, -30)))
    hand.tool("m")
    hand.click((0, 0))
    hand.tool("v")
    hand.click((3.75, -30))
    hand.field("x", "0")
    for nearest, text in ((53, "70"), (50, "60"), (150, "160"), (117, "120"), (30, "32"), (30, "32")):
        hand.dimension(nearest, text)
    hand.select("motor")
    hand.field("speed", "90 rpm")
    found, text = hand.answers()
    assert hand.acts <= 32
    kept = lengths(text)
    crank, apart = (kept[name][0] for name in ("link1", "ground"))
    assert [crank, apart, kept["link3"][0]] == pytest.approx([60, 32, 160], rel=1e-9)
    assert sorted(kept["link2"]) == pytest.approx([70, 120, 190], rel=1e-9)
    places = {name: [1e3 * float(x) for x in place] for name, place in drawing(text).pins.items()}
    assert places["F"] == pytest.approx([0, -32], abs=1e-9) and places["E"][1] == pytest.approx(-32, abs=1e-9)
    assert "turns all the way round" in found["link2"]
    slowest, _, fastest, _ = numbers(found["speed ratio of link2"])
    # The pin of the crank is farthest from the lever's, and nearest to it.
    assert [slowest, fastest] == pytest.approx([crank / (crank + apart), crank / (crank - apart)], rel=1e-5)
    # The ram's line goes through the lever's pin: it turns back where the lever lies on it.
    assert numbers(found["E"])[0] == pytest.approx(2 * 70, rel=1e-5)
    below = math.asin(32 / crank)
    assert numbers(found["time ratio of E"])[0] == pytest.approx((math.pi + 2 * below) / (math.pi - 2 * below), rel=1e-5)
    ends = [math.degrees(turn) % 360 for turn in (math.pi + below, -below)]  # the crank's pin is level with the lever's
    assert numbers(found["dead points of E"]) == pytest.approx(sorted(ends), rel=1e-5)
    # As drawn, the lever turns by v_B / |B - F| across it.
    arm, turn = [b - f for b, f in zip(places["B"], places["F"], strict=True)], 3 * math.pi
    omega = turn * (places["B"][0] * arm[0] + places["B"][1] * arm[1]) / (arm[0] ** 2 + arm[1] ** 2)
    links = next(rows for rows in hand.tables() if rows[0][0] == "link")
    assert float({row[0]: row[2] for row in links}["link2"]) == pytest.approx(omega, rel=1e-5)


@pytest.mark.slow
def test_the_screw_of_a_scissor_jack(studio):
    """Two crossed arms lift a table; the screw pulls the foot of one of them along the floor."""
    hand = Hand(studio)
    hand.tool("g")
    hand.click((0, 0))
    hand.tool("l")
    hand.drag(((0, 0), (80, 60)), ((80, 0), (0, 60)), ((0, 60), (120, 60)))
    hand.tool("p")
    hand.click((40, 30))
    hand.tool("s")
    hand.drag(((80, 0), (120, 0)))
    hand.tool("k")
    hand.drag(((80, 60), (120, 60)))
    hand.tool("m")
    hand.click((88, -2))
    hand.tool("o")
    hand.drag(((60, 60), (60, 30)))
    hand.field("force", "[0 N, -1000 N]")
    hand.tool("v")
    for nearest, text in ((50, "65"), (50, "65"), (50, "65"), (50, "65"), (60, "80"), (60, "50")):
        hand.dimension(nearest, text)
    hand.select("link")
    hand.field("angle", "40")
    _, text = hand.answers()
    assert hand.acts <= 35
    kept = lengths(text)
    assert [*kept["link1"], *kept["link2"]] == pytest.approx([130, 65, 65] * 2, rel=1e-9)
    assert sorted(kept["link3"]) == pytest.approx([50, 80, 130], rel=1e-9)
    # Virtual work: the table rises by dy while the screw shortens by dx = tan(angle) dy; the arms' middles rise half as far.
    jack = udk.loads(text)
    masses = {name: float(body.mass) for name, body in jack.bodies.items()}
    lifted = 1000 + 9.81 * (masses["link3"] + (masses["link1"] + masses["link2"]) / 2)
    foot, height = (float(drawing(text).pins[pin][axis]) for pin, axis in (("C", 0), ("D", 1)))
    assert [foot, height] == pytest.approx([0.13 * math.cos(math.radians(40)), 0.13 * math.sin(math.radians(40))], rel=1e-8)
    screw, _, _ = hand.table("forces at rest")["motor1 holds by"]
    assert numbers(screw)[0] == pytest.approx(-lifted / math.tan(math.radians(40)), rel=1e-5)


@pytest.mark.slow
def test_a_toggle_press(studio):
    """A crank-rocker stretches two links, of which the second one moves a ram on a line through the rocker's pin."""
    hand = Hand(studio)
    hand.tool("g")
    hand.click((0, 0), (100, 60))
    hand.tool("l")
    hand.drag(((0, 0), (0, 30)), ((0, 30), (70, 0)), ((100, 60), (70, 0)), ((70, 0), (100, -70)))
    hand.tool("s")
    hand.drag(((100, -70), (100, -110)))
    hand.tool("m")
    hand.click((0, 0))
    hand.tool("v")
    for nearest, text in ((30, "25"), (67, "70"), (76, "75"), (77, "80")):
        hand.dimension(nearest, text)
    found, text = hand.answers()
    assert hand.acts <= 24
    kept = lengths(text)
    crank, coupler, rocker, ram = (kept[f"link{k}"][0] for k in (1, 2, 3, 4))
    assert [crank, coupler, rocker, ram] == pytest.approx([25, 80, 70, 75], rel=1e-9)
    apart, down = (
        math.hypot(100, 60),
        math.atan2(100, 60),
    )  # the crank's pin from the rocker's
    turned = [
        down - math.acos((apart**2 + rocker**2 - reach**2) / (2 * apart * rocker)) for reach in (coupler - crank, coupler + crank)
    ]
    low, high = min(turned), max(turned)
    heights = [
        rocker * math.cos(x) + math.sqrt(ram**2 - (rocker * math.sin(x)) ** 2) for x in (low, high, min(max(0.0, low), high))
    ]
    assert numbers(found["slider1"])[0] == pytest.approx(max(heights) - min(heights), rel=1e-5)
    assert numbers(found["link3"])[0] == pytest.approx(math.degrees(high - low), rel=1e-5)


@pytest.mark.slow
def test_a_cam_with_a_knife_edge(studio):
    """A cycloidal rise, a dwell and a harmonic return of a follower whose line goes through the centre of the cam."""
    hand = Hand(studio)
    hand.tool("g")
    hand.click((0, 0))
    hand.tool("b")
    hand.drag(((0, 0), (15, 0)))
    hand.tool("l")
    hand.drag(((0, 40), (0, 110)))
    hand.tool("s")
    hand.drag(((0, 75), (0, 130)))
    hand.tool("c")
    hand.drag(((0, 0), (0, 40)))
    hand.tool("m")
    hand.click((0, 0))
    hand.tool("v")
    hand.select("cam")
    hand.choose("given by", "laws")
    hand.field("base", "45")
    hand.choose("law 3", "harmonic")
    for field, text in (("lift 1", "30"), ("angle 1", "150"), ("angle 3", "90")):
        hand.field(field, text)
    hand.dimension(70, "90")
    hand.select("motor")
    hand.field("speed", "120 rpm")
    found, text = hand.answers()
    assert hand.acts <= 34
    assert lengths(text)["link1"] == pytest.approx([90], rel=1e-9)
    places = {name: [1e3 * float(x) for x in place] for name, place in drawing(text).pins.items()}
    assert places == {"A": [0, 0], "B": [0, 45], "C": [0, 135]}  # the follower stands on the base circle
    assert studio.document["cam"][0]["profile"]["angle"] == [150, 30, 90, 90]
    assert numbers(found["link1"])[0] == pytest.approx(30, rel=1e-6)
    rise, back = math.radians(150), math.radians(90)
    fastest = numbers(found["speed ratio of link1"])
    assert [fastest[0], fastest[2]] == pytest.approx([-15 * math.pi / back, 60 / rise], rel=1e-5)

    def rising(share):  # slope of the lift (mm/rad) over the distance from the centre
        height = 30 * (share - math.sin(2 * math.pi * share) / (2 * math.pi))
        return 30 / rise * (1 - math.cos(2 * math.pi * share)) / (45 + height)

    def falling(share):
        return 15 * math.pi / back * math.sin(math.pi * share) / (45 + 15 * (1 + math.cos(math.pi * share)))

    steepest = max(max(rising(k / 100_000), falling(k / 100_000)) for k in range(100_001))
    assert numbers(found["pressure angle of cam1"])[1] == pytest.approx(math.degrees(math.atan(steepest)), rel=1e-5)


@pytest.mark.slow
def test_the_cylinder_of_a_boom(studio):
    """A cylinder from the ground lifts a boom with a load at its end."""
    hand = Hand(studio)
    hand.tool("g")
    hand.click((0, 0))
    hand.tool("l")
    hand.drag(((0, 0), (160, 80)))
    hand.tool("m")
    hand.drag(((60, -60), (80, 40)))
    hand.tool("o")
    hand.drag(((160, 80), (160, 40)))
    hand.field("force", "[0 N, -500 N]")
    hand.tool("v")
    hand.dimension(89, "100")
    hand.dimension(89.4, "110")
    found, text = hand.answers()
    assert hand.acts <= 16
    assert sorted(lengths(text)["link1"]) == pytest.approx([100, 110, 210], rel=1e-9)
    pins = {name: [1e3 * float(x) for x in place] for name, place in drawing(text).pins.items()}
    (foot, head), end = (pins[name] for name in ("C", "D")), pins["B"]
    apart, arm = math.hypot(*foot), math.hypot(*head)
    limits = [numbers(part)[0] for part in found["driver"].split("toggles at ")[1].split(" and ")]
    assert limits == pytest.approx([abs(apart - arm), apart + arm], rel=1e-5)
    way = [h - f for h, f in zip(head, foot, strict=True)]
    lever = (head[0] * way[1] - head[1] * way[0]) / math.hypot(*way)  # of the cylinder's force about the boom's pin
    weight = 9.81 * float(udk.loads(text).bodies["link1"].mass)
    held, _, _ = hand.table("forces at rest")["motor1 holds by"]
    assert numbers(held)[0] == pytest.approx((500 + weight / 2) * end[0] / lever, rel=1e-5)
