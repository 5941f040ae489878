"""Convert mechanisms to the tables of a TOML file, format 1, and back, with bitwise identical numbers."""

import math
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from udkjax.annotations import TomlTable
from udkjax.arrays import is_traced
from udkjax.scene.elements.fields import vector_as_angle
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import LARGEST_INTEGER, Mistakes, SceneEntry, SceneError, find_class, problems_of
from udkjax.scene.tables.element_setup import name_elements
from udkjax.scene.tables.schema import CLASSES_BY_TYPE, CLASSES_WITHOUT_TYPE, SECTIONS, build, is_in_format, table_of, type_name
from udkjax.wording import abbreviate, unknown_key

FORMAT_VERSION = 1  # version of the format of scenes with bodies and joints


def mechanism_text(mechanism: Mechanism) -> str:
    """Return a mechanism as the text of a TOML file; raise a `SceneError` if the format cannot express it."""
    check_known(mechanism, mechanism.name)
    entries = [
        SceneEntry(section, index, name, type(element), table_of(element))
        for section, elements in mechanism.groups.items()
        for index, (name, element) in enumerate(elements.items())
    ]
    problems = [problem for entry in entries for problem in check_classes(entry.where, entry.cls or object, entry.table)]
    problems.extend(problems_of(entries, mechanism.gravity))
    if problems:
        raise SceneError(problems, mechanism.name)
    title = {"name": mechanism.name} if mechanism.name else {}
    lines = key_lines({"format": FORMAT_VERSION, **title, "gravity": mechanism.gravity})
    for entry in entries:
        lines += ["", f"[[{entry.section}]]", *key_lines({"name": entry.name, **type_key(entry.cls or object), **entry.table})]
    return "\n".join(lines) + "\n"


def check_known(tree: eqx.Module, name: str) -> None:
    """Raise a `SceneError` if numbers of a mechanism or a drawing are traced; `name` is its name, for the message."""
    if is_traced(tree):
        raise SceneError(["its numbers are traced: write it outside of jit, vmap and grad"], name)


def mechanism_of_tables(scene: Mapping[str, Any], source: str) -> Mechanism:
    """Return the mechanism described by the tables of a file; raise a `SceneError` that names the file."""
    entries, problems = [], list(head_mistakes(scene, ("format", "name", "gravity", *SECTIONS)))
    for section in SECTIONS:
        entries.extend(read_section(section, scene.get(section, []), problems, CLASSES_WITHOUT_TYPE.get(section)))
    axes = ("axis", "to_axis")
    entries = [e._replace(table={k: vector_as_angle(x) if k in axes else x for k, x in e.table.items()}) for e in entries]
    gravity = scene.get("gravity", [0.0, -9.81])
    problems.extend(problems_of(entries, gravity))
    if problems:
        raise SceneError(problems, source)
    elements: dict[str, dict[str, Any]] = {section: {} for section in SECTIONS}
    for entry in entries:
        elements[entry.section][entry.name] = build(entry.cls, entry.table)
    return Mechanism(elements["body"], elements["joint"], elements["driver"], elements["force"], gravity, scene.get("name", ""))


def head_mistakes(scene: TomlTable, expected: Collection[str]) -> Iterator[str]:
    """Iterate over the mistakes in the top-level keys of a file."""
    if not isinstance(scene.get("name", ""), str):
        yield f"name: must be a string, not {abbreviate(scene['name'])}"
    for key in scene:
        if key not in expected:
            is_plural = key.endswith("s") and key[:-1] in expected
            yield f"{key}: " + (f"unknown key; write [[{key[:-1]}]]" if is_plural else unknown_key(key, expected))


