"""Tolerances at which the default has an accuracy, from the table that `python -m experiments atlas` writes."""

import json
from functools import cache
from importlib.resources import files
from typing import NamedTuple


class NeededTolerances(NamedTuple):
    """A mechanism of the atlas: its scene's name, its description, and the default's tolerances by the error that they reach.

    An error is the largest of any position, relative to the mechanism's length, or of an angle (rad).
    """

    name: str
    title: str
    tolerances: dict[str, float]


@cache
def needed_tolerances() -> tuple[NeededTolerances, ...]:
    """Return the tolerances that each mechanism of the atlas needed."""
    text = (files("udkjax.study") / "atlas.json").read_text(encoding="utf-8")
    return tuple(NeededTolerances(**entry) for entry in json.loads(text))


def tolerance_lines(name: str) -> list[str]:
    """Return, for each error, the range of tolerances that all mechanisms needed, and the tolerances for those of this name."""
    table = needed_tolerances()
    errors = list(dict.fromkeys(error for one in table for error in one.tolerances))
    lines = []
    for error in errors:
        reached = [one.tolerances[error] for one in table if error in one.tolerances]
        lines.append(f"  error {error}: {_range(reached)} for {len(reached)} mechanisms")
        own = [one for one in table if name and one.name == name and error in one.tolerances]
        lines += [f"    {one.tolerances[error]:.0e} for {one.title}" for one in own]
    return lines


def _range(values: list[float]) -> str:
    least, most = min(values), max(values)
    return f"{least:.0e}" if least == most else f"{least:.0e} to {most:.0e}"
