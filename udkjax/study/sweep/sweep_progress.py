"""The progress of a sweep: who is done, who failed, who was slowest, and how long the rest will take."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from udkjax.integrate.solution import Result
from udkjax.study.progress import Progress
from udkjax.study.sweep.plan import Chunk

T = TypeVar("T", int, float)
STEPS = "steps"  # the variable by which members are compared


@dataclass(frozen=True)
class SweepProgress(Progress):
    """The progress of a sweep: `done` of `total` members, those of an earlier run that it goes on with among them.

    Attributes:
        rate: members a second, in this run; None until something is done.
        remaining: time that the rest takes (s), by the work that is left; None until it can be said.
        failures: how many members ended with which `Result`, successes left out.
        slowest: the member that took most steps, and how many; None where steps are not stored.
        slowest_chunk: the chunk that took longest, and how long (s).
    """

    rate: float | None = None
    remaining: float | None = None
    failures: Mapping[str, int] = field(default_factory=dict)
    slowest: tuple[int, int] | None = None
    slowest_chunk: tuple[int, float] | None = None

    @property
    def left(self) -> float | None:
        return self.remaining

    def __str__(self) -> str:
        part = 100 * self.done / self.total if self.total else 100.0
        time_left = duration(self.seconds) if self.left is None or self.done == self.total else f"{duration(self.left)} left"
        rate = [] if self.rate is None else [f"{self.rate:.3g} a second"]
        return "; ".join([f"{self.done:g} of {self.total:g} members ({part:.0f} %)", *rate, time_left, self.message])


class Watch:
    """Follow a sweep of so many members, of which an earlier run has `done` some, that ended with `codes`.

    `show` is called with the `SweepProgress` at the start and after each chunk.
    """

    def __init__(self, members: int, done: int, show: Callable[[SweepProgress], object], codes: ArrayLike = ()):
        self.show, self.new = show, 0
        self.begun = time.monotonic()
        self.since, self.work, self.work_done = self.begun, 0.0, 0.0  # of chunks whose work is known
        failures = _count_failures({}, codes)
        self.state = SweepProgress("sweep", done, members, 0.0, _message(failures), failures=failures)
        self.show(self.state)

    def expect(self, chunks: Sequence[Chunk]) -> None:
        """Take the work that is left from these chunks, which are all that are to come."""
        self.since, self.work = time.monotonic(), sum(chunk.work for chunk in chunks)

    def __call__(self, chunk: Chunk, data: Mapping[str, np.ndarray], seconds: float | None = None) -> None:
        """Note that a chunk is done, what it gave, and how long it took (s) where that is known."""
        before, now = self.state, time.monotonic()
        self.new += len(chunk.members)
        self.work_done += chunk.work if self.work else 0.0
        failures = _count_failures(before.failures, data["result"])
        slowest = _find_slowest(before.slowest, chunk.members, data.get(STEPS))
        slowest_chunk = _find_slowest(before.slowest_chunk, [chunk.index], seconds)
        self.state = SweepProgress(
            before.what,
            before.done + len(chunk.members),
            before.total,
            now - self.begun,
            _message(failures, slowest, slowest_chunk),
            self.new / max(now - self.begun, 1e-9),
            self._left(now),
            failures,
            slowest,
            slowest_chunk,
        )
        self.show(self.state)

    def _left(self, now: float) -> float | None:
        """Estimate how long the rest takes (s), by the pace since its work is known."""
        return (now - self.since) / self.work_done * (self.work - self.work_done) if self.work_done > 0 else None


def _message(
    failures: Mapping[str, int], slowest: tuple[int, int] | None = None, slowest_chunk: tuple[int, float] | None = None
) -> str:
    failed = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in failures.items())
    parts = [f"failed: {failed}" if failed else "none failed"]
    parts += [] if slowest_chunk is None else ["slowest chunk {}: {:.1f} s".format(*slowest_chunk)]
    parts += [] if slowest is None else ["slowest member {}: {} steps".format(*slowest)]
    return "; ".join(parts)


def _count_failures(before: Mapping[str, int], codes: ArrayLike) -> dict[str, int]:
    """Add to the numbers of members that ended with each `Result`; successes are left out."""
    found = Counter(before)
    for code, count in zip(*np.unique(np.asarray(codes, int), return_counts=True), strict=True):
        if code != Result.successful:
            found[Result(code).name] += int(count)
    return dict(found)


def _find_slowest(before: tuple[int, T] | None, who: ArrayLike, values: ArrayLike | None) -> tuple[int, T] | None:
    """Return the largest of the values and whose it is, unless one before was as large."""
    if values is None:
        return before
    values = np.atleast_1d(values)
    most = int(np.argmax(values))
    return before if before is not None and before[1] >= values[most] else (int(np.asarray(who)[most]), values[most].item())


def duration(seconds: float) -> str:
    """Say how long something takes."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
