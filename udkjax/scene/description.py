"""A mechanism as an HTML table."""

from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from udkjax.html import html_table
from udkjax.scene.number_fields import Sections

NUMBERS_IN_FULL = 4  # numbers that are written out; of more, their shape


def mechanism_html(mechanism: Sections, frame_names: Callable[..., Sequence[str]]) -> str:
    """Return a mechanism as an HTML table: one row an element, with its type, its bodies (`frame_names`) and its numbers."""
    groups = {"body": mechanism.bodies, "joint": mechanism.joints, "driver": mechanism.drivers, "force": mechanism.forces}
    rows = [
        (
            section,
            name,
            type(element).__name__,
            "" if section == "body" else ", ".join(frame_names(element)),
            _format_numbers(element),
        )
        for section, elements in groups.items()
        for name, element in elements.items()
    ]
    counts = ", ".join(f"{len(elements)} {section}" for section, elements in groups.items() if elements)
    title = f"{mechanism.name or 'mechanism'} ({counts}; gravity {_format_number(mechanism.gravity)} m/s²)"
    return html_table(title, ("section", "name", "type", "bodies", "numbers"), rows)


def _format_numbers(element: eqx.Module) -> str:
    return ", ".join(f"{name} {_format_number(value)}" for name, value in vars(element).items() if eqx.is_array(value))


def _format_number(value: Array) -> str:
    if isinstance(value, Tracer):
        return "traced"
    if np.size(value) > NUMBERS_IN_FULL:
        return f"of shape {np.shape(value)}"
    return np.array2string(np.asarray(value), precision=4, separator=", ", floatmode="maxprec").replace("\n", "")
