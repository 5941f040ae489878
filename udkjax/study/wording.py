"""Wording of counts, lists and tables in texts for people."""

import math
from collections.abc import Sequence

import numpy as np

MOST_LISTED = 8  # names in one sentence
MOST_DIGITS = 12  # of a number in a table


def plural(count: int, noun: str) -> str:
    """Say how many there are."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def join_names(names: Sequence[str]) -> str:
    """Return names as they stand in a sentence: "a, b and c"."""
    if len(names) > MOST_LISTED:
        return f"{', '.join(names[:MOST_LISTED])} and {len(names) - MOST_LISTED} more"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def ratio(values: Sequence[float] | np.ndarray) -> str:
    """Return numbers relative to the first, such as "1 : 2 : 0.5"."""
    return " : ".join(f"{v / values[0]:.4g}" for v in values)


def format_value(value: float, error: float) -> str:
    """Return a value with as many digits as its standard error allows, and one more."""
    if not (math.isfinite(error) and error > 0 and value):
        return f"{value:.6g}"
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(error)) + 2
    return f"{value:#.{min(max(digits, 2), MOST_DIGITS)}g}".rstrip(".")
