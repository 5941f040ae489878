"""The scene format: mechanisms as TOML files, version 1, read and written; reading gives back the numbers written, bit by bit."""

import os
import re
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from udkjax.scene.arguments import checked
from udkjax.scene.checks import SceneEntry, SceneError, abbreviate, find_class, problems_of, suggestion
from udkjax.scene.fields import Table
from udkjax.scene.mechanism import Mechanism, name_elements
from udkjax.scene.schema import CLASSES_BY_TYPE, CLASSES_WITHOUT_TYPE, SECTIONS, is_in_format, keys, table_of, type_name

FORMAT_VERSION = 1


def load(path: str | os.PathLike[str]) -> Mechanism:
    """Read a mechanism from a TOML file.

    Args:
        path: The file.

    Returns:
        The mechanism.

    Raises:
        SceneError: The scene is wrong; the error lists every mistake in it.
        OSError: The file cannot be read.
    """
    try:
        return _read(Path(path).read_text(encoding="utf-8"), os.fspath(path))
    except UnicodeDecodeError as error:
        raise SceneError([f"not a text file in UTF-8 ({error})"], os.fspath(path)) from None


def loads(text: str) -> Mechanism:
    """Read a mechanism from the text of a TOML file, as `load` does.

    Args:
        text: The text.

    Returns:
        The mechanism.

    Raises:
        SceneError: The scene is wrong; the error lists every mistake in it.
    """
    return _read(text, "")


@checked
def save(mechanism: Mechanism, path: str | os.PathLike[str]) -> None:
    """Write a mechanism to a TOML file, whole or not at all.

    Args:
        mechanism: The scene.
        path: The file; an older one is replaced.

    Raises:
        SceneError: The format cannot hold the mechanism, as in `dumps`.
        OSError: The file cannot be written.
    """
    text, path = dumps(mechanism), Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8", newline="\n")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@checked
def dumps(mechanism: Mechanism) -> str:
    """Return the mechanism as the text of a TOML file; reading it gives the same numbers back, bit by bit.

    Args:
        mechanism: The scene.

    Returns:
        The text.

    Raises:
        SceneError: The format cannot hold the mechanism: classes of the user's own, traced numbers, batches of numbers.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(mechanism)):
        raise SceneError(["its numbers are traced: write it outside of jit, vmap and grad"], mechanism.name)
    groups = {"body": mechanism.bodies, "joint": mechanism.joints, "driver": mechanism.drivers, "force": mechanism.forces}
    entries = [
        SceneEntry(section, index, name, type(element), table_of(element))
        for section, elements in groups.items()
        for index, (name, element) in enumerate(elements.items())
    ]
    problems = [problem for entry in entries for problem in _check_classes(entry.where, entry.cls or object, entry.table)]
    problems.extend(problems_of(entries, mechanism.gravity))
    if problems:
        raise SceneError(problems, mechanism.name)
    title = {"name": mechanism.name} if mechanism.name else {}
    lines = _lines({"format": FORMAT_VERSION, **title, "gravity": mechanism.gravity})
    for entry in entries:
        lines += ["", f"[[{entry.section}]]", *_lines({"name": entry.name, **_type_of(entry.cls or object), **entry.table})]
    return "\n".join(lines) + "\n"


def _read(text: str, source: str) -> Mechanism:
    try:
        scene = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError([f"not valid TOML: {error}"], source) from None
    entries, problems = [], list(_check_head(scene))
    for section in SECTIONS:
        entries.extend(_read_section(section, scene.get(section, []), problems))
    gravity = scene.get("gravity", [0.0, -9.81])
    problems.extend(problems_of(entries, gravity))
    if problems:
        raise SceneError(problems, source)
    made: dict[str, dict[str, Any]] = {section: {} for section in SECTIONS}
    for entry in entries:
        made[entry.section][entry.name] = _build(entry.cls, entry.table)
    return Mechanism(made["body"], made["joint"], made["driver"], made["force"], gravity, scene.get("name", ""))


def _check_head(scene: Table) -> Iterator[str]:
    """Iterate over the mistakes at the top of a file."""
    version = scene.get("format")
    if version is None:
        yield f"format: missing; write format = {FORMAT_VERSION}"
    elif version is True or version != FORMAT_VERSION:
        yield f"format: this version of udkjax reads format {FORMAT_VERSION}, not {abbreviate(version)}"
    if not isinstance(scene.get("name", ""), str):
        yield f"name: must be a string, is {abbreviate(scene['name'])}"
    expected = ("format", "name", "gravity", *SECTIONS)
    yield from (f"{key}: unknown key{suggestion(key, expected)}" for key in scene if key not in expected)


def _read_section(section: str, tables: object, problems: list[str]) -> Iterator[SceneEntry]:
    """Iterate over the entries of one section, their names and types read; adds to `problems` if it is not a section at all."""
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        problems.append(f"{section}: must be a list of tables; write [[{section}]] above each")
        return
    names: Sequence[object] = [table.get("name") for table in tables]
    if section == "force":
        names = name_elements([str(table.get("type")) for table in tables], names)
    for index, (name, table) in enumerate(zip(names, tables, strict=True)):
        entry = SceneEntry(
            section, index, name, CLASSES_WITHOUT_TYPE.get(section), {key: value for key, value in table.items() if key != "name"}
        )
        if section in CLASSES_BY_TYPE:
            cls, problem = find_class(entry.where, CLASSES_BY_TYPE[section], table)
            table = {key: value for key, value in entry.table.items() if key != "type"}
            entry = entry._replace(cls=cls, problem=problem, table=table)
        yield entry


def _build(annotation: Any, value: object) -> Any:
    """Make an element, and the modules within it, of a table that has been checked."""
    if not isinstance(value, dict):
        return value
    cls = annotation
    if "type" in value:
        cls = CLASSES_BY_TYPE["motion"][value["type"]]
    expected = keys(cls)
    return cls(**{name: _build(expected[name].annotation, item) for name, item in value.items() if name != "type"})


def _check_classes(where: str, cls: type, table: Table) -> Iterator[str]:
    """Iterate over the classes in an element that a file cannot name."""
    if not is_in_format(cls):
        yield f"{where}: a scene file has no type for the class {cls.__name__}; keep this scene in Python"
    for name, value in table.items():
        if isinstance(value, eqx.Module):
            yield from _check_classes(f"{where}.{name}", type(value), table_of(value))


def _type_of(cls: type) -> dict[str, str]:
    return {} if cls in CLASSES_WITHOUT_TYPE.values() else {"type": type_name(cls)}


# tomli-w writes each number of a list on a line of its own: 174 lines for the paper's linkage, where these are 75.
def _lines(table: Table) -> list[str]:
    return [f"{key} = {_toml(value)}" for key, value in table.items()]


def _toml(value: object) -> str:
    """Return a value as TOML; a float's shortest text that reads back as the same float."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    if isinstance(value, eqx.Module):
        return f"{{{', '.join(_lines({**_type_of(type(value)), **table_of(value)}))}}}"
    return _toml(np.asarray(value, dtype=float).tolist())


def _string(text: str) -> str:
    """Return a TOML basic string."""
    escaped = re.sub(r'[\\"]', lambda match: "\\" + match[0], text)
    return '"' + re.sub(r"[\x00-\x1f\x7f]", lambda match: f"\\u{ord(match[0]):04x}", escaped) + '"'
