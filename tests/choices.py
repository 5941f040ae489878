"""Which tests run: parameters of the fast tests, as each compiles its own programs, and what a version of JAX can do."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest

from udkjax.programs.deferred import deferred_p

# Only recent versions of JAX have programs that can be deferred.
needs_deferred = pytest.mark.skipif(deferred_p is None, reason="this JAX has no programs that can be deferred")


def fast(chosen: Collection[Any], names: Iterable[Any]) -> list:
    """Return all names as parameters; those that are not chosen are marked as slow."""
    names = list(names)
    assert set(chosen) <= set(names), set(chosen) - set(names)
    return [pytest.param(name, marks=[] if name in chosen else pytest.mark.slow) for name in names]
