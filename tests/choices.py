"""Selection of parameters for the fast tests, as each parameter compiles its own programs, which takes most of the time."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def fast(chosen: Collection[Any], names: Iterable[Any]) -> list:
    """Return all names as parameters; those that are not chosen are marked as slow."""
    names = list(names)
    assert set(chosen) <= set(names), set(chosen) - set(names)
    return [pytest.param(name, marks=[] if name in chosen else pytest.mark.slow) for name in names]
