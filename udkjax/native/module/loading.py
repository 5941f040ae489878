"""Loaded machine code, called from Python or registered in XLA as the target of foreign function calls."""

import ctypes
import traceback
import zlib
from collections.abc import Callable, Sequence
from threading import Lock, RLock
from typing import Any
from weakref import WeakValueDictionary

import jax

from udkjax.native.code import interrupts, machine
from udkjax.native.module import leaving


class Later:
    """The later module of a module that runs may leave (leaving.py); its `code` is loaded on demand."""

    def __init__(self, library: machine.Library, load: Callable[[], "Code"]):
        self._load_code, self._lock = load, RLock()
        self._pointer = ctypes.c_void_p.from_address(library[leaving.LATER_POINTER])
        self.code: Code | None = None  # None until it is loaded

    def load(self) -> int:
        """Load the code; return the address of its function `resume`, or 0 if that fails, after printing the error.

        Machine code calls this from any thread, also of XLA. It cannot pass Python's error on, and reports no memory instead.
        """
        try:
            with self._lock:
                code = self.code or self._load_code()
                self.code, self._pointer.value = code, code.library[leaving.RESUME]
                return code.library[leaving.RESUME]
        except BaseException:
            traceback.print_exc()
            return 0


class Code:
    """The loaded machine code of a module; the code stays loaded as long as this object or its function `run` exists.

    Args:
        name: The name for XLA.
        library: The loaded code.
        is_interruptible: Whether the code checks for Ctrl-C.
        load_later: Loads the code of the later module; None if runs do not leave this one.
        packed_text: LLVM's text of the module, compressed.
    """

    def __init__(
        self,
        name: str,
        library: machine.Library,
        is_interruptible: bool,
        load_later: "Callable[[], Code] | None" = None,
        packed_text: bytes = b"",
    ):
        self._name, self.library, self._packed_text = name, library, packed_text
        self.run: Any = machine.function(library["run"], ctypes.c_void_p)
        self.run.library, self.later = library, None
        if is_interruptible:
            interrupts.connect(library)
        if load_later is not None:
            self.run.later = self.later = Later(library, load_later)
            self.run.load_later = ctypes.CFUNCTYPE(ctypes.c_void_p)(self.later.load)
            address = ctypes.cast(self.run.load_later, ctypes.c_void_p).value
            ctypes.c_void_p.from_address(library[leaving.LOAD_POINTER]).value = address

    def texts(self) -> list[str]:
        """Return the text of the module, and of the later module if runs may leave it."""
        text = zlib.decompress(self._packed_text).decode()
        if self.later is None:
            return [text]
        self.later.load()
        assert self.later.code is not None  # loaded, or an error was printed
        return [text, *self.later.code.texts()]

    @property
    def name(self) -> str:
        """The name of this (optimized) code as an FFI target of XLA.

        The first access registers the code, which is then never freed: XLA keeps one address for each name, and compiled
        programs may call it at any time.
        """
        self.register(self._name)
        return self._name

    def register(self, name: str) -> None:
        """Register the code with XLA under a name, unless some code is already registered under this name."""
        with _LOADING:
            if name not in _REGISTERED:
                capsule = jax.ffi.pycapsule(ctypes.c_void_p(self.library["call_frame"]))
                jax.ffi.register_ffi_target(name, capsule, platform="cpu")
                _REGISTERED[name] = self


_LOADED: WeakValueDictionary[str, Code] = WeakValueDictionary()  # optimized code that serves all callers with the same text
_REGISTERED: dict[str, Code] = {}
_LOADING = Lock()


def load(text: str, level: int = machine.OPTIMIZATION_LEVEL, load_later: Callable[[], Code] | None = None) -> Code:
    """Return the loaded code of a module. All callers with the same text share optimized code while it is loaded.

    Args:
        text: LLVM's text of the module.
        level: The level of code generation; code of a higher level is returned if it is available.
        load_later: Loads the code of the later module; None if runs do not leave this one.
    """
    names = (
        "run",
        "call_frame",
        *([interrupts.POINTER_NAME] if (is_interruptible := interrupts.POINTER_GLOBAL in text) else ()),
        *(leaving.POINTERS if load_later else [leaving.RESUME] if f"@{leaving.RESUME}(" in text else []),
    )
    name = f"udkjax_{machine.digest(text)}"
    with _LOADING:
        code = _LOADED.get(name)
        if code is None:
            code = Code(name, machine.library(text, names, level), is_interruptible, load_later, zlib.compress(text.encode(), 1))
            if code.library.is_optimized:
                _LOADED[name] = code
        return code


def registered(name: str) -> Code | None:
    """Return the code that is registered with XLA under a name; None if there is none."""
    return _REGISTERED.get(name)


def load_as(name: str, texts: Sequence[str]) -> None:
    """Load the code of the `texts` that `Code.texts` returned in another process, and register it under the name it had there."""
    later = texts[1:]
    load(texts[0], load_later=(lambda: load(later[0])) if later else None).register(name)
