"""Which of many parameters the fast tests take: compiling is what takes their time, and each takes programs of its own."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def fast(chosen: Collection[Any], names: Iterable[Any]) -> list:
    """All names as parameters; those that are not chosen are marked as slow."""
    names = list(names)
    assert set(chosen) <= set(names), set(chosen) - set(names)
    return [pytest.param(name, marks=[] if name in chosen else pytest.mark.slow) for name in names]
