"""The site in a browser: nothing is cut off, text has contrast, and the four-bar of the home page soon moves.

`pytest -s -m slow tests/test_site_in_browser.py` prints the least contrast, and the bytes and the time of the home page.
"""

import functools
import http.server
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from tests.contrast import CONTRAST, LEAST_CONTRAST

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
WIDTHS = 1400, 800, 390  # px
LONGEST = 1.0  # s, until the four-bar of the home page moves
PAGES = sorted(str(path.relative_to(ROOT / "docs").with_suffix("")) for path in (ROOT / "docs").rglob("*.md"))
# Elements of the text that are wider than their place: the page itself, code, equations and pictures.
TOO_WIDE = """() => {
    const kinds = [".highlight pre", ".equation", ".table-wrapper", "figure.drawn svg", "img"].map(kind => ".content " + kind);
    const wide = [...document.querySelectorAll(kinds.join())]
        .filter(e => e.scrollWidth > e.clientWidth + 1 || e.getBoundingClientRect().right > innerWidth + 1)
        .map(e => e.className + " " + e.tagName + ": " + e.textContent.slice(0, 60));
    return document.documentElement.scrollWidth > innerWidth ? ["the page", ...wide] : wide;
}"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The address of the site, served by this process."""
    program = Path(sys.executable).with_name("sphinx-build")
    if not program.exists() and shutil.which("sphinx-build") is None:
        pytest.skip("Sphinx is not installed: sh install.sh --docs")
    out = tmp_path_factory.mktemp("site")
    subprocess.run([program if program.exists() else "sphinx-build", "-q", "-W", ROOT / "docs", out], check=True)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format, *args):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(out)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_cut_off_and_text_has_contrast(browser, site, scheme):
    found, least = {}, 99.0
    for width in WIDTHS:
        page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        for name in PAGES:
            page.goto(f"{site}/{name}.html")
            wide, contrast = page.evaluate(TOO_WIDE), page.evaluate(CONTRAST)
            least = min(least, contrast["ratio"])
            if wide or contrast["ratio"] < LEAST_CONTRAST:
                found[name, width] = wide, contrast
        page.close()
    print(f"{scheme}: {len(PAGES)} pages at {WIDTHS} px, least contrast {least:.2f}")
    assert found == {}, "\n".join(f"{place}: {what}" for place, what in found.items())


def test_the_four_bar_of_the_home_page_soon_moves(browser, site):
    times = []
    for _ in range(3):  # the first one warms up the browser, and the machine may be busy
        page = browser.new_context(viewport={"width": 1400, "height": 900}).new_page()
        sizes: list[int] = []
        page.on("response", lambda response: sizes.append(int(response.headers.get("content-length", 0))))  # noqa: B023
        begin = time.perf_counter()
        page.goto(f"{site}/index.html", wait_until="commit")
        page.wait_for_selector("iframe.live", state="attached")
        frame = page.query_selector("iframe.live").content_frame()
        frame.wait_for_function("document.getElementById('player')?.player?.time > 0")
        times.append(time.perf_counter() - begin)
        page.wait_for_load_state("networkidle")
        page.context.close()
    print(f"the four-bar moves after {min(times):.2f} s; {len(sizes)} files, {sum(sizes)} bytes")
    assert min(times) < LONGEST
    assert sum(sizes) < 3_000_000
