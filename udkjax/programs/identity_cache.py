"""Caches of results computed from immutable objects, by their identities; and of programs, whose memory is bounded.

Mechanisms, states and methods are trees of arrays: comparing their values takes as long as many of the computations.

Programs and machine code take megabytes. The results of all functions that are `cached_by_size` share `MOST_BYTES`. If they take
more, the least recently used ones are dropped, whatever function they are of: those of one structure were used together, and are
dropped together. The latest result always stays.
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
    """A function with a cache."""

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Produced_co: ...

    def know(self, argument: Any, result: Any) -> None:
        """Store a result of a function of one tree that is known without being computed."""
        ...


@overload
def cached_by_identity(function: Callable[Arguments, Result], /) -> CachedFunction[Arguments, Result]: ...
@overload
def cached_by_identity(*, within_trace: bool) -> Callable[[Callable[Arguments, Result]], CachedFunction[Arguments, Result]]: ...
def cached_by_identity(function: Any = None, /, *, within_trace: bool = False) -> Any:
    """Cache the results of a function by its arguments: numbers and strings by value, others by identity.

    A result is stored as long as its arguments exist and it is one of the `CACHE_SIZE` most recently used results. Arguments must
    not change. Results with traced numbers, which functions may hold in their closures, are stored only `within_trace`: if each
    traced number belongs to a trace of the arguments' numbers, so that the result can be used wherever these can. Then the result
    must not contain the arguments themselves.
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
    """Return True if no number of immutable trees is traced; the answer is stored."""
    return not is_traced(trees)


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
    size: Callable[[Any], int], by_structure: bool = False
) -> Callable[[Callable[Arguments, Produced_co]], SizedFunction[Arguments, Produced_co]]:
    """Cache the results of a function of hashable arguments; `size` estimates the bytes of a result.

    If `by_structure`, arguments are trees of concrete numbers, and results are the same for all values of these: everything else
    is compared (`structure_key.py`), functions among the leaves by identity. They may close over anything: results must not
    depend on calling them.
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
    """Return the estimated bytes of all stored results."""
    with _LOCK:
        return sum(size for _, size in _STORED.values())


def _drop_old() -> None:
    excess = stored_bytes() - MOST_BYTES
    while excess > 0 and len(_STORED) > 1:
        excess -= _STORED.popitem(last=False)[1][1]
