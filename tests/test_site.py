"""The site: its menu is short and holds every page, questions lead to sections, and entries say what docstrings say."""

import importlib
import re
import sys
from pathlib import Path

import pytest

import udkjax

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))
pages = importlib.import_module("pages")
reference = importlib.import_module("reference_tables")
MOST_ENTRIES = 9  # of a group of the menu
GROUPS = sorted((DOCS / "guide").glob("*.md"))
QUESTIONS = DOCS / "questions.md"
OUTSIDE = {
    "index.md",
    "getting-started.md",
    "questions.md",
    "gallery/index.md",
}  # of all groups: they stand in the menu themselves


def targets(page: Path) -> list[Path]:
    return [(page.parent / target.partition("#")[0]).resolve() for _, target, _ in pages.ENTRY.findall(page.read_text())]


@pytest.mark.parametrize("group", GROUPS, ids=lambda path: path.stem)
def test_a_group_of_the_menu_is_short(group):
    text = group.read_text()
    assert pages.MENU in text
    assert 1 < len(pages.ENTRY.findall(text)) <= MOST_ENTRIES
    assert f"guide/{group.stem}\n" in (DOCS / "index.md").read_text()


def test_every_page_stands_once_in_the_menu():
    listed = [str(page.relative_to(DOCS)) for group in GROUPS for page in targets(group)]
    there = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")} - {f"guide/{group.name}" for group in GROUPS}
    assert sorted(listed) == sorted(there - OUTSIDE)


def test_a_group_of_the_menu_lists_its_pages_as_cards_and_in_the_tree():
    shown = pages.menu("# Two\n\n<!-- menu -->\n\n- [One](a.md): first,\n  and long.\n- [Two](b.md): second.\n", DOCS / "nowhere")
    assert "One <a.md>\nTwo <b.md>\n```" in shown
    assert '<a class="card" href="a.html"><b>One</b><span>first, and long.</span></a>' in shown
    assert "- [" not in shown


def slug(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_questions_lead_to_sections():
    links = re.findall(r"^- \[.*\?\]\(([^)]+)\)$", QUESTIONS.read_text(), re.M)
    assert len(links) >= 80
    for link in links:
        page, _, section = link.partition("#")
        headings = re.findall(r"^#+ (.*)$", pages.FENCE.sub("", (DOCS / page).read_text()), re.M)
        assert not section or section in map(slug, headings), link


@pytest.mark.parametrize(
    "words",
    [
        "time ratio",
        "Grashof",
        "degrees of freedom",
        "singular",
        "stick-slip",
        "batch",
        "gradient",
        "posterior",
        "transmission angle",
    ],
)
def test_a_reader_who_searches_finds_a_question(words):
    assert words in QUESTIONS.read_text()


# --- entries of the reference


def test_the_entry_of_a_function_has_its_arguments_results_and_errors():
    text = reference.entry("udkjax.assemble")
    assert text.startswith(
        "## assemble\n\n```python\nudk.assemble(mechanism, t=0.0, state=None, throw=True, analysis=None, given=None)\n"
    )
    assert "| `t` | `NumberLike` | `0.0` | time (s). |" in text
    assert "**Returns** A `State`" in text
    assert "- `AssemblyError`: joints stay open" in text


def test_the_entry_of_a_class_has_its_fields_and_methods():
    text = reference.entry("udkjax.Solution")
    assert "### Solution.path\n\n```python\nudk.Solution.path(body, point=(0.0, 0.0))\n```" in text
    assert "### Solution.result\n" in text


@pytest.mark.parametrize("name", sorted(set(udkjax.__all__) - {"pinv", "equations", "library", "GROUND"}))
def test_every_public_name_has_an_entry_that_describes_it(name):
    text = reference.entry(f"udkjax.{name}")
    assert len(text.split()) > 8


def test_a_name_in_the_text_leads_to_its_entry():
    assert pages.linked("`udk.simulate` and `udk.nothing`", "how-to/x") == "[`udk.simulate`](#udkjax.simulate) and `udk.nothing`"
    assert pages.linked("`udk.Design` of [`udk.design`](a.md)", "a") == "[`udk.Design`](#class.Design) of [`udk.design`](a.md)"
    assert pages.linked("[one](a/b.html)", "index") == "[one](page:a/b.html)"
