"""How far a long computation is."""

import sys
import time
from typing import TextIO

QUIET = 15.0  # s between lines where they cannot be written over


class Progress:
    """Say what is being done, which part is done, and how long it will take: on one line of a terminal, else on a few lines."""

    def __init__(self, stream: TextIO | None = None):
        self.stream = sys.stderr if stream is None else stream
        self.begun = time.monotonic()
        self.said = -QUIET

    def __call__(self, what: str, part: float) -> None:
        """Show that `what` is being done, and that `part` (0 to 1) of everything is done."""
        spent = time.monotonic() - self.begun
        left = f", about {spent * (1 / part - 1):.0f} s left" if 0 < part < 1 else ""
        line = f"{what} ({100 * part:.0f} %, {spent:.0f} s{left})"
        if self.stream.isatty():
            print(f"\r{line:<78}", end="\n" if part >= 1 else "", file=self.stream, flush=True)
        elif part >= 1 or spent - self.said >= QUIET:
            self.said = spent
            print(line, file=self.stream, flush=True)
