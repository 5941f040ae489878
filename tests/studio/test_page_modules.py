"""The modules of the studio's page, tested by node where there is one."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from udkjax.studio.application import page_files

PAGE = Path(__file__).parents[2] / "udkjax" / "studio" / "page"
TESTS = Path(__file__).parent / "page.test.mjs"
MOST_LINES = 300


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_modules_that_need_no_browser(tmp_path):
    """They are arranged as on the server: the player's in a folder of their own, and unit sizes from the package's table."""
    (tmp_path / "player").mkdir()
    for name, (content, _) in page_files().items():
        (tmp_path / name).write_bytes(content)
    places = dict(os.environ, STUDIO_PAGE=tmp_path.as_uri())
    done = subprocess.run(["node", "--test", str(TESTS)], capture_output=True, text=True, timeout=120, check=False, env=places)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"pass \d{2}", done.stdout)


@pytest.mark.parametrize("file", sorted(PAGE.glob("*.js")), ids=lambda file: file.name)
def test_a_module_is_small_and_contacts_no_other_server(file):
    text = file.read_text()
    assert text.count("\n") < MOST_LINES
    assert text.startswith("// ")
    assert not re.search(
        r"https?://(?!www\.w3\.org)|innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function", text
    )
    for source in re.findall(r'from "([^"]+)"', text):
        assert source.startswith("./") and source.removeprefix("./") in page_files()
