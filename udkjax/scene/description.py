"""A mechanism as a table for people."""

from typing import Any

import equinox as eqx
import numpy as np
from jax.core import Tracer

from udkjax.html import html_table

FEW = 4  # numbers that are written out; of more, their shape


def mechanism_html(mechanism: Any) -> str:
    """Return a mechanism as an HTML table: one row an element, with its type, the bodies that it holds, and its numbers."""
    groups = {"body": mechanism.bodies, "joint": mechanism.joints, "driver": mechanism.drivers, "force": mechanism.forces}
    rows = [
        (section, name, type(element).__name__, _held(mechanism, section, element), _numbers(element))
        for section, elements in groups.items()
        for name, element in elements.items()
    ]
    counts = ", ".join(f"{len(elements)} {section}" for section, elements in groups.items() if elements)
    title = f"{mechanism.name or 'mechanism'} ({counts}; gravity {_text(mechanism.gravity)} m/s²)"
    return html_table(title, ("section", "name", "type", "bodies", "numbers"), rows)


def _held(mechanism: Any, section: str, element: Any) -> str:
    return "" if section == "body" else ", ".join(mechanism.frames_of(element))


def _numbers(element: Any) -> str:
    return ", ".join(f"{name} {_text(value)}" for name, value in vars(element).items() if eqx.is_array(value))


def _text(value: Any) -> str:
    if isinstance(value, Tracer):
        return "traced"
    if np.size(value) > FEW:
        return f"of shape {np.shape(value)}"
    return np.array2string(np.asarray(value), precision=4, separator=", ", floatmode="maxprec").replace("\n", "")
