"""Pages of the player in headless Chromium: opening, waiting, screenshots."""

import io
from contextlib import contextmanager

import numpy as np
from PIL import Image

from udkjax.show.player.page import as_json, module

REACH = 8  # px around the centre of a pin that contain its ring
PLAYER = "document.getElementById('player').player"


def until(page, condition):
    """Wait for a condition; Playwright's own function evaluates text, which the page forbids."""
    for _ in range(200):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(25)
    raise AssertionError(f"{condition} did not come true")


def rgb(colour):
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])


def picture(page):
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float)


def on_screen(page, panel, place):
    """The pixel of a place in metres."""
    x, y = page.evaluate(f"{PLAYER}.pixel({panel}, {place[0]}, {place[1]})")
    box = page.locator(".panel canvas").nth(panel).bounding_box()
    return np.array([box["x"] + x, box["y"] + y])


def ring_centre(pixels, place, colour):
    """The centroid of a colour near a pixel: the centre of the ring of a pin."""
    x, y = np.rint(place).astype(int)
    rows, columns = slice(y - REACH, y + REACH + 1), slice(x - REACH, x + REACH + 1)
    weight = np.clip(1 - np.abs(pixels[rows, columns] - rgb(colour)).max(axis=2) / 100, 0, 1)
    assert weight.sum() > 8, "there is no pin"
    grid = np.mgrid[rows, columns] + 0.5
    return np.array([(weight * grid[1]).sum(), (weight * grid[0]).sum()]) / weight.sum()


def plain(page):
    """Hide traces, which cover pins."""
    for name in ("Traces",):
        button = page.get_by_role("button", name=name)
        if button.get_attribute("aria-pressed") == "true":
            button.click()


HOST = """
<!doctype html><meta charset="utf-8"><div id="one"></div><script type="module">
const source = SOURCE;
const {default: widget} = await import(URL.createObjectURL(new Blob([source], {type: "text/javascript"})));
const state = {data: DATA, time: 0.5, playing: false, theme: "light"}, listeners = {};
window.model = {
  get: name => state[name],
  set: (name, value) => { state[name] = value; },
  save_changes: () => { window.saved = {...state, data: null}; },
  on: (name, listener) => { (listeners[name] ??= []).push(listener); },
  off: name => { delete listeners[name]; },
  change: (name, value) => { state[name] = value; for (const listener of listeners[`change:${name}`] ?? []) listener(); },
};
window.cleanup = widget.render({model: window.model, el: document.getElementById("one")});
window.listeners = listeners;
</script>
"""


class Pages:
    """Open animations in a browser; calls with default options share one page, which takes a third of the time."""

    def __init__(self, browser, folders):
        self.browser, self.folders, self.usual = browser, folders, []

    @contextmanager
    def __call__(self, animation, address="", script="", width=1000, height=700, color_scheme="light", **options):
        """Show an animation, with a fragment of its address; require that it reports no error and contacts no server."""
        path = self.folders.mktemp("pages") / "page.html"
        animation.save(path)
        is_usual = not script and not options
        page = self.usual.pop() if is_usual and self.usual else self.browser.new_context(**options).new_page()
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=color_scheme)
        problems, requests = [], []
        listeners = {
            "pageerror": lambda error: problems.append(str(error)),
            "console": lambda message: problems.append(message.text) if message.type in ("error", "warning") else None,
            "request": lambda request: requests.append(request.url),
        }
        for event, listener in listeners.items():
            page.on(event, listener)
        if script:
            page.add_init_script(script)
        page.goto(path.as_uri() + address)
        until(page, f"Boolean({PLAYER})")
        page.evaluate(f"{PLAYER}.live?.ready")
        yield page
        assert problems == []
        assert requests == [path.as_uri()]  # the page itself, and nothing else
        for event, listener in listeners.items():
            page.remove_listener(event, listener)
        if is_usual:
            page.mouse.move(0, 0)
            page.goto("about:blank")
            self.usual.append(page)
        else:
            page.context.close()

    @contextmanager
    def widget(self, data):
        """Show the widget in a page with the interface of anywidget's model."""
        path = self.folders.mktemp("pages") / "host.html"
        path.write_text(HOST.replace("SOURCE", as_json(module())).replace("DATA", as_json(data)), encoding="utf-8")
        page = self.browser.new_page()
        page.goto(path.as_uri())
        until(page, "Boolean(window.cleanup)")
        yield page
        page.close()
