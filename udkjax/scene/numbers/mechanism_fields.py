"""The fields of a mechanism, computed from elements whose missing numbers have been filled in."""

from collections.abc import Mapping, Sequence
from typing import Any

from jaxtyping import Array

from udkjax.programs.identity_cache import is_concrete
from udkjax.scene.numbers.number_fields import SECTIONS
from udkjax.scene.numbers.origin import Origin
from udkjax.scene.numbers.sources import Elements, ElementsWithConstants
from udkjax.scene.tables.element_setup import constants_of, without_constants


def fields_of(
    sections: Mapping[str, Sequence[tuple[str, Any]]], gravity: Array, name: str, origin: Origin | None
) -> dict[str, Any]:
    """Return the values of all fields of a mechanism, by name, from elements whose missing numbers have been filled in."""
    independent = {section: [(key, without_constants(c)) for key, c in sections[section]] for section in ("joint", "driver")}
    names = tuple(tuple(key for key, _ in sections[section]) for section in SECTIONS)
    elements = [[element for _, element in (independent.get(section) or sections[section])] for section in SECTIONS]
    has_constants = any(constants_of(type(c)) for items in independent.values() for _, c in items)
    more: Any = {"names": names} if has_constants else {}
    source = (ElementsWithConstants if has_constants else Elements).of(gravity, elements, **more)
    static = dict(zip((f"{section}_names" for section in SECTIONS), names, strict=True))
    return {"name": name, **static, "origin": None if is_concrete(source) else origin, "_source": source}
