"""A studio in headless Chromium, operated by mouse and keyboard."""

import json
import os
import re
import subprocess
import sys
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

COMMAND = "from udkjax.cli import main; main()"
PATIENCE = 120.0  # s: time for the server to compile and diagnose on a busy machine


WATCH = """(() => {
    const {canvas, parts} = studio, draw = canvas.draw.bind(canvas);
    const watched = window.watched = {answers: [], longest: 0, frames: 0};
    let waiting = null;
    parts.canvas.addEventListener("pointermove", event => { waiting ??= event.timeStamp; }, true);
    canvas.draw = shown => {
        draw(shown);
        watched.frames += 1;
        if (waiting !== null) watched.answers.push(performance.now() - waiting);
        waiting = null;
    };
    new PerformanceObserver(list => {
        for (const task of list.getEntries()) watched.longest = Math.max(watched.longest, task.duration);
    }).observe({entryTypes: ["longtask"]});
})()"""


class StudioPage:
    """The page of a studio, whose drawing is in millimetres."""

    def __init__(self, page, address, folder):
        self.page, self.folder, self.problems, self.requests = page, folder, [], []
        page.on("pageerror", lambda error: self.problems.append(f"{error} {error.stack}"))
        page.on("console", lambda m: self.problems.append(m.text) if m.type in ("error", "warning") else None)
        page.on("request", lambda request: self.requests.append(request.url))
        page.goto(address, timeout=1e3 * PATIENCE)
        self.until("window.studio?.sync !== undefined")  # until then window.studio is the element with this id
        self.settle()

    def js(self, code):
        return self.page.evaluate(code)

    def until(self, condition):
        """Wait for a condition; Playwright's own function evaluates text, which the page forbids."""
        for _ in range(int(PATIENCE / 0.05)):
            if self.page.evaluate(condition):
                return
            self.page.wait_for_timeout(50)
        raise AssertionError(f"{condition} did not come true; {self.problems}; {self.status()}")

    def settle(self):
        """Wait until text, engine and findings are up to date with the drawing."""
        self.page.evaluate("studio.sync.settled()")
        self.page.wait_for_timeout(60)  # a frame or two

    def status(self):
        return self.js("studio.parts.status.textContent + ' | ' + studio.parts.loops.textContent")

    @property
    def document(self):
        return self.js("studio.state.document")

    @property
    def findings(self):
        return self.page.locator(".findings .body").inner_text()

    def pixel(self, x, y):
        """Return the pixel of a place (mm) of the drawing."""
        box = self.page.locator("main canvas").bounding_box()
        view = self.js("studio.view")
        return box["x"] + view["x"] + view["scale"] * x / 1e3, box["y"] + view["y"] - view["scale"] * y / 1e3

    def pin(self, name):
        """Return the pixel of a pin."""
        box = self.page.locator("main canvas").bounding_box()
        x, y = self.js(f"studio.canvas.places.get({json.dumps(name)})")
        return box["x"] + x, box["y"] + y

    def link_end(self, index):
        """Return the pixel of a link's end away from its first pin."""
        box = self.page.locator("main canvas").bounding_box()
        outline = f"studio.canvas.outlines.find(({{of}}) => of.kind === 'link' && of.index === {index}).points"
        x, y = self.js(f"{outline}.at(-1)")
        return box["x"] + x, box["y"] + y

    def click(self, x, y):
        self.page.mouse.click(*self.pixel(x, y))
        self.page.wait_for_timeout(30)

    def drag(self, start, end, steps=6, pixels=False):
        (x0, y0), (x1, y1) = (start, end) if pixels else (self.pixel(*start), self.pixel(*end))
        self.page.mouse.move(x0, y0)
        self.page.mouse.down()
        for k in range(1, steps + 1):
            self.page.mouse.move(x0 + (x1 - x0) * k / steps, y0 + (y1 - y0) * k / steps)
        self.page.mouse.up()
        self.page.wait_for_timeout(30)

    def tool(self, key):
        self.page.keyboard.press(key)

    def link(self, start, end):
        self.tool("l")
        self.drag(start, end)

    def watch(self):
        """Measure from now on how long events of the pointer wait until they are drawn, and the longest task of the page."""
        self.page.evaluate(WATCH)

    def watched(self):
        """Return the times (s) from an event to its drawing, and the longest task of the page."""
        answers, longest = self.page.evaluate("[watched.answers, watched.longest]")
        return [x / 1e3 for x in answers], longest / 1e3

    def processor_time(self):
        """Return the processor time (s) that the page's thread has taken since the first call, and the part of programs."""
        found = {one["name"]: one["value"] for one in self._clock.send("Performance.getMetrics")["metrics"]}
        return found["TaskDuration"], found["ScriptDuration"]

    @cached_property
    def _clock(self):
        session = self.page.context.new_cdp_session(self.page)
        session.send("Performance.enable", {"timeDomain": "threadTicks"})
        return session

    def open(self, name, text):
        """Write a file, and open it without waiting for its motion."""
        (self.folder / name).write_text(text)
        self.page.evaluate(f"studio.files.openFile({json.dumps(name)})")

    def run(self):
        """Return the motion that the page computed: times and coordinates of all bodies."""
        run = "const {run, pageEngine} = studio.motion"
        return self.js(f"(() => {{ {run}; return {{ts: [...run.ts], q: [...run.q], bodies: pageEngine.scene.bodies}}; }})()")


@contextmanager
def served(folder: Path, opened: str = ""):
    """Serve a studio in a folder, with a file of it or the address of a drawing; yields its address."""
    shown = opened if opened.startswith("udkjax:") else str(folder / opened)
    command = [sys.executable, "-c", COMMAND, "studio", shown, "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ), cwd=folder) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            assert re.match(r"http://127\.0\.0\.1:\d+/#t=", address), "the studio did not start"
            yield address
        finally:
            process.terminate()


@contextmanager
def studio_page(browser, address, folder, width=1280, height=800, **options):
    """Open the page of a studio, and require that it reports no error and contacts no other server."""
    context = browser.new_context(viewport={"width": width, "height": height}, **options)
    try:
        found = StudioPage(context.new_page(), address, folder)
        yield found
        assert found.problems == [], found.problems
        origin = address.partition("/#")[0]
        assert all(url.startswith((origin, "data:", "blob:")) for url in found.requests)
    finally:
        context.close()
