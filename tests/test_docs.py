"""Every block of Python in the documentation runs, those of a page one after another; every link leads somewhere."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), ROOT / "CONTRIBUTING.md"]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.S | re.M)
LINK = re.compile(r"\]\(([^)#\s]+)")


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


# With the slow tests, and where all checks run: the other pages, each of which compiles programs of its own.
FIRST = ("README.md",)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(p, id=name_of(p), marks=[] if name_of(p) in FIRST else pytest.mark.slow)
        for p in PAGES
        if BLOCK.search(p.read_text())
    ],
)
def test_its_blocks_run(page, tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__page__"}
    text = page.read_text()
    for found in BLOCK.finditer(text):
        line = text[: found.start(1)].count("\n")
        exec(compile("\n" * line + found[1], str(page), "exec"), names)  # so that an error names the line of the page


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_its_links_lead_somewhere(page):
    for target in LINK.findall(page.read_text()):
        if not target.startswith(("http:", "https:", "mailto:")):
            assert (page.parent / target).exists(), target
