"""Scene files as plain documents, and back: a changed document is merged into its original text, which keeps its comments."""

import math
from collections.abc import Mapping, Sequence
from difflib import SequenceMatcher
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Array, Item, Table

from udkjax.scene.drawing.drawing_tables import LISTS
from udkjax.scene.mechanism_tables import parse_toml
from udkjax.scene.tables.checks import SceneError
from udkjax.studio.limits import require_few, require_size

Document = dict[str, Any]
NEW_TABLES = ("numbers", "pins", "velocities")  # tables that are written with a header
HEADED_SECTIONS = (*LISTS, "body", "joint", "driver", "force")  # lists whose entries are written with a header


def read_document(text: object) -> Document:
    """Return the tables of a text as JSON values; raise `SceneError` if it cannot be read, `RefusedError` if it is too long."""
    try:
        document = _plain(parse_toml(require_size(text), "", SceneError))
    except RecursionError:
        raise SceneError(["tables are nested too deeply"]) from None
    require_few(document)
    return document


def merge_document(text: str, document: Mapping[str, Any]) -> str:
    """Return a text with the tables of a document, changed in as few places as possible, with its comments.

    Args:
        text: original text of the document, or empty.
        document: tables, lists, strings, numbers and booleans.

    Raises:
        SceneError: the text is not TOML, or a value of the document cannot be written as TOML.
    """
    require_few(document)
    try:
        old = tomlkit.parse(text)
        _merge_table(old, document)
        return tomlkit.dumps(old)
    except (TOMLKitError, RecursionError, ValueError, TypeError) as error:
        raise SceneError([f"cannot be written as TOML: {error}"]) from None


def _plain(value: object) -> Any:
    """Return a value of a TOML file as a JSON value; numbers that are not finite, and dates and times, become strings."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool | str | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    return str(value)


def _unwrapped(item: Any) -> Any:
    return _plain(item.unwrap() if isinstance(item, Item) else item)


def _merge_table(old: Any, new: Mapping[str, Any], depth: int = 0) -> None:
    for key in [key for key in old if key not in new]:
        del old[key]
    for key, value in new.items():
        if value is None:
            raise TypeError(f"{key} has no value")
        if key not in old:
            _add(old, key, _fresh(key, value, depth))
        elif _unwrapped(old[key]) == value and type(_unwrapped(old[key])) is not bool:
            continue
        elif isinstance(value, Mapping) and isinstance(old[key], Mapping):
            _merge_table(old[key], value, depth + 1)
        elif isinstance(value, list) and _is_tables(value) and _holds_tables(old[key]):
            _merge_list(old[key], value)
        else:
            old[key] = _fresh(key, value, depth + 1)


def _add(table: Any, key: str, item: Any) -> None:
    """Add a key to a table, before the comments at its end, which belong to the next table."""
    body = table.value.body if isinstance(table, Table) else []
    tail = []
    while body and body[-1][0] is None:
        tail.insert(0, body.pop())
    table[key] = item
    body.extend(tail)


def _is_tables(value: object) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(isinstance(item, Mapping) for item in value)


def _holds_tables(item: Any) -> bool:
    return isinstance(item, AoT | Array) and _is_tables(_unwrapped(item))


def _merge_list(old: Any, new: Sequence[Mapping[str, Any]]) -> None:
    """Change a list of tables so that it equals `new`; tables with the same name or content keep their place and comments."""
    old_keys = [_mark(_unwrapped(table)) for table in old]
    new_keys = [_mark(table) for table in new]
    offset = 0
    for _, a0, a1, b0, b1 in SequenceMatcher(None, old_keys, new_keys, autojunk=False).get_opcodes():
        shared = min(a1 - a0, b1 - b0)
        for k in range(shared):
            _merge_table(old[a0 + offset + k], new[b0 + k], 2)
        for _ in range(a1 - a0 - shared):
            del old[a0 + offset + shared]
        for k in range(b1 - b0 - shared):
            fresh = _inline(new[b0 + shared + k]) if isinstance(old, Array) else _fresh_table(new[b0 + shared + k], "\n")
            old.insert(a0 + offset + shared + k, fresh)
        offset += (b1 - b0) - (a1 - a0)


def _mark(table: Mapping[str, Any]) -> str:
    """Return the key by which a table is recognized: its name, or else its whole content."""
    return f"name {table['name']}" if "name" in table else repr(sorted(table.items(), key=lambda item: item[0]))


def _fresh(key: str, value: Any, depth: int) -> Any:
    if depth == 0 and key in NEW_TABLES and isinstance(value, Mapping):
        return _fresh_table(value)
    if depth == 0 and key in HEADED_SECTIONS and isinstance(value, list) and _is_tables(value):
        tables = tomlkit.aot()
        for table in value:
            tables.append(_fresh_table(table))
        return tables
    return _inline(value)


def _fresh_table(table: Mapping[str, Any], indent: str = "") -> Table:
    fresh = tomlkit.table()
    fresh.trivia.indent = indent
    for key, value in table.items():
        fresh.add(key, _inline(value))
    return fresh


def _inline(value: Any) -> Any:
    if isinstance(value, Mapping):
        inline = tomlkit.inline_table()
        for key, item in value.items():
            inline.append(key, _inline(item))
        return inline
    if isinstance(value, list):
        array = tomlkit.array()
        for item in value:
            array.append(_inline(item))
        return array
    return tomlkit.item(value)
