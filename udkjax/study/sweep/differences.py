"""What differs between two descriptions, in words."""

import difflib
from collections.abc import Iterator
from typing import Any

from udkjax.scene.checks import shown

MOST = 12  # lines of a text, and entries of a list, that are spelled out


def differences(before: Any, now: Any, path: str = "") -> list[str]:
    """Return one line for each difference between two JSON values: its path, what was there, what is there now.

    Of texts of several lines, such as scenes, the lines that differ are shown.
    """
    return list(_between(before, now, path))


def _between(before: Any, now: Any, path: str) -> Iterator[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        for key in {**before, **now}:
            place = f"{path}.{key}" if path else key
            if key not in now:
                yield f"{place}: was {shown(before[key])}, is no longer there"
            elif key not in before:
                yield f"{place}: was not there, is {shown(now[key])}"
            else:
                yield from _between(before[key], now[key], place)
    elif isinstance(before, list) and isinstance(now, list):
        yield from _lists(before, now, path)
    elif isinstance(before, str) and isinstance(now, str) and "\n" in before + now:
        yield from _texts(before, now, path)
    elif not _same(before, now):
        yield f"{path}: was {shown(before)}, is {shown(now)}"


def _lists(before: list, now: list, path: str) -> Iterator[str]:
    if len(before) != len(now):
        yield f"{path}: was {shown(before)} ({len(before)} entries), is {shown(now)} ({len(now)} entries)"
        return
    found = [line for k, pair in enumerate(zip(before, now, strict=True)) for line in _between(*pair, f"{path}[{k}]")]
    yield from found[:MOST]
    if len(found) > MOST:
        yield f"{path}: and {len(found) - MOST} more"


def _texts(before: str, now: str, path: str) -> Iterator[str]:
    compared = list(difflib.unified_diff(before.splitlines(), now.splitlines(), lineterm="", n=0))
    lines = [line for line in compared[2:] if not line.startswith("@@")]  # the first two name files
    for line in lines[:MOST]:
        yield f"{path}: {'was' if line[0] == '-' else 'is'} {line[1:]}"
    if len(lines) > MOST:
        yield f"{path}: and {len(lines) - MOST} more lines"


def _same(a: Any, b: Any) -> bool:
    """Equal; not a number is itself, and truth values are no numbers."""
    return isinstance(a, bool) == isinstance(b, bool) and (a == b or (a != a and b != b))
