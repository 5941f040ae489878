"""How far a sweep is: who is done, who failed, who was slowest, and how long the rest will take."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TextIO

import numpy as np
from numpy.typing import ArrayLike

from udkjax.integrate.solution import Result
from udkjax.study.progress import Line
from udkjax.study.sweep.plan import Chunk

PATIENCE = 1.0  # s: nothing is shown of a sweep that takes no longer
STEPS = "steps"  # the variable by which members are compared


@dataclass(frozen=True)
class Status:
    """How far a sweep is."""

    members: int  # all of them
    done: int  # those of an earlier run that it goes on with among them
    seconds: float  # since this run began
    rate: float | None  # members a second, in this run; None until something is done
    left: float | None  # s; None until it can be said
    failures: Mapping[str, int]  # how many members ended with which `Result`, successes left out
    slowest: tuple[int, int] | None = None  # the member that took most steps, and how many; None where steps are not kept
    slowest_chunk: tuple[int, float] | None = None  # the chunk that took longest, and how long (s)

    def __str__(self) -> str:
        part = 100 * self.done / self.members if self.members else 100.0
        said = [f"{self.done} of {self.members} members ({part:.0f} %)"]
        if self.rate is not None:
            said.append(f"{self.rate:.3g} a second")
        said.append(duration(self.seconds) if self.left is None or self.done == self.members else f"{duration(self.left)} left")
        failed = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in self.failures.items())
        said.append(f"failed: {failed}" if failed else "none failed")
        if self.slowest_chunk is not None:
            said.append("slowest chunk {}: {:.1f} s".format(*self.slowest_chunk))
        if self.slowest is not None:
            said.append("slowest member {}: {} steps".format(*self.slowest))
        return "; ".join(said)


class Watch:
    """Follow a sweep of so many members, of which the chunks `left` are still to be computed; an earlier run ended with `codes`.

    `tell` is called with the `Status` at the start and after each chunk.
    """

    def __init__(self, members: int, left: Sequence[Chunk], tell: Callable[[Status], Any], codes: ArrayLike = ()):
        self.tell = tell
        self.work, self.work_done, self.new = sum(chunk.work for chunk in left), 0.0, 0
        self.begun = time.monotonic()
        self.first: tuple[float, float] | None = None  # when the first chunk came, and its work: a compilation was part of it
        self.status = Status(members, members - sum(len(chunk.members) for chunk in left), 0.0, None, None, _failed({}, codes))
        self.tell(self.status)

    def __call__(self, chunk: Chunk, data: Mapping[str, np.ndarray], seconds: float | None = None) -> None:
        """Note that a chunk is done, what it gave, and how long it took (s) where that is known."""
        before, now = self.status, time.monotonic()
        self.new += len(chunk.members)
        self.work_done += chunk.work
        self.first = self.first or (now, self.work_done)
        self.status = Status(
            before.members,
            before.done + len(chunk.members),
            now - self.begun,
            self.new / max(now - self.begun, 1e-9),
            self._left(now),
            _failed(before.failures, data["result"]),
            _slower(before.slowest, chunk.members, data.get(STEPS)),
            _slower(before.slowest_chunk, [chunk.index], seconds),
        )
        self.tell(self.status)

    def _left(self, now: float) -> float | None:
        """How long the rest takes (s), by the pace since the first chunk came."""
        assert self.first is not None
        since, work = now - self.first[0], self.work_done - self.first[1]
        return since / work * (self.work - self.work_done) if work > 0 else None


def _failed(before: Mapping[str, int], codes: ArrayLike) -> dict[str, int]:
    """Add to the numbers of members that ended with each `Result`; successes are left out."""
    found = Counter(before)
    for code, count in zip(*np.unique(np.asarray(codes, int), return_counts=True), strict=True):
        if code != Result.successful:
            found[Result(code).name] += int(count)
    return dict(found)


def _slower(before: tuple[int, Any] | None, who: ArrayLike, values: ArrayLike | None) -> tuple[int, Any] | None:
    """Return the largest of the values and whose it is, unless one before was as large."""
    if values is None:
        return before
    values = np.atleast_1d(values)
    most = int(np.argmax(values))
    return before if before is not None and before[1] >= values[most] else (int(np.asarray(who)[most]), values[most].item())


def teller(progress: Any, stream: TextIO | None = None) -> Callable[[Status], Any]:
    """Return what shows how far a sweep is: nothing (False), a function of the `Status` that was given, or a line."""
    if progress is False:
        return lambda status: None
    if callable(progress):
        return progress
    line = Line(stream)

    def show(status: Status) -> None:
        last = status.done == status.members
        if status.seconds >= PATIENCE and (last or line.due()):
            line.say(str(status), last)

    return show


def duration(seconds: float) -> str:
    """Say how long something takes."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
