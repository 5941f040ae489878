"""The number of threads that computations use: the cores of this process, or fewer as set by `UDKJAX_THREADS`."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from udkjax.requirements import ArgumentError

THREADS_VARIABLE = "UDKJAX_THREADS"


def cores() -> int:
    """Return the number of cores that this process may use, which schedulers of clusters restrict."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_limit() -> int | None:
    """Return the value of `UDKJAX_THREADS`; None if it is not set.

    Raises:
        ArgumentError: the value is not a positive whole number.
    """
    text = os.environ.get(THREADS_VARIABLE, "").strip()
    if not text:
        return None
    if not (text.isascii() and text.isdecimal() and int(text)):
        raise ArgumentError(f"{THREADS_VARIABLE} must be a whole number of threads, 1 or more, not {text!r}")
    return int(text)


def thread_count() -> int:
    """Return the number of threads that a computation may use."""
    limit = thread_limit()
    return cores() if limit is None else min(limit, cores())


@cache
def shared_threads() -> ThreadPoolExecutor:
    """Return the pool of threads that all calls of machine code share, since starting a thread takes longer than a short run."""
    return ThreadPoolExecutor(cores())
