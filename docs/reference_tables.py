"""A hook of MkDocs: adds a table of arguments or fields to each public class of the reference, and makes the page of commands.

It also puts the tables and plots of the study `atlas` into the site.

Their meanings come from the docstring of a class (Args, Attributes) or from the comment on the line of a field, the rest from its
signature. Commands are functions of their options, with the same sections.
"""

import dataclasses
import importlib
import inspect
import io
import re
import tokenize
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args, get_origin

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

DIRECTIVE = re.compile(r"^::: (udkjax[\w.]*\.([A-Z]\w*))$", re.M)
ARRAY = re.compile(r"(?:jaxtyping\.)?(?:Float|Int|Bool)\[[\w.]*(?:Array|ArrayLike|ndarray|Union\[.*?\]), *(['\"])(.*?)\1\]")
MODULE = re.compile(r"\b(?:udkjax|collections|typing|jax|numpy|pathlib|diffrax|optimistix|scipy)(?:\.\w+)*\.(?=\w)")
COMMANDS, ATLAS = "<!-- commands -->", "<!-- atlas -->"
EXPERIMENTS = Path(__file__).parents[1] / "experiments"
ITEM = re.compile(r"^ {4}(\w+(?:, \w+)*): (.*(?:\n {5,}.*)*)", re.M)


def on_page_markdown(markdown: str, **_: object) -> str:
    """Add a table after each class on a page of the reference, and replace `COMMANDS` by all commands, `ATLAS` by its tables."""
    if COMMANDS in markdown:
        from udkjax.cli import COMMANDS as names

        markdown = markdown.replace(COMMANDS, "\n".join(command(name) for name in names))
    if ATLAS in markdown:
        *_, tables = (EXPERIMENTS / "atlas.md").read_text(encoding="utf-8").split("\n", 4)  # after its title and links
        markdown = markdown.replace(ATLAS, f"[All plots](atlas-plots.html), by mechanism and choice, are one page.\n{tables}")
    return DIRECTIVE.sub(lambda found: found[0] + OPTIONS + table(resolve(found[1])), markdown)


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Add the page of plots."""
    from mkdocs.structure.files import File  # which tests of this module do without

    files.append(File.generated(config, "theory/atlas-plots.html", abs_src_path=str(EXPERIMENTS / "atlas.html")))
    return files


def command(name: str) -> str:
    """Return the section of a command in Markdown: description and options."""
    function = getattr(importlib.import_module(f"udkjax.cli.{name}"), name)
    said, text = sections(function), inspect.getdoc(function) or ""
    lines = [
        f"## udkjax {name}\n",
        text.partition("\nArgs:\n")[0].strip(),
        "",
        "| Option | Type | Default | Meaning |",
        "|---|---|---|---|",
    ]
    for option, parameter in inspect.signature(function).parameters.items():
        told = [(getattr(m, "name", None), getattr(m, "help", None)) for m in getattr(parameter.annotation, "__metadata__", ())]
        spelled = next((name for name, _ in told if name), option)
        meaning = next((text for _, text in told if text), said.get(option, ""))  # an option of many commands says it once
        words = f"`{option}`" if parameter.kind is parameter.POSITIONAL_ONLY else f"`--{spelled.replace('_', '-')}`"
        kind = type_text(
            get_args(parameter.annotation)[0] if get_origin(parameter.annotation) is Annotated else parameter.annotation
        )
        lines.append(f"| {words} | {kind} | {default_text(type, option, parameter)} | {meaning} |")
    return "\n".join([*lines, ""])


OPTIONS = "\n    options: {show_docstring_parameters: false, show_docstring_attributes: false}\n\n"


def resolve(name: str) -> type:
    """Return the class of a full name."""
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def table(cls: type) -> str:
    """Return the table of a class in Markdown; empty if it has no arguments or fields."""
    if issubclass(cls, Enum):
        lines = [f"| `{member.name}` | {comments(cls).get(member.name) or str(member)} |" for member in cls]
        return "\n".join(["| Member | Meaning |", "|---|---|", *lines, ""])
    rows = list(described(cls))
    if not rows:
        return ""
    lines = [f"| `{name}` | {kind} | {default} | {meaning} |" for name, kind, default, meaning in rows]
    return "\n".join(["| Name | Type | Default | Meaning |", "|---|---|---|---|", *lines, ""])


def described(cls: type) -> Iterator[tuple[str, str, str, str]]:
    """Iterate over name, type, default and meaning of the arguments of a class's constructor."""
    if issubclass(cls, Enum) or (cls.__init__ is object.__init__ and not hasattr(cls, "_fields")):
        return
    mentioned = set(re.findall(r"`(\w+)`", inspect.getdoc(cls) or ""))
    meanings = dict.fromkeys(mentioned, "see above") | comments(cls) | sections(cls)
    fields = {field.name: field.type for field in dataclasses.fields(cls)} if dataclasses.is_dataclass(cls) else {}
    for name, parameter in inspect.signature(cls).parameters.items():
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            kind = type_text(fields.get(name, parameter.annotation))  # a field has the shape after conversion
            yield name, kind, default_text(cls, name, parameter), meanings.get(name, "").replace("|", "\\|")


