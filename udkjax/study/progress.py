"""How far a long computation is: one line that is written over, in a terminal or a notebook; elsewhere a line now and then."""

import shutil
import sys
import time
from typing import TextIO

OFTEN = 0.2  # s between two looks of what is written over
QUIET = 15.0  # s between lines where they cannot be written over


class Line:
    """A line of a stream (default: standard error) that says how far something is."""

    def __init__(self, stream: TextIO | None = None):
        self.stream = sys.stderr if stream is None else stream
        self.notebook = type(self.stream).__module__.startswith("ipykernel")
        self.over = self.notebook or self.stream.isatty()
        self._said, self._width = float("-inf"), 0

    def due(self, often: float = OFTEN) -> bool:
        """Whether it is time to say something again."""
        return time.monotonic() - self._said >= (often if self.over else QUIET)

    def say(self, text: str, last: bool = False) -> None:
        """Say something in place of what was said before; `last`: nothing more will be."""
        self._said = time.monotonic()
        if not self.over:
            print(text, file=self.stream, flush=True)
            return
        if not self.notebook:  # a line that goes on in the next cannot be written over
            text = text[: shutil.get_terminal_size().columns - 1]
        print(f"\r{text:<{self._width}}", end="\n" if last else "", file=self.stream, flush=True)
        self._width = len(text)


class Progress:
    """Say what is being done, which part of everything is done, and how long the rest will take."""

    def __init__(self, stream: TextIO | None = None):
        self.line = Line(stream)
        self.begun = time.monotonic()

    def __call__(self, what: str, part: float) -> None:
        """Show that `what` is being done, and that `part` (0 to 1) of everything is done."""
        spent = time.monotonic() - self.begun
        left = f", about {spent * (1 / part - 1):.0f} s left" if 0 < part < 1 else ""
        if part >= 1 or self.line.due(0.0):
            self.line.say(f"{what} ({100 * part:.0f} %, {spent:.0f} s{left})", last=part >= 1)
