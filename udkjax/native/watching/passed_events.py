"""The events that a run passes: the numbers that they change, and the layout of their record."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

from udkjax.expressions import ScalarProgram
from udkjax.native.module.layout import Layout


@dataclass(frozen=True)
class Turning:
    """The kinks that a run passes; their conditions have the indices from `first` on."""

    first: int
    turns: tuple[tuple[int, float, float], ...]  # of each kink: its side, which becomes `factor` times itself plus `shift`
    of_conditions: tuple[tuple[int, int], ...]  # places of sides among the numbers of conditions, each with its side
    renewals: tuple[tuple[Any, tuple[tuple[str, int], ...], int], ...]
    """For each force the `SmoothLoads` with the program of its sides, which may depend on each other and on the state; the inputs
    of the program, arrays of the module's memory with indices; and the first of its sides."""

    @property
    def sides(self) -> range:
        """The indices of the sides of kinks among all sides."""
        first = min(first for _, _, first in self.renewals)
        return range(first, first + sum(smooth.count for smooth, _, _ in self.renewals))

    def lay_out(self, places: Layout):
        """Reserve the memory of kinks in the layout of a module."""
        places.add("renewed sides", self.sides.stop)


@dataclass(frozen=True)
class SlideLock:
    """The lock that holds a joint at rest: a program that computes those of its numbers that depend on q."""

    key: str  # text of the program
    program: ScalarProgram = field(compare=False)  # its numbers that depend on q, from q and its constant numbers

    def constants(self, n: int) -> int:
        """Return the number of constants of the lock: the inputs of its program other than the n coordinates."""
        return len(self.program.inputs) - n


@dataclass(frozen=True)
class Sliding:
    """The joints with set-valued friction whose events a run passes.

    Joint j has two sides: side 2 j is its direction of sliding, 1, -1, or 0 if it sticks; side 2 j + 1 is zero except for joints
    that others keep at rest. The condition with index `first` + 2 j is its speed in the forward direction, and the watched force
    with index `first_force` + 2 j the distance of its force from the limit in this direction. The indices plus one belong to the
    backward direction.
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
        """A limit on pivots at one event, rounds in which joints that violate the law of friction change their modes.

        With more of them the run ends at the event, and Python decides.
        """
        return (self.block_steps + self.single_steps) * self.count + 8

    @property
    def lock_count(self) -> int:
        """The length of the array `locks`.

        It holds one for each lock that is on, else zero; then the mark of the row of each lock; then their numbers that depend
        on q.
        """
        return 2 * len(self.locks) + sum(len(x.program.outputs) for x in self.locks)

    def lay_out(self, places: Layout, n: int):
        """Reserve the memory of joints that slide in the layout of a module with n coordinates."""
        places.add("lock constants", sum(x.constants(n) for x in self.locks))
        places.add("new locks", self.lock_count)
        places.add("joints at rest", self.count)
        places.add("joints that stop", self.count)


@dataclass(frozen=True)
class Passing:
    """The events that a run passes: kinks, and joints with set-valued friction that stop or slip; None: these end the run."""

    kinks: Turning | None
    slides: Sliding | None
    sides: int  # the number of sides: of joints that may stick, then of kinks
    of_scene: tuple[tuple[int, str, int], ...]  # places among the numbers of the scene, each with an array of a lane and an index
    zero: float  # bound below which a condition is zero, relative to its scale

    most: ClassVar[int] = 64  # events in a record: each member has one, and further events take a further call

    @property
    def locks(self) -> int:
        """The length of the array `locks`; 0 if the run passes no slides."""
        return self.slides.lock_count if self.slides else 0

    def constants(self, n: int) -> int:
        """Return the number of constants of all locks, for n coordinates."""
        return sum(x.constants(n) for x in self.slides.locks) if self.slides else 0

    @property
    def joints(self) -> int:
        """The number of joints with locks."""
        return len(self.slides.locks) if self.slides else 0

    def row_length(self, n: int) -> int:
        """Return the length of the record of one event: condition, time, q, v before and v after, sides, and locked joints."""
        return 2 + 3 * n + self.sides + self.joints

    def record_length(self, n: int) -> int:
        """Return the length of the record of a run: the number of events, the last numbers of the locks, and a row per event."""
        return 1 + self.locks + self.most * self.row_length(n)
