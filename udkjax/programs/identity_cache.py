"""Caches of results by the identities of the immutable objects they are computed from; and of programs, whose memory is bounded.

Mechanisms, states and methods are trees of arrays: comparing their values takes as long as many of the computations.

Programs and machine code take megabytes. The results of all functions that are `cached_by_size` share `MOST_BYTES`. If they take
more, the least recently used results of any of these functions are dropped: results for one structure were used together, and
are dropped together. The latest result always stays.
"""

import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import _CacheInfo, partial, wraps
from threading import RLock
from typing import Any, ParamSpec, Protocol, TypeVar, cast, overload

import jax
import numpy as np
from jax.core import Tracer

from udkjax.arrays import is_traced
from udkjax.programs.structure_key import StructureKey

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Produced_co = TypeVar("Produced_co", covariant=True)

MOST_BYTES = 3 * 2**24  # of all results of functions that are `cached_by_size` together, by the estimates of these functions
CACHE_SIZE = 64  # results stored per function; the least recently used one is dropped


_BY_VALUE = (bool, int, float, str, np.generic, type(None))  # isinstance of an Equinox module takes a microsecond


class CachedFunction(Protocol[Arguments, Produced_co]):
    """A function whose results are cached by the identity of its arguments (`cached_by_identity`)."""

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Produced_co: ...

    def know(self, argument: Any, result: Any) -> None:
        """Store a result for a given argument that is known without calling the function; for functions of one argument."""
        ...


@overload
def cached_by_identity(function: Callable[Arguments, Result], /) -> CachedFunction[Arguments, Result]: ...
@overload
def cached_by_identity(*, within_trace: bool) -> Callable[[Callable[Arguments, Result]], CachedFunction[Arguments, Result]]: ...
def cached_by_identity(function: Any = None, /, *, within_trace: bool = False) -> Any:
    """Cache the results of a function by its arguments: numbers and strings by value, others by identity.

    A result is stored as long as its arguments exist and it is one of the `CACHE_SIZE` most recently used results. Arguments must
    not change.

    Args:
        function: the function; None if the decorator is used with `within_trace`.
        within_trace: also store results with traced numbers, if each of these belongs to a trace of numbers of the arguments, so
            that the result can be used wherever the arguments can. The result must not contain the arguments themselves then. If
            False, results with traced numbers are not stored.

    Returns:
        The function with a cache.
    """
    if function is None:
        return partial(_cached_by_identity, within_trace=within_trace)
    return _cached_by_identity(function, within_trace)


def _cached_by_identity(function: Callable[..., Any], within_trace: bool) -> Any:
    cache: OrderedDict[tuple[Hashable, ...], tuple[list[Any], Any]] = OrderedDict()
    lock = RLock()  # an object may be deleted at any time, also within the lock

    def forget(key: tuple[Hashable, ...]) -> None:
        with lock:
            cache.pop(key, None)

    def store(key: tuple[Hashable, ...], objects: tuple[Any, ...], result: Any) -> None:
        references = [_reference(x, lambda _: forget(key)) for x in objects]
        with lock:
            cache[key] = references, result
            while len(cache) > CACHE_SIZE:
                cache.popitem(last=False)

    def holds(objects: tuple[Any, ...], result: Any) -> bool:
        if not within_trace:
            return not is_traced(result)
        given = _traces(objects)
        return not given or _traces(result) <= given  # a result of concrete numbers is not looked at: stand-ins would refuse

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        objects = (*args, *kwargs.values())
        key = (*[(type(x), x) if issubclass(type(x), _BY_VALUE) else id(x) for x in objects], *kwargs)
        stored = cache.get(key)
        if stored is not None:
            with lock:
                if key in cache:
                    cache.move_to_end(key)
            return stored[1]
        result = function(*args, **kwargs)
        if holds(objects, result):
            store(key, objects, result)
        return result

    cached: Any = call
    cached.know = lambda argument, result: store((id(argument),), (argument,), result)
    return cached


@cached_by_identity
def is_concrete(*trees: Any) -> bool:
    """Return True if no number of immutable trees is traced; cached by the identities of the trees."""
    return not is_traced(trees)


def _traces(tree: Any) -> set[int]:
    """Return the identities of the traces to which numbers of a tree belong; these traces exist as long as the tree."""
    return {id(getattr(x, "_trace", x)) for x in jax.tree.leaves(tree) if isinstance(x, Tracer)}


def _reference(x: object, forget: Callable[[Any], None]) -> Any:
    """Return a weak reference that calls `forget` when the object is deleted; the object itself if it cannot have one."""
    try:
        return weakref.ref(x, forget)
    except TypeError:
        return x


# --- bounded by memory


class SizedFunction(Protocol[Arguments, Produced_co]):
    """A function whose results are cached until all such caches take too much memory (`cached_by_size`)."""

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Produced_co: ...

    def cache_info(self) -> _CacheInfo:
        """Return the hits, misses and size of this function's cache, as functions with `functools.lru_cache` do.

        `maxsize` is the limit of all caches together, in bytes; the current size counts the results of this function.
        """
        ...

    def cache_clear(self) -> None:
        """Drop all results of this function."""
        ...


_STORED: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()  # results with their bytes, the most recently used last
_LOCK = RLock()


def cached_by_size(
    size: Callable[[Any], int], by_structure: bool = False
) -> Callable[[Callable[Arguments, Produced_co]], SizedFunction[Arguments, Produced_co]]:
    """Return a decorator that caches the results of a function of hashable arguments, up to `MOST_BYTES` for all such functions.

    Args:
        size: function that estimates the memory of a result in bytes.
        by_structure: for functions of trees of concrete numbers whose results do not depend on the values of these numbers. The
            cache compares everything else in the trees (`structure_key.py`). Functions among the leaves are compared by identity
            and may close over anything, so that results must not depend on calling them.

    Returns:
        The decorator.
    """

    def decorate(function: Callable[Arguments, Produced_co]) -> SizedFunction[Arguments, Produced_co]:
        counts = {"hits": 0, "misses": 0}

        @wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Produced_co:
            try:
                key = function, StructureKey(args) if by_structure else args, tuple(kwargs.items())
            except TypeError:  # a static field cannot be compared
                return function(*args, **kwargs)
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
    """Return the estimated memory of all results stored by `cached_by_size`, in bytes."""
    with _LOCK:
        return sum(size for _, size in _STORED.values())


def _drop_old() -> None:
    excess = stored_bytes() - MOST_BYTES
    while excess > 0 and len(_STORED) > 1:
        excess -= _STORED.popitem(last=False)[1][1]
