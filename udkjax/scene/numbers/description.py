"""Printed tables of a mechanism and of the poses of its bodies, with units."""

from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike

from udkjax.printing import PrintedTable, format_number, format_numbers, has_numbers
from udkjax.scene.elements.held import Held
from udkjax.scene.numbers.named_numbers import NamedNumber
from udkjax.scene.numbers.number_fields import Sections
from udkjax.scene.numbers.units import field_unit
from udkjax.scene.tables.schema import numbers_in

LEFT_OUT = ("velocity", "angular_velocity")  # fields omitted if zero


def mechanism_table(mechanism: Sections, frame_names: Callable[..., Sequence[str]]) -> PrintedTable:
    """Return the table of a mechanism; `frame_names` maps an element to the names of its bodies."""
    groups = mechanism.groups
    drawing = None if mechanism.departs_from_drawing else mechanism.drawing
    lengths = {} if drawing is None else drawing.length_texts()
    rows = [
        (
            section,
            name,
            type(element).__name__,
            "" if section == "body" else ", ".join(frame_names(element)),
            _with_length(lengths.get(name, "") if section == "body" else "", _format_element(element)),
        )
        for section, elements in groups.items()
        for name, element in elements.items()
    ]
    title = f"{mechanism.name or 'mechanism'} ({_counts(groups)}; gravity {format_numbers(mechanism.gravity, 'm/s²')})"
    return PrintedTable(title, rows, ("section", "name", "type", "bodies", "numbers"))


def drawing_table(
    name: str, groups: Mapping[str, Mapping[str, eqx.Module]], ground: Sequence[str], lengths: Mapping[str, str]
) -> PrintedTable:
    """Return the table of a drawing, from its elements by section and name, its pins on the ground and the lengths of links."""
    rows = [
        (
            section,
            key,
            "ground" if section == "pin" and key in ground else _names_in(element),
            _with_length(lengths.get(key, "") if section == "link" else "", _format_element(element)),
        )
        for section, elements in groups.items()
        for key, element in elements.items()
    ]
    return PrintedTable(f"{name or 'drawing'} ({_counts(groups)})", rows, ("section", "name", "between", "numbers"))


def _with_length(length: str, numbers: str) -> str:
    return ", ".join(text for text in (f"length {length}" if length else "", numbers) if text)


def _counts(groups: Mapping[str, Mapping[str, object]]) -> str:
    return ", ".join(f"{len(group)} {_plural(section, len(group))}" for section, group in groups.items() if group)


def _plural(section: str, count: int) -> str:
    return section if count == 1 else "bodies" if section == "body" else f"{section}s"


def _names_in(element: eqx.Module) -> str:
    """Return the pins and links that an element of a drawing names."""
    if isinstance(element, NamedNumber):
        return ""
    static = [value for value in vars(element).values() if isinstance(value, str | tuple)]
    return ", ".join(name for value in static for name in ([value] if isinstance(value, str) else value) if name)


def _format_element(element: eqx.Module) -> str:
    driven, shown = getattr(element, "coordinate", ""), []
    for path, value, _ in numbers_in(element):
        if value is None or (path[-1] in LEFT_OUT and has_numbers(value) and not np.any(np.asarray(value))):
            continue
        holder = element
        for field in path[:-1]:
            holder = getattr(holder, field)
        is_held = isinstance(holder, Held)
        unit = (
            holder.unit
            if isinstance(holder, NamedNumber)
            else field_unit(type(element if is_held else holder).__name__, path[-2] if is_held else path[-1], driven)
        )
        shown.append(f"{' '.join(path)} {format_numbers(value, unit)}".replace("_", " "))
    return ", ".join(shown)


def format_pose(pose: np.ndarray, size: float) -> str:
    """Return x, y (m) and angle (rad) of a body as text; rounding errors relative to `size` (m) or one radian print as 0."""
    x, y = (format_number(value, scale=size) for value in pose[:2])
    return f"({x}, {y}) m, {format_number(pose[2], 'rad', 1.0)}"


def size_of(q: ArrayLike) -> float:
    """Return the largest finite coordinate x or y (m) of poses (..., 3)."""
    lengths = np.abs(np.asarray(q, float)[..., :2])
    return float(np.max(lengths, where=np.isfinite(lengths), initial=0.0))
