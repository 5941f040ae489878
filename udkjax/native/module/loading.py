"""Loaded machine code, registered in XLA as the target of a foreign function."""

import ctypes
import traceback
from collections.abc import Callable
from threading import Lock, RLock
from typing import Any
from weakref import WeakValueDictionary

import jax

from udkjax.native.code import interrupts, machine
from udkjax.native.module import leaving


class Later:
    """The code of the later module of a module that runs may leave (leaving.py)."""

    def __init__(self, library: machine.Library, load: Callable[[], "Code"]):
        self._load_code, self._lock = load, RLock()
        self._pointer = ctypes.c_void_p.from_address(library[leaving.LATER])
        self.code: Code | None = None  # None until it is loaded

    def load(self) -> int:
        """Load the code; return the address of its function `resume`, or null if that fails, after printing the error.

        Machine code calls this from any thread, also of XLA, and cannot pass an error on: it refuses the call.
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
    """Loaded machine code and its function `run`, which keeps the code loaded.

    `load_later` loads the code of the later module of a module that runs may leave.
    """

    def __init__(
        self, name: str, library: machine.Library, is_interruptible: bool, load_later: "Callable[[], Code] | None" = None
    ):
        self._name, self.library = name, library
        self.run: Any = machine.function(library["run"], ctypes.c_void_p)
        self.run.library, self.later = library, None
        if is_interruptible:
            interrupts.connect(library)
        if load_later is not None:
            self.run.later = self.later = Later(library, load_later)
            self.run.load_later = ctypes.CFUNCTYPE(ctypes.c_void_p)(self.later.load)
            address = ctypes.cast(self.run.load_later, ctypes.c_void_p).value
            ctypes.c_void_p.from_address(library[leaving.LOAD]).value = address

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


def load(text: str, level: int = machine.LEVEL, load_later: Callable[[], Code] | None = None) -> Code:
    """Load the code of a module at a level of optimization, or optimized code if available.

    `load_later`: loads the code of the later module; None if runs do not leave this one.
    """
    names = (
        "run",
        "call_frame",
        *([interrupts.POINTER_NAME] if (is_interruptible := interrupts.GLOBAL in text) else ()),
        *(leaving.POINTERS if load_later else [leaving.RESUME] if f"@{leaving.RESUME}(" in text else []),
    )
    name = f"udkjax_{machine.digest(text)}"
    with _LOADING:
        code = _LOADED.get(name)
        if code is None:
            code = Code(name, machine.library(text, names, level), is_interruptible, load_later)
            if code.library.is_optimized:
                _LOADED[name] = code
        return code
