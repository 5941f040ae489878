"""Named numbers of a drawing, and the numbers of its elements that are given by expressions of them."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from udkjax.arrays import array_namespace, by_numpy, make_module, number
from udkjax.printing import PrintsLine
from udkjax.scene.elements.fields import given_number
from udkjax.scene.numbers.formula import Measured, evaluate, in_si, names_in

ElementsByName = Mapping[str, Mapping[str, Any]]  # by section and name


class NamedNumber(PrintsLine):
    """A number of a drawing that expressions of other numbers use."""

    value: Float[Array, ""] = eqx.field(converter=given_number)
    unit: str = eqx.field(static=True, default="")  # as written, such as "mm"; "": a plain number in the drawing's units


class Formula(NamedTuple):
    """An expression that gives a number of a drawing, or one entry of a number.

    Attributes:
        section, owner: the section and the name of the element that has the number.
        path: the fields that lead from the element to the number.
        at: the index of the entry; empty if the expression gives the whole number.
        text: the expression, as it was written.
        unit: the SI unit of the number.
    """

    section: str
    owner: str
    path: tuple[str, ...]
    at: tuple[int, ...]
    text: str
    unit: str

    @property
    def name(self) -> str:
        """The name of the number or entry as a parameter, such as "pin.A[0]"."""
        entries = "".join(f"[{k}]" for k in self.at)
        path = () if (self.section, self.path) in NAMED_BY_OWNER else self.path
        return ".".join((self.section, self.owner, *path)) + entries


# Numbers whose parameters have the name of their element alone.
NAMED_BY_OWNER = (("pin", ("position",)), ("number", ("value",)))


def without_expressions(groups: ElementsByName, formulas: Sequence[Formula]) -> ElementsByName:
    """Return elements without the values of numbers that expressions give.

    Such a number is None, or, if only some of its entries are given by expressions, zero at these entries.
    """
    if not formulas:
        return groups
    changed = {section: dict(group) for section, group in groups.items()}
    for section, owner, path, index, _, _ in formulas:
        element = changed[section][owner]
        old = _at(element, path)
        is_entry = index and old is not None and _has_plain_entries(old, section, owner, path, formulas)
        changed[section][owner] = _set(element, path, _with_entry(old, index, 0.0) if is_entry else None)
    return changed


def _has_plain_entries(old: Any, section: str, owner: str, path: tuple[str, ...], formulas: Iterable[Formula]) -> bool:
    return sum(f[:3] == (section, owner, path) for f in formulas) < np.size(old)


def with_expressions(
    groups: ElementsByName, formulas: Sequence[Formula], measured: Mapping[str, Measured], size: Callable[[str], float]
) -> dict[str, dict[str, Any]]:
    """Return elements with the values of the numbers that expressions give.

    Args:
        groups: elements as from `without_expressions`.
        formulas: the expressions; those of named numbers in the order in which they follow from each other.
        measured: the other named numbers, in the units of the drawing.
        size: function that returns the size of the drawing's unit in a given SI unit.
    """
    changed, measured = {section: dict(group) for section, group in groups.items()}, dict(measured)
    whole: dict[tuple[str, str, tuple[str, ...]], dict[tuple[int, ...], Any]] = {}
    for formula in formulas:
        found = evaluate(formula.text, measured, size)
        if formula.section == "number":
            measured[formula.owner] = found
        value = found.value if formula.section == "number" else in_si(formula.text, found, formula.unit, size)
        whole.setdefault(formula[:3], {})[formula.at] = value
    for (section, owner, path), entries in whole.items():
        element = changed[section][owner]
        changed[section][owner] = _set(element, path, _assembled(_at(element, path), entries))
    return changed


def _assembled(old: Any, entries: Mapping[tuple[int, ...], Any]) -> Any:
    if () in entries:
        return _stored(entries[()])
    if old is None:  # all entries are expressions
        shape = tuple(1 + max(index[axis] for index in entries) for axis in range(len(next(iter(entries)))))
        flat = [by_numpy(entries[index]) for index in np.ndindex(*shape)]
        xp = array_namespace(*flat)
        flat = xp.broadcast_arrays(*flat)
        return _stored(xp.reshape(xp.stack(flat, -1), (*flat[0].shape, *shape)))
    for index, value in entries.items():
        old = _with_entry(old, index, value)
    return old


def _with_entry(old: Any, index: tuple[int, ...], value: Any) -> Any:
    """Return an array with another value of an entry; leading axes of the value or of the array are those of a batch."""
    old, value = by_numpy(old), by_numpy(value)
    xp = array_namespace(old, value)
    shape = old.shape[old.ndim - len(index) :]
    batch = np.broadcast_shapes(old.shape[: old.ndim - len(index)], np.shape(value))
    old = xp.broadcast_to(old, (*batch, *shape))
    is_entry = np.zeros(shape, bool)
    is_entry[index] = True
    return _stored(xp.where(is_entry, xp.reshape(value, (*np.shape(value), *[1] * len(shape))), old))


def _stored(x: Any) -> Any:
    return number(np.asarray(x)) if isinstance(x, np.ndarray | np.generic) else x


def independent(names: Mapping[str, Any], formulas: Iterable[Formula]) -> dict[str, Any]:
    """Return numbers by name without those that expressions give.

    If expressions give only some entries of a number, each of the other entries is returned under its own name.
    """
    given = {formula.name for formula in formulas}
    partly = {name for name in names if any(entry.startswith(f"{name}[") for entry in given)}
    found: dict[str, Any] = {}
    for name, value in names.items():
        if name not in partly:
            found |= {name: value} if name not in given else {}
            continue
        entries = {f"{name}{''.join(f'[{k}]' for k in index)}": value[index] for index in np.ndindex(*np.shape(value))}
        found |= {entry: x for entry, x in entries.items() if entry not in given}
    return found


def numbers_in_expressions(formulas: Sequence[Formula], section: str) -> set[str]:
    """Return the names of the numbers on which expressions in a section of a drawing depend, directly or through others."""
    by_number = {formula.owner: formula.text for formula in formulas if formula.section == "number"}
    waiting = [formula.text for formula in formulas if formula.section == section]
    found: set[str] = set()
    while waiting:
        new = {*(names_in(waiting.pop()) or ())} - found
        found |= new
        waiting += [by_number[name] for name in new if name in by_number]
    return found


def formula_mistakes(names: Iterable[str], formulas: Iterable[Formula]) -> Iterator[str]:
    """Iterate over messages about parameters that cannot be changed, among the given names, because expressions give them."""
    for name in names:
        for formula in formulas:
            if name in (formula.name, formula.name.partition("[")[0]) or formula.name.startswith(f"{name}["):
                yield f'{name}: is given by the expression "{formula.text}": change the numbers in it, or write another one'
                break


def _at(element: Any, path: Sequence[str]) -> Any:
    for name in path:
        element = getattr(element, name)
    return element


def _set(element: Any, path: Sequence[str], value: Any) -> Any:
    field, *inner = path
    new = _set(getattr(element, field), inner, value) if inner else value
    return make_module(type(element), **vars(element) | {field: new})
