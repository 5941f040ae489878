"""Calls of functions, which a test observes without replacing them."""

import gc
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType, FrameType
from typing import Any, NamedTuple


class Call(NamedTuple):
    """A call that has ended, with its arguments by name; the result of one that has raised an error is None."""

    function: Callable[..., Any]
    arguments: dict[str, Any]
    result: Any


@contextmanager
def listening(listen: Callable[[FrameType, str, Any], object]) -> Iterator[None]:
    """Let a listener hear of all calls of Python in this thread meanwhile."""
    gc.disable()  # what is collected meanwhile calls the package, too: caches forget it
    sys.setprofile(listen)
    try:
        yield
    finally:
        sys.setprofile(None)
        gc.enable()


@contextmanager
def calls_of(*functions: Callable[..., Any], begins: Callable[[dict[str, Any]], object] | None = None) -> Iterator[list[Call]]:
    """Note the calls of functions in this thread meanwhile, those within their caches or checks, in the order of their ends.

    `begins` is called with the arguments at the beginning of each call: arrays may change later.
    """
    noted: list[Call] = []
    begun: dict[FrameType, dict[str, Any]] = {}
    known: dict[CodeType, Callable[..., Any]] = {inspect.unwrap(f).__code__: f for f in functions}

    def listen(frame: FrameType, event: str, value: Any):
        if frame.f_code not in known:
            return
        if event == "call":
            begun[frame] = dict(frame.f_locals)
            if begins:
                begins(begun[frame])
        elif event == "return" and frame in begun:
            noted.append(Call(known[frame.f_code], begun.pop(frame), value))

    with listening(listen):
        yield noted
