"""Progress of a long computation, reported the same way by every function that has a `progress` argument."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from typing_extensions import TypeAliasType

PATIENCE = 2.0  # s: a computation that takes no longer needs no line to say so
TERMINAL_INTERVAL, FILE_INTERVAL = 0.2, 15.0  # s between two states of a line that is written over, and of one that cannot be

BAR = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"


@dataclass(frozen=True)
class Progress:
    """Progress of a computation, as a callable given as `progress=` receives it, once at least for everything that is done.

    Attributes:
        what: name of the computation, such as "identify".
        done: part that is done, in the units of `total`.
        total: amount to do; None where that is not known beforehand.
        seconds: time since the computation began (s).
        message: further words about its state.
    """

    what: str
    done: float
    total: float | None
    seconds: float
    message: str = ""

    @property
    def left(self) -> float | None:
        """Time that the rest takes at the pace so far (s); None where it cannot be said."""
        return self.seconds * (self.total / self.done - 1.0) if self.total and self.done > 0 else None

    def __str__(self) -> str:
        part = "" if not self.total else f" {100 * self.done / self.total:.0f} %"
        left = "" if self.left is None or self.done == self.total else f", about {self.left:.0f} s left"
        return f"{self.what}:{part} ({self.seconds:.0f} s{left}){f' {self.message}' if self.message else ''}"


ProgressOption = TypeAliasType("ProgressOption", Callable[[Progress], object] | bool | Literal["auto"] | None)


class Report:
    """Function that a computation calls: `report(done, message)`; with None for `done`, as much is done as before."""

    def __init__(self, show: Callable[[Progress], object], what: str, total: float | None):
        self.show, self.begun = show, time.monotonic()
        self.state = Progress(what, 0, total, 0.0)

    def __call__(self, done: float | None = None, message: str = "") -> None:
        before = self.state
        done = before.done if done is None else done
        self.state = Progress(before.what, done, before.total, time.monotonic() - self.begun, message)
        self.show(self.state)


@contextmanager
def report_progress(
    progress: ProgressOption, total: float | None, what: str, patience: float = PATIENCE, interval: float | None = None
) -> Iterator[Report]:
    """Report the progress of the computation in the body of a `with` statement.

    Args:
        progress: None or "auto" writes a line to stderr if the computation takes longer than two seconds, True at once, False
            never; a callable gets a `Progress` at each report. An exception from it ends the computation.
        total: amount to do, in any unit; None where that is not known.
        what: name of the computation, as it stands before the line.
        patience: time (s) after which there is a line by default.
        interval: time (s) between two states of the line; by default what suits a terminal, or a file.

    Returns:
        The function `report(done, message="")` to call whenever some of it is done.

    Raises:
        TypeError: `progress` is none of these.
    """
    if callable(progress):
        yield Report(progress, what, total)
    elif progress is False:
        yield Report(lambda state: None, what, total)
    elif progress is None or progress is True or progress == "auto":
        line = _Line(what, total, 0.0 if progress is True else patience, interval)
        try:
            yield Report(line.show, what, total)
        finally:
            line.close()
    else:
        raise TypeError(f'progress must be None, "auto", True, False or a function of a Progress, is {progress!r}')


class _Line:
    """A bar of tqdm on stderr, made by a timer: so it appears too while the first piece of work compiles."""

    def __init__(self, what: str, total: float | None, patience: float, interval: float | None):
        self.what, self.total, self.begun = what, total, time.time()
        usual = TERMINAL_INTERVAL if sys.stderr.isatty() or "ipykernel" in sys.modules else FILE_INTERVAL
        self.interval = usual if interval is None else interval
        self.bar: Any = None
        self.state: Progress | None = None
        self.lock = threading.Lock()
        self.timer = threading.Timer(patience, self._open)
        self.timer.daemon = True
        if patience:
            self.timer.start()
        else:
            self._open()

    def _open(self) -> None:
        from tqdm.auto import tqdm

        layout = "{desc}: {elapsed}{postfix}" if self.total is None else BAR
        with self.lock:
            bar = tqdm(
                desc=self.what, total=self.total, file=sys.stderr, mininterval=self.interval, miniters=0, bar_format=layout
            )
            bar.start_t = self.begun
            self.bar = bar
            self._update()

    def show(self, state: Progress) -> None:
        with self.lock:
            self.state = state
            self._update()

    def _update(self) -> None:
        if self.bar is not None and self.state is not None:
            self.bar.set_postfix_str(self.state.message, refresh=False)
            self.bar.update(self.state.done - self.bar.n)

    def close(self) -> None:
        self.timer.cancel()
        with self.lock:
            if self.bar is not None:
                self.bar.close()
