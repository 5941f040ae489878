"""Loaded machine code, registered in XLA as the target of a foreign function."""

import ctypes
from collections.abc import Callable
from threading import Lock
from typing import Any, NamedTuple

import jax

from udkjax.native.base import machine


class Code(NamedTuple):
    """Loaded machine code: the name of its FFI target in XLA, if optimized, and its function `run`."""

    name: str
    run: Callable[[int], Any]
    library: machine.Library


_LOADED: dict[str, Code] = {}
_LOADING = Lock()


def load(text: str, level: int = machine.LEVEL) -> Code:
    """Load the code of a module at a level of optimization, or optimized code if available.

    XLA keeps one address for each name, and compiled programs may call it at any time: loaded code is never freed, and serves all
    callers with the same text.
    """
    name = f"udkjax_{machine.digest(text)}"
    with _LOADING:
        if name in _LOADED:
            return _LOADED[name]
        library = machine.library(text, ("run", "call_frame"), level)
        code = Code(name, machine.function(library["run"], ctypes.c_void_p), library)
        if library.is_optimized:
            capsule = jax.ffi.pycapsule(ctypes.c_void_p(library["call_frame"]))
            jax.ffi.register_ffi_target(name, capsule, platform="cpu")
            _LOADED[name] = code
        return code
