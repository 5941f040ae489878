"""The events that a run passes by itself: the numbers that they change, and the layout of their record."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

from udkjax.expressions import ScalarProgram
from udkjax.native.module.layout import Layout


@dataclass(frozen=True)
class Turning:
    """The kinks that a run passes: those of its conditions from `first` on."""

    first: int
    turns: tuple[tuple[int, float, float], ...]  # of each kink: its side, which becomes `factor` times itself plus `shift`
    of_conditions: tuple[tuple[int, int], ...]  # places of sides among the numbers of conditions, each with its side
    renewals: tuple[tuple[Any, tuple[tuple[str, int], ...], int], ...]
    """For each force the `SmoothLoads` with the program of its sides, which may depend on each other and on the state; the inputs
    of the program, arrays of the module's memory with indices; and the first of its sides."""

    @property
    def sides(self) -> range:
        """Indices of the sides of kinks among all sides."""
        first = min(first for _, _, first in self.renewals)
        return range(first, first + sum(smooth.count for smooth, _, _ in self.renewals))

    def lay_out(self, places: Layout):
        """Reserve memory."""
        places.add("renewed sides", self.sides.stop)


@dataclass(frozen=True)
class SlideLock:
    """The lock that holds a joint at rest, as a program of the numbers that depend on q."""

    key: str  # text of the program
    program: ScalarProgram = field(compare=False)  # its numbers that depend on q, from q and its constant numbers

    def constants(self, n: int) -> int:
        """Return the number of constant numbers."""
        return len(self.program.inputs) - n


@dataclass(frozen=True)
class Sliding:
    """The joints with set-valued friction whose events a run passes.

    Joint j has the sides 2 j, its direction of sliding, and 2 j + 1, zero except for joints that others keep at rest. Its speed
    forwards is the condition `first` + 2 j, and its force, how far it is from its limit in this direction, is the watched force
    `first_force` + 2 j; those of the other direction follow.
    """

    count: int
    first: int
    first_force: int  # -1: the mechanism lacks the locks, and a run in which a joint sticks ends
    locks: tuple[SlideLock, ...]
    closed: float  # speed of a joint at rest, relative to the scale of its condition
    slow: float  # speed below which reversals are not located, in absolute tolerances
    still: float  # smallest part of the largest acceleration or force that is not zero
    block_steps: int  # pivots per joint of all joints that violate the law, then of the first such joint
    single_steps: int

    @property
    def most_pivots(self) -> int:
        """The largest number of pivots."""
        return (self.block_steps + self.single_steps) * self.count + 8

    @property
    def lock_count(self) -> int:
        """The number of numbers of the locks: of each, whether it is on, and the mark of its row; then those that depend on q."""
        return 2 * len(self.locks) + sum(len(x.program.outputs) for x in self.locks)

    def lay_out(self, places: Layout, n: int):
        """Reserve memory."""
        places.add("lock constants", sum(x.constants(n) for x in self.locks))
        places.add("new locks", self.lock_count)
        places.add("joints at rest", self.count)
        places.add("joints that stop", self.count)


@dataclass(frozen=True)
class Passing:
    """The events that a run passes."""

    kinks: Turning | None
    slides: Sliding | None
    sides: int  # the number of sides: of joints that may stick, then of kinks
    of_scene: tuple[tuple[int, str, int], ...]  # places among the numbers of the scene, each with an array of a lane and an index
    zero: float  # bound below which a condition is zero, relative to its scale

    most: ClassVar[int] = 64  # events in a record: each member has one, and further events take a further call

    @property
    def locks(self) -> int:
        """The number of numbers of the locks of joints that stick."""
        return self.slides.lock_count if self.slides else 0

    def constants(self, n: int) -> int:
        """Return the number of constant numbers of the locks."""
        return sum(x.constants(n) for x in self.slides.locks) if self.slides else 0

    @property
    def joints(self) -> int:
        """The number of joints that have locks."""
        return len(self.slides.locks) if self.slides else 0

    def row_length(self, n: int) -> int:
        """Return the length of the record of an event: its condition and time, q, v before and after, sides, locked joints."""
        return 2 + 3 * n + self.sides + self.joints

    def record_length(self, n: int) -> int:
        """Return the length of the record of a run: the number of events, the last numbers of the locks, a row for each event."""
        return 1 + self.locks + self.most * self.row_length(n)