def read_section(
    section: str, tables: object, problems: list[str], cls: type | None = None, counted: bool = False
) -> Iterator[SceneEntry]:
    """Iterate over the entries of one section; if it is not a list of tables, there are none, and a problem is added.

    The class of an entry is `cls`, or follows from its `type`. If `counted`, unnamed entries are numbered: SECTION1, ...
    """
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        problems.append(f"{section}: must be a list of tables; write [[{section}]] above each")
        return
    names: Sequence[object] = [table.get("name") for table in tables]
    if section == "force":
        names = name_elements([str(table.get("type")) for table in tables], names)
    for index, (name, table) in enumerate(zip(names, tables, strict=True)):
        name = f"{section}{index + 1}" if name is None and counted else name
        entry = SceneEntry(section, index, name, cls, {key: value for key, value in table.items() if key != "name"})
        if section in CLASSES_BY_TYPE:
            table_class, problem = find_class(entry.where, CLASSES_BY_TYPE[section], table)
            table = {key: value for key, value in entry.table.items() if key != "type"}
            entry = entry._replace(cls=table_class, problem=problem, table=table)
        yield entry


def check_classes(where: str, cls: type, table: TomlTable) -> Iterator[str]:
    """Iterate over messages about classes that a file cannot hold: the class `cls` of an element, and those of its modules."""
    if not is_in_format(cls):
        yield f"{where}: a scene file has no type for the class {cls.__name__}; keep this scene in Python"
    for name, value in table.items():
        if isinstance(value, eqx.Module):
            yield from check_classes(f"{where}.{name}", type(value), table_of(value))


def type_key(cls: type) -> dict[str, str]:
    """Return the key `type` with its value for the class of an element; empty for classes whose tables have no `type`."""
    return {} if cls in CLASSES_WITHOUT_TYPE.values() else {"type": type_name(cls)}


# tomli-w writes one number per line: 174 lines for the paper's linkage, instead of 75.
def key_lines(table: TomlTable) -> list[str]:
    """Return a table as lines of TOML, one per key."""
    return [f"{key if re.fullmatch('[A-Za-z0-9_-]+', key) else _string(key)} = {toml(value)}" for key, value in table.items()]


def toml(value: object) -> str:
    """Return a value as TOML; floats are as short as possible, but read back as the same floats."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(toml(item) for item in value)}]"
    if isinstance(value, dict):
        return f"{{{', '.join(key_lines(value))}}}"
    if isinstance(value, eqx.Module):
        return f"{{{', '.join(key_lines({**type_key(type(value)), **table_of(value)}))}}}"
    return toml(np.asarray(value, dtype=float).tolist())


def _string(text: str) -> str:
    escaped = re.sub(r'[\\"]', lambda match: "\\" + match[0], text)
    return '"' + re.sub(r"[\x00-\x1f\x7f]", lambda match: f"\\u{ord(match[0]):04x}", escaped) + '"'


MOST_KEY_PARTS = 100  # more, and the time to read them, which grows with the square, would be noticed
_KEY_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_KEY_PART}(?:[ \t]*+\.[ \t]*+{_KEY_PART}){{{MOST_KEY_PARTS},}}")


def parse_toml(text: str, source: str, error: type[Mistakes]) -> dict[str, Any]:
    """Parse a TOML text.

    Args:
        text: The text; a leading byte order mark is skipped.
        source: The file that contains it, or empty.
        error: The class of the error.

    Returns:
        The tables.

    Raises:
        Mistakes: The text is not TOML, nests too deeply, or has numbers or keys that are far too long; of the class `error`.
    """
    if (key := _LONG_KEY.search(text)) is not None:
        line = text.count("\n", 0, key.start()) + 1
        raise error([f"line {line}: a key with more than {MOST_KEY_PARTS} parts between dots; three are enough"], source)
    try:
        return _without_huge_integers(tomllib.loads(text.removeprefix("\ufeff")))
    except RecursionError:
        raise error(["not valid here: lists or tables nest too deeply to be read; three levels are enough"], source) from None
    except ValueError as problem:  # not TOML, or an integer with more digits than Python reads
        raise error([f"not valid TOML: {problem}"], source) from None


def _without_huge_integers(value: Any) -> Any:
    """Return tables with integers beyond the range of floats as infinite numbers, as TOML reads 1e400, to be refused as these."""
    if isinstance(value, dict):
        return {key: _without_huge_integers(x) for key, x in value.items()}
    if isinstance(value, list):
        return [_without_huge_integers(x) for x in value]
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        return math.inf if value > 0 else -math.inf
    return value


def is_xml(text: str) -> bool:
    """Return True if a string begins like XML."""
    return text.removeprefix("\ufeff").lstrip().startswith("<")