def sections(cls: object) -> dict[str, str]:
    """Return the descriptions of arguments and attributes in the docstrings of a class and its bases, or of a function."""
    found: dict[str, str] = {}
    for each in reversed(getattr(cls, "__mro__", (cls,))):
        for doc in (each.__dict__.get("__doc__") or each.__doc__, getattr(each.__dict__.get("__init__"), "__doc__", None)):
            for section in re.split(r"^(?=\w+:\n)", inspect.cleandoc(doc or ""), flags=re.M):
                if section.startswith(("Args:", "Attributes:")):
                    found |= {name: " ".join(text.split()) for names, text in ITEM.findall(section) for name in names.split(", ")}
    return found


def comments(cls: type) -> dict[str, str]:
    """Return the comments on the lines of fields of a class and its bases."""
    found: dict[str, str] = {}
    for each in reversed(cls.__mro__):
        try:
            source = inspect.getsource(each)
        except (OSError, TypeError):
            continue
        name, depth = "", 0
        for token in tokenize.generate_tokens(io.StringIO(inspect.cleandoc("\n" + source)).readline):
            if token.type == tokenize.INDENT:
                depth += 1
            elif token.type == tokenize.DEDENT:
                depth -= 1
            elif token.type == tokenize.NAME and depth == 1 and (field := re.match(r"    (\w+)(?::| =) ", token.line)):
                name = field[1]
            elif token.type == tokenize.COMMENT and depth == 1 and name and not token.line.lstrip().startswith("#"):
                text = re.sub(r"#?\s*(pyright: ignore\S*|noqa\S*)\s*#?", "", token.string).lstrip("# ").strip()
                found |= {name: text} if text else {}
    return found


def type_text(annotation: object) -> str:
    """Return a type in words: arrays by their shapes."""
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    text = MODULE.sub("", ARRAY.sub(shape, text)).replace("~", "")
    return "" if annotation is inspect.Parameter.empty else f"`{text}`".replace(" | ", " or ")


def shape(found: re.Match[str]) -> str:
    """Return an array's shape in words."""
    sizes = found[2].split()
    return "number" if not sizes else f"array ({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"


def default_text(cls: type, name: str, parameter: inspect.Parameter) -> str:
    """Return a default as written in code."""
    value = parameter.default
    if value is inspect.Parameter.empty:
        return "required"
    if dataclasses.is_dataclass(cls):  # whose signature has a factory instead of the default
        field = {f.name: f for f in dataclasses.fields(cls)}.get(name)
        value = field.default if field is not None and field.default is not dataclasses.MISSING else value
    return f"`{value!r}`" if len(repr(value)) < 40 and "<" not in repr(value) else ""
