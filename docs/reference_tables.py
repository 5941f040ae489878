"""Entries of the reference: signature, description, arguments or fields, results and errors of public names, and the commands.

Their meanings come from the docstring of a class (Args, Attributes) or from the comment on the line of a field, the rest from its
signature. Commands are functions of their options, with the same sections.
"""

import dataclasses
import importlib
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Iterator
from enum import Enum
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from mathml import typeset

from udkjax import cli

DIRECTIVE = re.compile(r"^::: (udkjax[\w.]*)\n(?: {4}(options: .*)\n)?", re.M)
ARRAY = re.compile(r"(?:jaxtyping\.)?(?:Float|Int|Bool)\[[\w.]*(?:Array|ArrayLike|ndarray|Union\[.*?\]), *(['\"])(.*?)\1\]")
MODULE = re.compile(r"\b(?:udkjax|collections|typing|jax|numpy|pathlib|diffrax|optimistix|scipy)(?:\.\w+)*\.(?=\w)")
SECTION = re.compile(r"^(?=(?:Args|Attributes|Returns|Raises|Source|Yields):\n)", re.M)
RAISED = re.compile(r"^(\w+(?:, \w+)*): (.*(?:\n +.*)*)", re.M)
WIDTH = 86  # columns of a call
BAR = "\\_"  # which makes nothing bold
ITEM = re.compile(r"^ {4}(\w+(?:, \w+)*): (.*(?:\n {5,}.*)*)", re.M)


def command(name: str) -> str:
    """Return the section of a command in Markdown: description and options."""
    function = cli.command(name)
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


def results() -> str:
    """Return the table of the results of runs with their causes."""
    from udkjax.integrate.solution import CAUSES, Result

    rows = [f"| `{each.name}` | {CAUSES.get(each, 'the run reached its end')} |" for each in Result]
    return "\n".join(["| Result | Meaning, and cure |", "|---|---|", *rows])


def resolve(name: str) -> Any:
    """Return the object of a full name."""
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def entry(name: str, options: str = "") -> str:
    """Return the entry of a public name in Markdown; `options` may name inherited methods that it shows."""
    it = resolve(name)
    lines = [f"## {name.rpartition('.')[2]}", "", *signature(name.removeprefix("udkjax."), it), *description(it)]
    if inspect.isclass(it):
        lines += [table(it), *(line for method in methods(it, options) for line in method)]
    return "\n".join(lines)


def signature(name: str, it: Any) -> list[str]:
    """Return a block with the call of a function or class; an enumeration has none."""
    try:
        parameters = list(inspect.signature(it).parameters.values())
    except (TypeError, ValueError):
        return []
    if inspect.isclass(it) and (issubclass(it, Enum | Exception) or it.__init__ is object.__init__):
        return []
    words = []
    for each in (p for p in parameters if p.name not in ("self", "cls")):
        star = {each.VAR_POSITIONAL: "*", each.VAR_KEYWORD: "**"}.get(each.kind, "")
        shown = default_text(it if inspect.isclass(it) else type, each.name, each).strip("`")
        words.append(star + each.name + ("" if shown == "required" or star else f"={shown or '...'}"))
    text = f"udk.{name}({', '.join(words)})"
    return [
        "```python",
        textwrap.fill(text, WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False),
        "```",
        "",
    ]


def description(it: Any) -> list[str]:
    """Return a docstring in Markdown, with a table of a function's arguments."""
    lines = []
    for section in SECTION.split(inspect.cleandoc(it.__doc__ or "")):
        heading, _, rest = section.partition(":\n")
        text = textwrap.dedent(rest)
        if heading == "Args":
            lines += [] if inspect.isclass(it) else [arguments(it), ""]
        elif heading == "Raises":
            lines += [
                "**Raises**",
                "",
                *(f"- `{kind}`: {typeset(' '.join(said.split()))}" for kind, said in RAISED.findall(text)),
                "",
            ]
        elif heading in ("Returns", "Yields", "Source"):
            lines += [f"**{heading}** {typeset(text.strip())}", ""]
        elif heading != "Attributes":
            lines += [typeset(section.strip()), ""]
    return lines


def arguments(function: Any) -> str:
    """Return the table of a function's arguments in Markdown."""
    said, rows = sections(function), []
    for name, parameter in inspect.signature(function).parameters.items():
        if name in said:
            meaning = said[name].replace("|", "\\|")
            rows.append(f"| `{name}` | {type_text(parameter.annotation)} | {default_text(type, name, parameter)} | {meaning} |")
    return "\n".join(["| Name | Type | Default | Meaning |", "|---|---|---|---|", *rows]) if rows else ""


def methods(cls: type, options: str) -> Iterator[list[str]]:
    """Iterate over the entries of a class's public methods and properties that have docstrings."""
    inherited = re.findall(r"\w+", options.partition("[")[2])
    names = [name for name in vars(cls) if not name.startswith("_") or name == "__call__"]
    for name in [*names, *(each for each in inherited if each not in names)]:
        it = inspect.getattr_static(cls, name)
        function = it.fget if isinstance(it, property) else getattr(it, "func", getattr(it, "__func__", it))
        function = inspect.unwrap(getattr(function, "method", function))
        if not inspect.isfunction(function) or not function.__doc__ or function.__doc__.startswith("For internal use"):
            continue
        call = [] if isinstance(it, property) or hasattr(it, "func") else signature(f"{cls.__name__}.{name}", function)
        yield [f"### {cls.__name__}.{name.replace('__', BAR * 2)}", "", *call, *description(function)]


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
    if get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) in (Union, UnionType):
        return " or ".join(dict.fromkeys(type_text(each).replace("NoneType", "None") for each in get_args(annotation)))
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
