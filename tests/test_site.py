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
mathml = importlib.import_module("mathml")
pages = importlib.import_module("pages")
pictures = importlib.import_module("pictures")
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


def test_questions_lead_to_sections():
    links = re.findall(r"^- \[.*\?\]\(([^)]+)\)$", QUESTIONS.read_text(), re.M)
    assert len(links) >= 80
    for link in links:
        page, _, section = link.partition("#")
        headings = re.findall(r"^#+ (.*)$", pages.FENCE.sub("", (DOCS / page).read_text()), re.M)
        assert not section or section in map(pages.slug, headings), link


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
        "worked solution",
        "C99",
        "FMU",
        "tolerance",
        "shape of a link",
        "draws a curve",
        "compare models",
        "exercise",
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


def test_every_name_has_an_example():
    """The documentation's tests run them."""
    groups = [found for page in (DOCS / "reference").glob("*.md") for found in pages.GROUP.finditer(page.read_text())]
    without = [name for found in groups if not found[4] for name, _ in reference.DIRECTIVE.findall(found[1])]
    assert without == []
    assert max(len(line) for found in groups for line in found[4].splitlines()) <= 88


def test_an_entry_leads_to_where_its_name_is_used():
    """Each group of names has a how-to; errors have their page."""
    unused = []
    for page in (DOCS / "reference").glob("*.md"):
        for found in pages.GROUP.finditer(page.read_text()) if page.name != "errors.md" else ():
            names = [name.rpartition(".")[2] for name, _ in reference.DIRECTIVE.findall(found[1])]
            unused += [] if any(map(pages.used, names)) else [names]
    assert unused == []
    assert pages.used("workspace") == "\n**Used in** [Limits and branches](../how-to/kinematics.md#limits-and-branches).\n"


def test_names_that_stand_together_share_an_example():
    text = "::: udkjax.travel\n::: udkjax.Travel\n\n```python\nprint(1)\n```\n"
    one, other = pages.entries_of(pages.GROUP.match(text)[1], pages.GROUP.match(text)[4])
    assert "**Example**\n\n```python\nprint(1)\n```\n" in one
    assert "**Example** With [`travel`](#udkjax.travel)." in other and "print(1)" not in other


def test_a_name_in_the_text_leads_to_its_entry():
    assert pages.linked("`udk.simulate` and `udk.nothing`", "how-to/x") == "[`udk.simulate`](#udkjax.simulate) and `udk.nothing`"
    assert pages.linked("`udk.Design` of [`udk.design`](a.md)", "a") == "[`udk.Design`](#class.Design) of [`udk.design`](a.md)"
    assert pages.linked("[one](a/b.html)", "index") == "[one](page:a/b.html)"


# --- equations

EQUATION = re.compile(r"\$\$.*?\$\$|\$[^$\n]+\$", re.S)
BOX = re.compile(r"(?:^\n|\A)((?: {4}(?! *[-*|]).*\n)+)|`([^`\n]+)`", re.M)
TYPED = re.compile(r"Psi_?\w* [-+=]|[-+=] Psi|\^\+|\^\(-|\^T\b|\b(?:lambda|gamma|mu|rho)(?:\(\w\))? = ")


def untypeset(text: str) -> list[str]:
    """Return the equations of a page that stand in a code box, or as plain text."""
    prose = EQUATION.sub("", pages.FENCE.sub("", text))
    boxes = ["".join(found) for found in BOX.findall(prose)]
    plain = [found[0] for found in mathml.EXPRESSION.finditer(BOX.sub("\n", prose)) if mathml.inline(found) != found[0]]
    return plain + [box for box in boxes if TYPED.search(box)]


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: str(page.relative_to(DOCS)))
def test_its_equations_are_typeset(page):
    assert untypeset(page.read_text()) == []


