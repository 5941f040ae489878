"""Numbers of a drawn mechanism that were changed directly, not through its drawing: they stay when the drawing changes.

`Mechanism.changed` has a mark for each entry of each number of the elements: 1 if it was changed, 0 if it follows from the
drawing. Marks are numbers, not structure: mechanisms with and without changes share one program, and may be stacked.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.arrays import is_traced, number
from udkjax.scene.number_fields import (
    ElementGroups,
    NumberField,
    Sections,
    groups_of,
    held_names,
    parameters_in,
    parameters_of,
    split_index,
    value_of,
)


class Marked(Sections, Protocol):
    """A mechanism with its marks."""

    changed: Float[Array, "K"] | None


def count_marks(mechanism: Sections) -> int:
    """Return the number of marks: one for each entry of each number of the elements."""
    return sum(np.size(field.value) for field in _present(groups_of(mechanism)).values())


def marks_by_name(mechanism: Marked) -> dict[str, Any]:
    """Return the marks of a mechanism by the name of the number, in the shape of the number."""
    if mechanism.changed is None:
        return {}
    fields, marks = _present(groups_of(mechanism)), mechanism.changed
    xp = jnp if is_traced(marks) else np
    ends = np.cumsum([np.size(field.value) for field in fields.values()])
    parts = xp.split(xp.asarray(marks), ends)  # the last part is empty
    return {name: part.reshape(np.shape(fields[name].value)) for name, part in zip(fields, parts, strict=False)}


def mark_changes(mechanism: Marked, groups: ElementGroups, names: Collection[str]) -> Float[Array, "K"]:
    """Return the marks after changes of the named numbers, or entries of numbers; older marks stay set."""
    old_marks, marks = marks_by_name(mechanism), {}
    for name, field in _present(groups).items():
        mark, shape = old_marks.get(name), np.shape(field.value)
        marks[name] = np.ones(shape) if mark is None or mark.shape != shape else mark  # new samples count as changed
    for full_name in names:
        name, index = split_index(full_name, marks)
        if name in marks:
            changed = np.zeros(marks[name].shape)
            changed[index] = 1.0
            marks[name] = (jnp if is_traced(marks[name]) else np).maximum(marks[name], changed)
    return number(_concatenated(list(marks.values())))


def directly_changed(mechanism: Marked, redrawn: Sections) -> dict[str, Any]:
    """Return the directly changed numbers by name, with their unchanged entries taken from the redrawn mechanism."""
    known, drawn = parameters_of(mechanism), parameters_of(redrawn)
    sampled = [name for name in held_names(known) if f"{name}.values" not in drawn]
    changed = {name: value_of(known, name, groups_of(mechanism)) for name in sampled}
    for name, mark in marks_by_name(mechanism).items():
        if not any(name.startswith(f"{x}.") for x in sampled):
            changed |= _without_unchanged(name, mark, known[name].value, drawn[name].value if name in drawn else None)
    return changed


def _without_unchanged(name: str, mark: Any, value: Any, drawn: Any) -> dict[str, Any]:
    if drawn is None or np.shape(drawn) != np.shape(value):
        return {name: value}
    if not is_traced(mark) and (mark.all() or not mark.any()):
        return {name: value} if mark.any() else {}
    xp = jnp if is_traced((mark, value, drawn)) else np  # concrete numbers stay concrete
    return {name: number(xp.where(mark != 0, value, drawn))}


def _present(groups: ElementGroups) -> Mapping[str, NumberField]:
    """Return the numbers of elements by name, without absent ones."""
    return {name: field for name, field in parameters_in(groups).items() if field.value is not None}


def _concatenated(arrays: Sequence[Any]) -> Any:
    xp = jnp if is_traced(arrays) else np
    return xp.concatenate([xp.ravel(x) for x in arrays]) if arrays else np.zeros(0)
