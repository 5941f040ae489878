"""Progress of a long computation, reported in the same way by all functions with a `progress` argument."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from typing_extensions import TypeAliasType

QUIET_SECONDS = 2.0  # s; shorter computations show no progress
TERMINAL_INTERVAL, FILE_INTERVAL = 0.2, 15.0  # s between updates of a line in a terminal, and of lines in a file

BAR_FORMAT = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"


@dataclass(frozen=True)
class Progress:
    """Progress of a computation: the argument of a callable given as `progress=`, which is called at least once, at the end.

    Attributes:
        what: name of the computation, such as "identify".
        done: amount done, in the units of `total`.
        total: amount to do; None if unknown.
        seconds: time since the computation began (s).
        message: a description of the state of the computation; "" if there is none.
    """

    what: str
    done: float
    total: float | None
    seconds: float
    message: str = ""

    @property
    def left(self) -> float | None:
        """Estimated time left (s), at the pace so far; None if unknown."""
        return self.seconds * (self.total / self.done - 1.0) if self.total and self.done > 0 else None

    def __str__(self) -> str:
        percent = "" if not self.total else f" {100 * self.done / self.total:.0f} %"
        left = "" if self.left is None or self.done == self.total else f", about {self.left:.0f} s left"
        return f"{self.what}:{percent} ({self.seconds:.0f} s{left}){f' {self.message}' if self.message else ''}"


ProgressOption = TypeAliasType("ProgressOption", Callable[[Progress], object] | bool | Literal["auto"] | None)


class Report:
    """The function `report(done, message)` that a computation calls to report its progress.

    `done` is the amount done so far; with None, it stays as it was.
    """

    def __init__(self, show: Callable[[Progress], object], what: str, total: float | None):
        self.show, self.begun = show, time.monotonic()
        self.state = Progress(what, 0, total, 0.0)

    def __call__(self, done: float | None = None, message: str = "") -> None:
        previous = self.state
        done = previous.done if done is None else done
        self.state = Progress(previous.what, done, previous.total, time.monotonic() - self.begun, message)
        self.show(self.state)


@contextmanager
def report_progress(
    progress: ProgressOption, total: float | None, what: str, patience: float = QUIET_SECONDS, interval: float | None = None
) -> Iterator[Report]:
    """Report the progress of the computation in the body of a `with` statement.

    Args:
        progress: None or "auto" writes a line to stderr if the computation takes longer than two seconds, True at once, False
            never; a callable receives a `Progress` at each report. An exception in it ends the computation.
        total: amount to do, in any unit; None if unknown.
        what: name of the computation, at the beginning of the line.
        patience: time (s) after which a line appears by default.
        interval: time (s) between updates of the line; the default depends on whether stderr is a terminal or a file.

    Returns:
        The function `report(done, message="")`, to be called as the computation proceeds.

    Raises:
        TypeError: `progress` is anything else.
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
        raise TypeError(f'progress must be None, "auto", True, False or a function of a Progress, not {progress!r}')


class _Line:
    """A tqdm bar on stderr, shown by a timer, so that it also appears while the first part of the work is compiled."""

    def __init__(self, what: str, total: float | None, patience: float, interval: float | None):
        self.what, self.total, self.begun = what, total, time.time()
        default = TERMINAL_INTERVAL if sys.stderr.isatty() or "ipykernel" in sys.modules else FILE_INTERVAL
        self.interval = default if interval is None else interval
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

        layout = "{desc}: {elapsed}{postfix}" if self.total is None else BAR_FORMAT
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
