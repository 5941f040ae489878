"""Refusals of results that depend on masses, in drawings that give none for a link."""

from typing import Any

import numpy as np

from udkjax.arrays import is_traced
from udkjax.requirements import ArgumentError
from udkjax.wording import join_names, quote

CURE = "give each a density with a thickness, or a mass"


def require_masses(mechanism: Any, asked_by: str, unless: str = "") -> None:
    """Require masses of all links.

    Args:
        mechanism: A mechanism, or a model of another kind, which has masses.
        asked_by: The results that depend on masses, in the plural: "reactions".
        unless: Another cure: "or let motors determine the motion".

    Raises:
        ArgumentError: A link has none.
    """
    names = getattr(mechanism, "massless", ())
    if names:
        lacks = "has" if len(names) == 1 else "have"
        other = f", {unless}" if unless else ""
        links = join_names([quote(name) for name in names])
        raise ArgumentError(f"{links} {lacks} no mass, on which {asked_by} depend: {CURE}{other}")


def require_weights(mechanism: Any, asked_by: str) -> None:
    """Require masses of all links, unless nothing weighs anything; as `require_masses`."""
    if getattr(mechanism, "massless", ()) and (is_traced(mechanism.gravity) or np.any(np.asarray(mechanism.gravity) != 0.0)):
        require_masses(mechanism, asked_by, "or give the scene gravity = [0, 0]")
