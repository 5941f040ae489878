"""Loaded machine code, registered in XLA as the target of a foreign function."""

import ctypes
from threading import Lock
from typing import Any
from weakref import WeakValueDictionary

import jax

from udkjax.native.base import machine


class Code:
    """Loaded machine code and its function `run`, which keeps the code loaded."""

    def __init__(self, name: str, library: machine.Library):
        self._name, self.library = name, library
        self.run: Any = machine.function(library["run"], ctypes.c_void_p)
        self.run.library = library

    @property
    def name(self) -> str:
        """The name of its FFI target in XLA, for optimized code; it is never freed from then on.

        XLA keeps one address for each name, and compiled programs may call it at any time.
        """
        with _LOADING:
            if self._name not in _REGISTERED:
                capsule = jax.ffi.pycapsule(ctypes.c_void_p(self.library["call_frame"]))
                jax.ffi.register_ffi_target(self._name, capsule, platform="cpu")
                _REGISTERED[self._name] = self
        return self._name


_LOADED: WeakValueDictionary[str, Code] = WeakValueDictionary()  # optimized code that serves all callers with the same text
_REGISTERED: dict[str, Code] = {}
_LOADING = Lock()


def load(text: str, level: int = machine.LEVEL) -> Code:
    """Load the code of a module at a level of optimization, or optimized code if available."""
    name = f"udkjax_{machine.digest(text)}"
    with _LOADING:
        code = _LOADED.get(name)
        if code is None:
            code = Code(name, machine.library(text, ("run", "call_frame"), level))
            if code.library.is_optimized:
                _LOADED[name] = code
        return code
