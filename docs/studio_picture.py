"""Take the picture of the studio for docs/how-to/studio.md: `python -m docs.studio_picture`, with playwright and Chromium."""

import shutil
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from tests.conftest import CHROMIUM
from tests.studio.browsing import served, studio_page

ROOT = Path(__file__).parents[1]
SCENE, PIN, MOMENT = "six_bar.toml", "C", 0.35  # s
OUT = ROOT / "docs" / "how-to" / "studio.png"
COLOURS = 128


def main() -> None:
    """Open the six-bar, select a pin, show the motion at a moment, and save what the page shows."""
    path = next(path for path in CHROMIUM if Path(path).exists())
    with tempfile.TemporaryDirectory() as temporary, sync_playwright() as playwright:
        shutil.copy(ROOT / "examples" / SCENE, temporary)
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        with served(Path(temporary), SCENE) as address, studio_page(browser, address, Path(temporary)) as page:
            page.until(f"studio.canvas.places.has('{PIN}') && studio.motion.end > {MOMENT}")
            page.page.mouse.click(*page.pin(PIN))
            page.settle()
            page.js(f"studio.motion.seek({MOMENT})")
            page.settle()
            page.page.mouse.move(640, 20)
            page.page.screenshot(path=OUT)
        browser.close()
    Image.open(OUT).convert("RGB").quantize(COLOURS).save(OUT, optimize=True)


if __name__ == "__main__":
    main()
