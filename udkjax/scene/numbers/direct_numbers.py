"""Numbers of a drawn mechanism that were given directly, not through its drawing: they stay when the drawing changes."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx

from udkjax.arrays import number
from udkjax.printing import PrintsLine
from udkjax.scene.elements.held import Held, given_sampled


class DirectNumbers(PrintsLine):
    """The values that were given directly, by the names of numbers or of entries of numbers (`joint.A.points[0][1]`).

    No value is part of another one.
    """

    names: tuple[str, ...] = eqx.field(static=True)  # sorted
    values: tuple[Any, ...]  # arrays, or a `Held` for a sampled number

    @classmethod
    def of(cls, values: Mapping[str, Any], earlier: "DirectNumbers | None" = None) -> "DirectNumbers | None":
        """Return the earlier numbers with `values` set anew or added; None if both are empty."""
        found = {} if earlier is None else earlier.by_name
        # Arrays before their entries: the order of `values` does not matter, because jit sorts the keys.
        for name in sorted(values, key=lambda name: name.count("[")):
            container = next((key for key in found if key != name and covers(key, name)), None)
            if container is None:
                found = {key: value for key, value in found.items() if not covers(name, key)}
                found[name] = given_sampled(values[name])
            else:
                found[container] = _with_part(found[container], name.removeprefix(container), values[name])
        return cls(tuple(sorted(found)), tuple(found[name] for name in sorted(found))) if found else None

    @property
    def by_name(self) -> dict[str, Any]:
        """The values by name."""
        return dict(zip(self.names, self.values, strict=True))


def covers(name: str, other: str) -> bool:
    """Return True if the number named `other` is the number `name`, or is contained in it: an entry, or samples of a `Held`."""
    return other == name or other.startswith((f"{name}[", f"{name}.values"))


def _with_part(whole: Any, part: str, value: Any) -> Any:
    """Return an array, or a `Held`, with another value of an entry, `[0][1]`, or of its samples, `.values[0]`."""
    if isinstance(whole, Held):
        rest = part.removeprefix(".values")
        return replace(whole, values=_with_part(whole.values, rest, value))
    index = tuple(int(k) for k in re.findall(r"\d+", part))
    return number(value) if not index else number(whole).at[index].set(value)
