"""Scene files that are wrong: mutations of examples and of random mechanisms, in their tables and in their text."""

import copy
import functools
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

import udkjax as udk
from experiments.parts.fuzz import Case
from experiments.parts.random_scenes import Table, random_scene

EXAMPLES = (
    "compound_pendulum",
    "double_pendulum",
    "driven_pendulum",
    "elliptic_trammel",
    "simple_pendulum",
    "slider_crank",
    "four_bar",
)
VALUES: tuple[Any, ...] = (
    np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, -1e308, 5e-324, 1e-308, 2**63, 2**70, -(2**70), 0, 7, True, False, "", "ground",
    "b0", "text", "a\nb", "'\"", "ü" * 50, [], [[]], {}, [0.0], [1.0, 2.0, 3.0], [[1.0, 2.0], [3.0]], [np.nan, 0.0],
    [1.0, "x"], [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]], {"type": "sine"}, {"type": 3}, [True, False],
     ["ground", "ground"], ["b0", "nobody"],
    ["b0"], [["b0"], "ground"], [1e308, 1e308], "revolute", "weld", "cam", [[np.inf, 0.0], [0.0, 0.0]], [{}], "\x00", "1.0",
)  # fmt: skip
PIECES = (
    "",
    "=",
    "[[",
    "]]",
    '"',
    "'",
    "{",
    "}",
    "#",
    "\n",
    ",",
    "nan",
    "-inf",
    "1e999",
    "0x",
    "\x00",
    "\\",
    "[[body]]\n",
    "name = 1\n",
)
BYTES = (b"\xff\xfe", b"\x00", b"\xc3\x28", b"\xef\xbb\xbf", b"\r", b"\x1b[0m", b"\xed\xa0\x80")


@functools.cache
def examples() -> list[Table]:
    """Return the tables of some examples."""
    folder = Path(__file__).parents[2] / "examples"
    return [tomllib.loads((folder / f"{name}.toml").read_text()) for name in EXAMPLES]


@functools.cache
def scenes(number: int) -> Table:
    """Return a small random scene."""
    return random_scene(1, number, 0, bodies=(1, 2 if number % 4 == 0 else 1)).table


def toml(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        plain = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in plain) + '"'
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml(key)} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return repr(value)


def text_of(table: Table) -> str:
    """Return a scene as TOML."""
    sections = {key: value for key, value in table.items() if _is_section(value)}
    lines = [f"{toml(key)} = {toml(value)}" for key, value in table.items() if key not in sections]
    for section, entries in sections.items():
        for entry in entries:
            lines += [f"[[{toml(section)}]]", *(f"{toml(key)} = {toml(value)}" for key, value in entry.items())]
    return "\n".join(lines) + "\n"


def _is_section(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(entry, dict) for entry in value)


def draw(rng: np.random.Generator) -> Case:
    """Draw a file that is wrong, or that may be."""
    table = examples()[rng.integers(len(EXAMPLES))] if rng.random() < 0.2 else scenes(int(rng.integers(300)))
    kind = rng.random()
    if kind < 0.7:
        table, about, names = mutated(copy.deepcopy(table), rng)
        text = text_of(table)
        return Case(about, functools.partial(read, text), names)
    text = text_of(table)
    place = int(rng.integers(len(text) + 1))
    if kind < 0.8:
        return Case("text cut off", functools.partial(read, text[:place]))
    if kind < 0.93:
        until = place + int(rng.integers(0, 30)) * int(rng.random() < 0.5)
        piece = PIECES[rng.integers(len(PIECES))] * int(rng.choice([1, 1, 1, 2, 300]))
        return Case("text replaced", functools.partial(read, text[:place] + piece + text[until:]))
    raw = text.encode()
    raw = raw[:place] + BYTES[rng.integers(len(BYTES))] + raw[place:]
    return Case("bytes put in", functools.partial(read_bytes, raw))


def mutated(table: Table, rng: np.random.Generator) -> tuple[Table, str, tuple[str, ...]]:
    """Change a table in one place; return it, what was done, and how messages may call the place."""
    sections = [key for key, value in table.items() if _is_section(value)]
    section = str(rng.choice(sections))
    index = int(rng.integers(len(table[section])))
    entry = table[section][index]
    if rng.random() < 0.15:
        entry, section = table, ""
    nested = [key for key, value in entry.items() if isinstance(value, dict)]
    place = f"{section}[{index}]" if section else ""
    if nested and rng.random() < 0.5:
        entry = entry[nested[0]]
    key = str(rng.choice(list(entry)))
    value = VALUES[rng.integers(len(VALUES))]
    kind = str(entry.get("type", section or "scene"))
    # A name that is gone, or a type that is another one, is missed where it is used: by its old name, or by another key.
    beside = {"times": "values", "angle": "radius"}.get(key, key)  # lists of one length: the other one may be blamed
    guessed = ("initial guess",) if key in ("position", "points") else ()  # a length that follows from it may be blamed
    anywhere = key in ("name", "type", "body", "joint", "format", "driver", "force", "bodies")
    match int(rng.integers(6)):
        case 0 | 1 | 2:
            entry[key] = value
            return table, f"{kind}.{key}: another value", () if anywhere else (key, beside, *guessed)
        case 3:
            del entry[key]
            return table, f"{kind}.{key}: missing", () if anywhere else (key, beside, *guessed)
        case 4:
            new = str(rng.choice([key + "x", key.upper(), "lenght", "", "ü", key + "."]))
            entry[new] = value
            return (
                table,
                f"{kind}: an unknown key",
                (new or "non-empty", ": unknown key", place or "gravity"),
            )
        case _:
            if isinstance(entry[key], list) and entry[key] and not isinstance(entry[key][0], dict):
                entry[key][int(rng.integers(len(entry[key])))] = value
                return table, f"{kind}.{key}: another entry", () if anywhere else (key, beside, *guessed)
            entry[key] = [entry[key]]
            return table, f"{kind}.{key}: in a list", () if anywhere else (key, beside, *guessed)


def read(text: str) -> None:
    """Read a scene; what is read is finite, and, of each tenth, written and read again the same."""
    mechanism = udk.loads(text)
    wrong = [name for name, value in mechanism.parameters().items() if not np.all(np.isfinite(np.asarray(value)))]
    if wrong:
        raise AssertionError(f"not finite, and taken: {wrong}")
    if len(text) % 10 == 0 and udk.dumps(udk.loads(udk.dumps(mechanism))) != udk.dumps(mechanism):
        raise AssertionError("written and read it is another")


def read_bytes(raw: bytes) -> None:
    """Read a scene from a file of bytes."""
    file = Path("scene.toml")
    file.write_bytes(raw)
    udk.load(file)
