"""Tolerances that runs with default settings need for an accuracy, as measured by `python -m experiments atlas`."""

import json
from functools import cache
from importlib.resources import files
from typing import NamedTuple


class NeededTolerances(NamedTuple):
    """A mechanism of the atlas: the name of its scene, a description, and the tolerances that runs with default settings need.

    `tolerances` maps errors, as text, to the tolerance that reaches each. An error is the largest of any position, relative to
    the mechanism's length, or of an angle (rad).
    """

    name: str
    title: str
    tolerances: dict[str, float]


@cache
def needed_tolerances() -> tuple[NeededTolerances, ...]:
    """Return the tolerances that each mechanism of the atlas needs."""
    text = (files("udkjax.study") / "atlas.json").read_text(encoding="utf-8")
    return tuple(NeededTolerances(**entry) for entry in json.loads(text))


def tolerance_lines(name: str) -> list[str]:
    """Return lines of text: for each error, the range of tolerances that the mechanisms of the atlas need.

    If the atlas has mechanisms named `name`, their own tolerances follow.
    """
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
