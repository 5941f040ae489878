"""Random gestures in the studio's page: what a hand may do with mouse and keys, on pins, links and free places."""

import json

import numpy as np

POINTS = "lbskwcrdo"  # keys of tools from one place to another
CLICKS = "pgm"  # keys of tools at one place
OTHER_KEYS = ("Delete", "Escape", "Home", " ", "ArrowLeft", "ArrowUp", "f", "Control+d", "Control+a", "Enter")
ENTRIES = ("12, 30", "50 @ 60", "A", "no place", "1e9, 0", "40 + 50*cos(60), 3")
KNOWN = """[...studio.canvas.places.values(),
    ...studio.canvas.outlines.map(({points}) => points[0].map((x, k) => (x + points.at(-1)[k]) / 2))]"""
MARGIN = 40  # px: free places keep this distance from the canvas's border


class RandomGestures:
    """Gestures on a studio's page, drawn from a seeded generator."""

    def __init__(self, studio, seed):
        self.studio, self.random = studio, np.random.default_rng(seed)
        self.kinds = {
            self.move: 6,
            self.pull: 5,
            self.draw: 5,
            self.click: 3,
            self.plate: 1,
            self.press: 4,
            self.travel: 9,
            self.look: 2,
            self.type: 1,
            self.edit: 2,
        }

    def __call__(self):
        """Make one gesture; returns what it was."""
        kinds, weights = list(self.kinds), np.array(list(self.kinds.values()), float)
        done = kinds[self.random.choice(len(kinds), p=weights / weights.sum())]()
        if self.random.random() < 0.5:
            self.studio.page.wait_for_timeout(int(self.random.integers(5, 120)))
        return done

    # --- places

    def place(self, free=0.3):
        """Return the pixel of a pin or a link, or, with a probability, of any place."""
        box = self.studio.page.locator("main canvas").bounding_box()
        known = self.studio.js(KNOWN)
        inside = [(x, y) for x, y in known if 0 < x < box["width"] and 0 < y < box["height"]]
        if inside and self.random.random() >= free:
            x, y = inside[self.random.integers(len(inside))]
        else:
            x, y = (self.random.uniform(MARGIN, box[side] - MARGIN) for side in ("width", "height"))
        return box["x"] + x, box["y"] + y

    def drag(self, start, end):
        self.studio.drag(start, end, steps=int(self.random.integers(1, 12)), pixels=True)

    # --- gestures

    def move(self):
        self.studio.tool("v")
        x, y = start = self.place(0.1)
        dx, dy = self.random.normal(0.0, 60.0, 2)
        self.drag(start, (x + dx, y + dy))
        return f"move by {dx:.0f}, {dy:.0f}"

    def pull(self):
        self.studio.tool("h")
        self.drag(self.place(0.0), self.place(0.8))
        return "pull"

    def draw(self):
        key = POINTS[self.random.integers(len(POINTS))]
        self.studio.tool("Escape")
        self.studio.tool(key)
        self.drag(self.place(), self.place())
        return f"drag with tool {key}"

    def click(self):
        key = CLICKS[self.random.integers(len(CLICKS))]
        self.studio.tool("Escape")
        self.studio.tool(key)
        self.studio.page.mouse.click(*self.place(0.1))
        return f"click with tool {key}"

    def plate(self):
        self.studio.tool("Escape")
        self.studio.tool("a")
        corners = [self.place() for _ in range(3)]
        for x, y in [*corners, corners[0]]:
            self.studio.page.mouse.click(x, y)
        return "plate"

    def press(self):
        key = OTHER_KEYS[self.random.integers(len(OTHER_KEYS))]
        if self.random.random() < 0.5:  # with something selected
            self.studio.tool("v")
            self.studio.page.mouse.click(*self.place(0.0))
        self.studio.page.keyboard.press(key)
        return f"press {key}"

    def travel(self):
        """Undo or redo some steps, or undo all of them and let the mechanism move, lest all drawings end as broken ones."""
        press, way = self.studio.page.keyboard.press, self.random.random()
        if way < 0.3:
            press("Control+y")
            return "redo"
        if way < 0.6:
            for _ in range(int(self.random.integers(1, 6))):
                press("Control+z")
            return "undo"
        while self.studio.js("studio.history.canUndo"):
            press("Control+z")
        if self.random.random() < 0.4:
            self.studio.until("studio.motion.run?.count > 1")
            press(" ")
        return "undo all"

    def look(self):
        self.studio.page.mouse.move(*self.place())
        self.studio.page.mouse.wheel(0, float(self.random.normal(0.0, 300.0)))
        if self.random.random() < 0.5:
            self.studio.page.keyboard.press("f")
        return "zoom"

    def type(self):
        self.studio.tool("Escape")
        self.studio.tool("l")
        self.studio.page.keyboard.press("Enter")
        words = ENTRIES[self.random.integers(len(ENTRIES))]
        self.studio.page.keyboard.type(words)
        self.studio.page.keyboard.press("Enter")
        self.studio.page.keyboard.press("Escape")
        return f"type {words}"

    def edit(self):
        """Write a number into a field of the selected element."""
        self.studio.tool("v")
        self.studio.page.mouse.click(*self.place(0.0))
        fields = self.studio.page.locator(".properties input[type=text]:visible")
        count = fields.count()
        if not count:
            return "select"
        words = ("0", "-3", "17.5", "1e6", "")[self.random.integers(5)]
        field = fields.nth(int(self.random.integers(count)))
        field.fill(words, timeout=5_000)
        field.press("Enter", timeout=5_000)
        return f"enter {json.dumps(words)}"
