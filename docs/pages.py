"""An extension of Sphinx: what the pages of the site show besides their Markdown.

- Entries of the reference, made from docstrings (`reference_tables.py`), and the commands; tables and plots of the study `atlas`.
- The block of Python after a directive is the example of its name, and of the names listed together with it.
- Menus: a page whose list of links begins with `<!-- menu -->` shows them as cards, and is a group of the menu.
- Names of the package in the text lead to their entries, and entries to the pages that use them.
- Pictures that the code of a page has drawn are put into the page, where they have its colours.
"""

import html
import re
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import mathml
import reference_tables as reference

DOCS = Path(__file__).parent
EXPERIMENTS = DOCS.parent / "experiments"
COMMANDS, RESULTS, ATLAS, MENU = "<!-- commands -->", "<!-- results -->", "<!-- atlas -->", "<!-- menu -->"
FENCE = re.compile(r"(^```.*?^```$)", re.S | re.M)
PLAYER = re.compile(r"\]\((?!\w+:)([^)\s#]+\.html)\)")
NAME = re.compile(r"(?<![\[`])`udk\.(\w+)(\([^`]*\))?`(?!\]|`)")
ENTRY = re.compile(r"^- \[([^\]]+)\]\(([^)]+)\)(?:: (.*(?:\n  .*)*))?", re.M)
# Names that stand together, with their example.
GROUP = re.compile(rf"((?:{reference.DIRECTIVE.pattern}\n*)+)(?:^```python\n((?:.*\n)*?)```\n)?", re.M)
DRAWING = re.compile(r"^<!-- picture\n.*?^-->\n", re.S | re.M)  # the code of a picture
DRAWN = re.compile(r"^!\[([^\]]*)\]\(([^)]+\.svg)\)$", re.M)
FIRST = "getting-started.md", "tutorial.md"  # pages in which a name is looked for first
SHARED = "pictures"  # the folder of pictures that code has drawn


def setup(app: Any) -> dict:
    """Connect the extension."""
    app.add_html_math_renderer("mathml", (mathml.visit_math, None), (mathml.visit_display, None))
    app.connect("source-read", read)
    app.connect("build-finished", copy_players)
    return {"parallel_read_safe": True, "parallel_write_safe": True, "version": "1"}


def read(app: Any, name: str, source: list[str]) -> None:
    """Add to the Markdown of a page what the site shows."""
    text = source[0]
    if COMMANDS in text:
        from udkjax.cli import COMMANDS as names

        text = text.replace(COMMANDS, "\n".join(reference.command(each) for each in names))
    if RESULTS in text:
        text = text.replace(RESULTS, reference.results())
    if ATLAS in text:
        *_, tables = (EXPERIMENTS / "atlas.md").read_text(encoding="utf-8").split("\n", 4)  # after its title and links
        text = text.replace(ATLAS, f"[All plots](atlas-plots.html), by mechanism and choice, are one page.\n{tables}")
    text = GROUP.sub(lambda found: "\n".join(entries_of(found[1], found[4])), text)
    if MENU in text:
        text = menu(text, (DOCS / name).parent)
    text = DRAWING.sub("", text)
    text = DRAWN.sub(lambda found: drawn(found, (DOCS / name).parent), text)
    parts = FENCE.split(text)
    parts[::2] = [linked(part, name) for part in parts[::2]]
    source[0] = "".join(parts)


def linked(text: str, page: str) -> str:
    """Return text with links to players, and to the reference."""
    text = PLAYER.sub(r"](page:\1)", text)
    if page.startswith("reference/"):
        return text
    lines = (line if line.startswith("#") else NAME.sub(to_reference, line) for line in text.split("\n"))
    return "\n".join(lines)


def to_reference(found: re.Match[str]) -> str:
    """Return a name with a link to its entry."""
    return f"[{found[0]}](#{label(found[1])})" if found[1] in entries() else found[0]


@cache
def entries() -> set[str]:
    """Return the names that have an entry."""
    pages = (DOCS / "reference").glob("*.md")
    return {
        found[1].rpartition(".")[2] for page in pages for found in reference.DIRECTIVE.finditer(page.read_text(encoding="utf-8"))
    }


def entries_of(directives: str, example: str | None) -> Iterator[str]:
    """Iterate over the entries of names that share an example: the first shows it, and the others lead there."""
    said = f"**Example**\n\n```python\n{example}```\n" if example else ""
    for found in reference.DIRECTIVE.finditer(directives):
        yield entry(found[1], found[2], said)
        first = found[1].rpartition(".")[2] if example and "```" in said else ""
        said = f"**Example** With [`{first}`](#{label(first)}).\n" if first else said


