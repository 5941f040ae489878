"""Results computed of objects that stay as they are, found again by their identities.

Mechanisms, states and methods are trees of arrays: to compare their values takes as long as much of what is computed of them.
"""

import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import wraps
from threading import RLock
from typing import Any, ParamSpec, TypeVar

import numpy as np

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

CACHE_SIZE = 64  # results of a function that are stored; the one that was asked for longest ago makes room


_BY_VALUE = (bool, int, float, str, np.generic, type(None))  # types: to ask an Equinox module for its own takes a microsecond


def cached_by_identity(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function that finds its results again for the same arguments: numbers and texts by value, others by identity.

    A result is stored for as long as its arguments exist, but no longer than `CACHE_SIZE` others have been asked for since.
    None of the arguments may be traced, and none may change.
    """
    found: OrderedDict[tuple[Hashable, ...], tuple[list[Any], Result]] = OrderedDict()
    lock = RLock()  # the end of an object may come at any time, also within the lock

    def forget(key: tuple[Hashable, ...]) -> None:
        with lock:
            found.pop(key, None)

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        objects = (*args, *kwargs.values())
        key = (*[(type(x), x) if issubclass(type(x), _BY_VALUE) else id(x) for x in objects], *kwargs)
        stored = found.get(key)
        if stored is not None:
            with lock:
                if key in found:
                    found.move_to_end(key)
            return stored[1]
        result = function(*args, **kwargs)
        holds = [_reference(x, lambda _: forget(key)) for x in objects]
        with lock:
            found[key] = holds, result
            while len(found) > CACHE_SIZE:
                found.popitem(last=False)
        return result

    return call


def _reference(x: object, forget: Callable[[Any], None]) -> Any:
    """Return a weak reference, which tells when an object ends, and with it the right to its identity; or the object itself."""
    try:
        return weakref.ref(x, forget)
    except TypeError:
        return x
