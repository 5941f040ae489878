"""The error that an identification raises, and how lists, counts and tables are worded in its messages."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from udkjax.scene.checks import Mistakes

MOST_LISTED = 8  # names in one sentence


class IdentificationError(Mistakes):
    """Data, parameters or settings do not fit the mechanism, or each other. `problems` lists every mistake, with its place."""

    of = "identification"


def collect(*steps: Callable[[], Any]) -> list[Any]:
    """Return the results of some steps; if any of them raises `IdentificationError`, raise one with the mistakes of all."""
    found, problems = [], []
    for step in steps:
        try:
            found.append(step())
        except IdentificationError as error:
            problems += error.problems
    if problems:
        raise IdentificationError(problems)
    return found


def listed(names: Sequence[str]) -> str:
    """Return names as they stand in a sentence: "a, b and c"."""
    if len(names) > MOST_LISTED:
        return f"{', '.join(names[:MOST_LISTED])} and {len(names) - MOST_LISTED} more"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def ratio(values: Sequence[float] | np.ndarray) -> str:
    """Return numbers relative to the first, such as "1 : 2 : 0.5"."""
    return " : ".join(f"{v / values[0]:.4g}" for v in values)


def counted(number: int, noun: str) -> str:
    """Return "1 record" or "2 records"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def aligned(cells: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table, its columns below each other."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  " + "  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)).rstrip() for row in cells]
