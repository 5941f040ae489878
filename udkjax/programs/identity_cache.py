"""Caches of results computed from immutable objects, by their identities; and of programs, whose memory is bounded.

Mechanisms, states and methods are trees of arrays: comparing their values takes as long as many of the computations.

Programs and machine code take megabytes. The results of all functions that are `cached_by_size` share `MOST_BYTES`. If they take
more, the least recently used ones are dropped, whatever function they are of: those of one structure were used together, and are
dropped together. The latest result always stays.
"""

import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import _CacheInfo, wraps
from threading import RLock
from typing import Any, ParamSpec, Protocol, TypeVar, cast

import jax
import numpy as np
from jax.core import Tracer

from udkjax.arrays import is_traced

Arguments = ParamSpec("Arguments")
Argument = TypeVar("Argument")
Result = TypeVar("Result")
Argument_contra = TypeVar("Argument_contra", contravariant=True)
Known = TypeVar("Known")
Produced_co = TypeVar("Produced_co", covariant=True)

MOST_BYTES = 3 * 2**24  # of all results of functions that are `cached_by_size` together, by the estimates of these functions
CACHE_SIZE = 64  # results stored per function; the least recently used one is dropped


_BY_VALUE = (bool, int, float, str, np.generic, type(None))  # isinstance of an Equinox module takes a microsecond


def cached_by_identity(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Cache the results of a function by its arguments: numbers and strings by value, others by identity.

    A result is stored as long as its arguments exist and it is one of the `CACHE_SIZE` most recently used results. Arguments must
    be concrete and must not change; a result with traced numbers, which functions may hold in their closures, is not stored.
    """
    cache: OrderedDict[tuple[Hashable, ...], tuple[list[Any], Result]] = OrderedDict()
    lock = RLock()  # an object may be deleted at any time, also within the lock

    def forget(key: tuple[Hashable, ...]) -> None:
        with lock:
            cache.pop(key, None)

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        objects = (*args, *kwargs.values())
        key = (*[(type(x), x) if issubclass(type(x), _BY_VALUE) else id(x) for x in objects], *kwargs)
        stored = cache.get(key)
        if stored is not None:
            with lock:
                if key in cache:
                    cache.move_to_end(key)
            return stored[1]
        result = function(*args, **kwargs)
        if is_traced(result):
            return result
        references = [_reference(x, lambda _: forget(key)) for x in objects]
        with lock:
            cache[key] = references, result
            while len(cache) > CACHE_SIZE:
                cache.popitem(last=False)
        return result

    return call


@cached_by_identity
def is_concrete(*trees: Any) -> bool:
    """Return True if no number of immutable trees is traced; the answer is stored."""
    return not is_traced(trees)


class FunctionOfTree(Protocol[Argument_contra, Known]):
    """A function of one tree, with a cache."""

    def __call__(self, argument: Argument_contra, /) -> Known: ...

    def know(self, argument: Argument_contra, result: Known) -> None:
        """Store a result that is known without being computed."""
        ...


def cached_within_trace(function: Callable[[Argument], Result]) -> FunctionOfTree[Argument, Result]:
    """Cache the results of a function of one tree by its identity, like `cached_by_identity`, also while numbers are traced.

    The result must not contain the tree itself. It is stored if each traced number of it belongs to a trace of the argument's
    numbers, so that it can be used wherever the argument can.
    """
    cache: OrderedDict[int, tuple[Any, Result]] = OrderedDict()  # references and results
    lock = RLock()

    def forget(key: int) -> None:
        with lock:
            cache.pop(key, None)

    def know(argument: Argument, result: Result) -> None:
        key = id(argument)
        with lock:
            cache[key] = _reference(argument, lambda _: forget(key)), result
            while len(cache) > CACHE_SIZE:
                cache.popitem(last=False)

    @wraps(function)
    def call(argument: Argument) -> Result:
        stored = cache.get(id(argument))
        if stored is not None:
            return stored[1]
        result = function(argument)
        given = _traces(argument)
        if not given or _traces(result) <= given:
            know(argument, result)
        return result

    found: Any = call
    found.know = know
    return found


def _traces(tree: Any) -> set[int]:
    """Return the traces of the numbers of a tree, which exist as long as it."""
    return {id(getattr(x, "_trace", x)) for x in jax.tree.leaves(tree) if isinstance(x, Tracer)}


def _reference(x: object, forget: Callable[[Any], None]) -> Any:
    """Return a weak reference that calls `forget` when the object is deleted; the object itself if it has none."""
    try:
        return weakref.ref(x, forget)
    except TypeError:
        return x


# --- bounded by memory


class SizedFunction(Protocol[Arguments, Produced_co]):
    """A function with a cache."""

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Produced_co: ...

    def cache_info(self) -> _CacheInfo:
        """Return the record of `functools.lru_cache`; its maximum is in bytes, of all caches."""
        ...

    def cache_clear(self) -> None:
        """Drop all results of this function."""
        ...


_STORED: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()  # results with their bytes, the most recently used last
_LOCK = RLock()


def cached_by_size(
    size: Callable[[Any], int],
) -> Callable[[Callable[Arguments, Produced_co]], SizedFunction[Arguments, Produced_co]]:
    """Cache the results of a function of hashable arguments; `size` estimates the bytes of a result."""

    def decorate(function: Callable[Arguments, Produced_co]) -> SizedFunction[Arguments, Produced_co]:
        counts = {"hits": 0, "misses": 0}

        @wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Produced_co:
            key = function, args, tuple(kwargs.items())
            with _LOCK:
                if key in _STORED:
                    counts["hits"] += 1
                    _STORED.move_to_end(key)
                    return _STORED[key][0]
                counts["misses"] += 1
            result = function(*args, **kwargs)
            with _LOCK:
                _STORED[key] = result, size(result)
                _STORED.move_to_end(key)
                _drop_old()
            return result

        def keys() -> list[Any]:
            return [key for key in _STORED if cast(Any, key)[0] is function]

        def cache_info() -> _CacheInfo:
            with _LOCK:
                return _CacheInfo(counts["hits"], counts["misses"], MOST_BYTES, len(keys()))

        def cache_clear() -> None:
            with _LOCK:
                for key in keys():
                    del _STORED[key]

        cached: Any = call
        cached.cache_info, cached.cache_clear = cache_info, cache_clear
        return cached

    return decorate


def stored_bytes() -> int:
    """Return the estimated bytes of all stored results."""
    with _LOCK:
        return sum(size for _, size in _STORED.values())


def _drop_old() -> None:
    excess = stored_bytes() - MOST_BYTES
    while excess > 0 and len(_STORED) > 1:
        excess -= _STORED.popitem(last=False)[1][1]