def entry(name: str, options: str | None, example: str = "") -> str:
    """Return the entry of a public name, with an example before its methods, and where it is used."""
    own = name.rpartition(".")[2]
    text, heading, methods = reference.entry(name, options or "").partition("\n### ")
    return f"({label(own)})=\n{text}\n\n{example}{used(own)}{heading}{methods}\n"


def label(name: str) -> str:
    """Return the label of an entry; labels know no capitals, and so `design` and `Design` need different ones."""
    return f"{'class' if name[0].isupper() else 'udkjax'}.{name}"


@cache
def passages() -> list[tuple[str, str, str]]:
    """Return the page, the section and the text of each block of Python, then of each passage between them."""
    pages = DOCS / "how-to", DOCS / "theory"
    found: dict[bool, list[tuple[str, str, str]]] = {True: [], False: []}
    for page in (*(DOCS / name for name in FIRST), *(path for folder in pages for path in sorted(folder.glob("*.md")))):
        section = ""
        for part in FENCE.split(page.read_text(encoding="utf-8")):
            is_code = part.startswith("```python")
            for text in [part] if is_code else re.split(r"^(?=#+ )", DRAWING.sub("", part), flags=re.M):
                section = ([section] if is_code else [section, *re.findall(r"\A#+ (.*)$", text, re.M)])[-1]
                if is_code or not text.startswith("```"):
                    found[is_code].append((str(page.relative_to(DOCS)), section, text))
    return found[True] + found[False]


def used(name: str) -> str:
    """Return a line with links to the sections whose code, or else whose text, uses a name; empty if there are none."""
    short = rf"|`{name}\b(?!\.)" if name[0].isupper() else ""  # classes are named without their package, too
    pattern = re.compile(rf"\budk(?:jax)?\.(?:\w+\.)*{name}\b{short}")
    places = list(dict.fromkeys((page, section) for page, section, text in passages() if pattern.search(text)))
    links = [f"[{section}](../{page}{'' if is_title(page, section) else '#' + slug(section)})" for page, section in places[:4]]
    return f"\n**Used in** {', '.join(links)}.\n" if links else ""


def is_title(page: str, section: str) -> bool:
    """Return True if a section is the title of its page."""
    return (DOCS / page).read_text(encoding="utf-8").startswith(f"# {section}\n")


def slug(heading: str) -> str:
    """Return the anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def menu(text: str, folder: Path) -> str:
    """Return a page whose list of links is shown as cards, with the tree of pages that the menu shows."""
    before, _, after = text.partition(MENU)
    links = ENTRY.findall(after)
    pages = [target.partition("#")[0] for _, target, _ in links if target.endswith(".md")]
    tree = "\n".join(
        ["```{toctree}", ":hidden:", *(f"{title} <{target}>" for title, target, _ in links if target in pages), "```"]
    )
    cards = "".join(card(title, target, " ".join(said.split()), folder) for title, target, said in links)
    return f'{before}\n<div class="cards">\n{cards}</div>\n\n{ENTRY.sub("", after).strip()}\n\n{tree}\n'


def card(title: str, target: str, said: str, folder: Path) -> str:
    """Return a link with a picture of its page as HTML."""
    page = folder / target
    shown = picture(page) if page.is_file() else ""
    address = re.sub(r"\.md(?=#|$)", ".html", target)
    return f'<a class="card" href="{address}">{shown}<b>{html.escape(title)}</b><span>{html.escape(said)}</span></a>\n'


def picture(page: Path) -> str:
    """Return the first picture that the code of a page has drawn; empty if there is none."""
    found = DRAWN.search(page.read_text(encoding="utf-8"))
    return drawn(found, page.parent) if found and f"{SHARED}/" in found[2] else ""


def drawn(found: re.Match[str], folder: Path) -> str:
    """Return a picture as part of the page, so that it has its colours; others are left as they are."""
    path = (folder / found[2]).resolve()
    if path.parent.name != SHARED:
        return found[0]
    text = re.sub(r"\A.*?(?=<svg)|<metadata>.*?</metadata>", "", path.read_text(encoding="utf-8"), flags=re.S)
    text = re.sub(r"\n\s*", " ", text)
    said = html.escape(found[1])
    return f'<figure class="drawn">{text.replace("<svg", f"""<svg role="img" aria-label="{said}" """, 1).strip()}</figure>'


def copy_players(app: Any, error: Exception | None) -> None:
    """Copy pages and scripts that are not made from Markdown to their places."""
    if error is None and app.builder.format == "html":
        out = Path(app.outdir)
        for path in (path for path in (DOCS / "gallery").iterdir() if path.suffix != ".md"):
            (out / "gallery").mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, out / "gallery" / path.name)
        (out / "theory").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(EXPERIMENTS / "atlas.html", out / "theory" / "atlas-plots.html")
