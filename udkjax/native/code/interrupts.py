"""Interruption of long runs: Ctrl-C ends runs of machine code within a step, in all threads.

Python's handler of SIGINT only notes the signal; the main thread raises `KeyboardInterrupt` when it returns to Python, and thus
waits for machine code. The handler written here counts signals and calls Python's. `run` compares the count with that at its
start before each step, and ends its members as `INTERRUPTED` once it differs. Runs that begin later are not affected.

The handler replaces Python's only while that raises `KeyboardInterrupt`: a program with a handler of its own, which may want
runs to end as usual, keeps it. Programs may set handlers at any time. Loading code installs the handler, each call from Python
does again, and so does `run` after ARMING_STEPS steps, for compiled programs of JAX, which call machine code without Python.
"""

import ctypes
import signal
from functools import cache
from typing import Any

from udkjax.native.code import machine
from udkjax.native.language.ir import INT, POINTER, Function, Value

POINTER_NAME = "interrupts"  # pointer of a module, set by the host, to a record: the count, and the address of `install`
POINTER_GLOBAL = f"@{POINTER_NAME} = global ptr null"
ARMING_STEPS = 2**14  # steps of a call, some 30 ms, after which it installs the handler

_HANDLER_TEXT = """
@record = global { i64, ptr } zeroinitializer
@previous = global ptr null

define void @on_interrupt(i32 %signal) {
  %count = atomicrmw add ptr @record, i64 1 seq_cst, align 8
  %previous = load ptr, ptr @previous, align 8
  call void %previous(i32 %signal)
  ret void
}
"""


class _Handler:
    """The handler of SIGINT as machine code, which stays loaded as long as the process runs."""

    def __init__(self):
        self._library = machine.library(_HANDLER_TEXT, ("record", "previous", "on_interrupt"))
        self.record, self._address = self._library["record"], self._library["on_interrupt"]
        self._get, self._set = (getattr(ctypes.pythonapi, f"PyOS_{x}sig") for x in ("get", "set"))
        self._get.argtypes, self._set.argtypes = (ctypes.c_int,), (ctypes.c_int, ctypes.c_void_p)
        self._get.restype = self._set.restype = ctypes.c_void_p
        self._previous = ctypes.c_void_p.from_address(self._library["previous"])
        self._install: Any = ctypes.CFUNCTYPE(None)(self.install)
        ctypes.c_void_p.from_address(self.record + 8).value = ctypes.cast(self._install, ctypes.c_void_p).value

    def install(self) -> None:
        """Replace Python's handler of SIGINT by this one, which calls Python's; leave any other handler in its place."""
        current = self._get(signal.SIGINT)
        if current == self._address or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
            return
        if self._previous.value in (None, current):  # Python has one for all signals
            self._previous.value = current
            self._set(signal.SIGINT, self._address)


@cache
def handler() -> _Handler:
    """Return the handler of this process, loaded in the first call; signals end runs once it is installed."""
    return _Handler()


def connect(library: machine.Library) -> None:
    """Install the handler, and connect a loaded module with it, so that Ctrl-C ends the runs of the module."""
    handler().install()
    ctypes.c_void_p.from_address(library[POINTER_NAME]).value = handler().record


# --- in the code of `run`


class Interruption:
    """The code in `run` that checks before each step for signals since the start of the run."""

    def __init__(self, f: Function):
        self._f = f
        self._record = f.op(f"load ptr, ptr @{POINTER_NAME}, align 8", POINTER)
        self._start = self._count()
        self._steps = f.variable(0, INT, 1)

    def _count(self) -> Value:
        return self._f.op(f"load atomic i64, ptr {self._record.name} monotonic, align 8", INT)

    def has_come(self) -> Value:
        """Return whether a signal has come since the start of the run.

        The code runs once for each step, counts steps, and installs the handler again after `ARMING_STEPS` steps.
        """
        f, steps = self._f, self._steps.value + 1
        self._steps.value = steps
        with f.if_(steps.is_(ARMING_STEPS)):
            install = f.op(f"load ptr, ptr {f.at(self._record, 1, INT).name}, align 8", POINTER)
            f.line(f"call void {install.name}()")
        return self._count().is_not(self._start)
