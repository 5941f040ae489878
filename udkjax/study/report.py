"""Text for reports (counts, lists, numbers, rows of constraints), and plain data for JSON."""

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np

from udkjax.scene.mechanism import Mechanism

MOST_DIGITS = 12  # largest number of digits in a table
_ROW_NAMES = {"Revolute": ("x", "y"), "Weld": ("x", "y", "angle"), "Prismatic": ("across", "angle")}


def ratio(values: Sequence[float] | np.ndarray) -> str:
    """Return numbers relative to the first, such as "1 : 2 : 0.5"."""
    return " : ".join(f"{v / values[0]:.4g}" for v in values)


def format_value(value: float, error: float) -> str:
    """Return a value with the digits that are significant according to its standard error, and one more."""
    if not (math.isfinite(error) and error > 0 and value):
        return f"{value:.6g}"
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(error)) + 2
    return f"{value:#.{min(max(digits, 2), MOST_DIGITS)}g}".rstrip(".")


def row_label(mechanism: Mechanism, constraint: str, row: int) -> str:
    """Return the name of one row of a constraint, such as `B2 (y)`."""
    kind = type(mechanism.constraints[constraint]).__name__
    return f"{constraint} ({_ROW_NAMES[kind][row] if kind in _ROW_NAMES else f'row {row + 1}'})"


def plain(value: object) -> Any:
    """Convert a value to JSON types: None for NaN and infinity, a mapping for named fields, the name for a mechanism."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Enum | Mechanism):
        return value.name
    if (fields := getattr(value, "_asdict", None)) is not None:  # `value` is a NamedTuple
        return plain(fields())
    if (tolist := getattr(value, "tolist", None)) is not None:  # `value` is an array or number of NumPy or JAX
        return plain(tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
