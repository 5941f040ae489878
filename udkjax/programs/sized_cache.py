"""Caches of results that take much memory, such as programs and machine code: their memory in all is bounded, not their number.

The results of all such functions share `MOST_BYTES`. If they take more, the least recently used ones are dropped, whatever
function they are of: those of one structure were used together, and are dropped together. The latest result always stays.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import _CacheInfo, wraps
from threading import RLock
from typing import Any, ParamSpec, Protocol, TypeVar, cast

Arguments = ParamSpec("Arguments")
Result_co = TypeVar("Result_co", covariant=True)

MOST_BYTES = 2**26  # of all results together, by the estimates that the functions give


class SizedFunction(Protocol[Arguments, Result_co]):
    """A function with a cache."""

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result_co: ...

    def cache_info(self) -> _CacheInfo:
        """Return what `functools.lru_cache` returns; the maximum is in bytes, of all caches."""
        ...

    def cache_clear(self) -> None:
        """Drop all results of this function."""
        ...


_STORED: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()  # results with their bytes, the most recently used last
_LOCK = RLock()


def cached_by_size(
    size: Callable[[Any], int],
) -> Callable[[Callable[Arguments, Result_co]], SizedFunction[Arguments, Result_co]]:
    """Cache the results of a function of hashable arguments; `size` estimates the bytes of a result."""

    def decorate(function: Callable[Arguments, Result_co]) -> SizedFunction[Arguments, Result_co]:
        counts = {"hits": 0, "misses": 0}

        @wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result_co:
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