def test_an_equation_that_is_not_typeset_is_noticed():
    assert untypeset("By Psi_q a = gamma it moves.") == ["Psi_q a = gamma"]
    assert untypeset("It is\n\n    mu(s) = c tanh(4 x)\n\nhere.") == ["    mu(s) = c tanh(4 x)\n"]
    assert untypeset("`a = a_F + M^(-1/2) D^+ b`") == ["a = a_F + M^(-1/2) D^+ b"]
    assert untypeset(r"$a = M^{-1} F$ in m/s^2 of `mu`") == []


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("M a + Psi_q^T lambda = F", r"M a + \Psi_{q}^T \lambda = F"),
        ("a = a_F + M^(-1/2) D^+ b", r"a = a_{F} + M^{-1/2} D^+ b"),
        ("Psi_ddot + 2 alpha Psi_dot + beta^2 Psi = 0", r"\ddot{\Psi} + 2 \alpha \dot{\Psi} + \beta^2 \Psi = 0"),
        ("K = -F_q + (lambda^T Psi)_qq", r"K = -F_{q} + (\lambda^T \Psi)_{qq}"),
        ("c0 + c1 t + c2 t^2 + ...", r"c_{0} + c_{1} t + c_{2} t^2 + \dots"),
    ],
)
def test_equations_of_docstrings_are_typeset(said, shown):
    assert (
        mathml.typeset(f"With {said}, a run of a mechanism is {said}.") == f"With ${shown}$, a run of a mechanism is ${shown}$."
    )


def test_a_long_equation_may_end_its_lines_between_terms():
    short, long = "a = b + c", r"a = (b + c) + \frac{d + e}{f} + " + "g" * 80
    assert mathml.terms(short) == [short]
    assert mathml.terms(long) == ["a = (b + c)", r"+ \frac{d + e}{f}", "+ " + "g" * 80]


def test_names_in_equations_have_underscores():
    pytest.importorskip("latex2mathml", reason="sh install.sh --docs brings latex2mathml")
    assert r"\_" not in mathml.mathml(r"\text{static\_coefficient}")


def test_units_and_code_of_docstrings_are_no_equations():
    said = "A rate (m/s^2) of `Psi_q a = gamma` in N m, a motion of I and 5 kg m^2."
    assert mathml.typeset(said) == said


@pytest.mark.parametrize("name", ["Baumgarte", "accelerations", "kinematics", "modes", "equilibrium", "reactions", "Friction"])
def test_entries_show_their_equations_typeset(name):
    assert EQUATION.search(reference.entry(f"udkjax.{name}"))


# --- pictures

DIMENSIONLESS = {"rtol = atol", "step of the difference quotient", "error", "singular value"}  # labels of axes without a unit


def test_pages_show_what_they_compute():
    shown = [*(DOCS / "how-to").glob("*.md"), *(DOCS / "theory").glob("*.md")]
    without = {str(page.relative_to(DOCS)) for page in shown if not re.search(r"^!\[", page.read_text(), re.M)}
    assert without == set()


@pytest.mark.parametrize("page", [p for p in DOCS.rglob("*.md") if pictures.PICTURE.search(p.read_text())], ids=lambda p: p.stem)
def test_a_picture_has_numbers_units_and_an_alternative_text(page):
    for code, said, target in pictures.PICTURE.findall(page.read_text()):
        compile(code, "picture", "exec")
        assert len(said.split()) >= 8
        for axes in pictures.stored(page.parent / target):
            assert axes["curves"] and all(axes["labels"])
            assert [name for name in axes["labels"][1:] if "(" not in name and name not in DIMENSIONLESS] == []
        text = pages.drawn(pages.DRAWN.search(f"![{said}]({target})"), page.parent)
        assert 'role="img" aria-label=' in text and "<metadata>" not in text and "currentColor" in text


def test_a_picture_that_is_out_of_date_is_noticed(tmp_path):
    figure = pictures.draw("axes.plot([0, 1], [0, height])\naxes.set(xlabel='time (s)')", {"height": 2.0})
    pictures.save(figure, tmp_path / "one.svg")
    there = pictures.stored(tmp_path / "one.svg")
    assert pictures.differ(pictures.numbers(figure), there) == []
    other = pictures.draw("axes.plot([0, 1], [0, height])\naxes.set(xlabel='time (s)')", {"height": 2.1})
    assert pictures.differ(pictures.numbers(other), there) == ["curves of ['', 'time (s)', '']"]
