"""Conditions that a run watches (watching.py): their program, what a run is given besides, and how finely it looks at them."""

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

from udkjax.expressions import ScalarProgram


class Resolution(NamedTuple):
    """How finely conditions are looked at; T is the shortest time in which anything changes.

    Attributes:
        per_time: intervals in T.
        resolved: fraction of the change of a condition in an interval that the cubic's error may be; beyond it the interval is
            too coarse. An oscillation then has at least 7 intervals in a period, and no two of its zeros lie in one; a smaller
            fraction takes more windows for the same events.
        miss: fraction of the error over two intervals that counts for one. Of a cubic it is 1/16, by the fourth power of the
            length, where the interval is fine; four times that is on the safe side where it is not yet. Where rates are
            differences, the whole error counts.
        far: multiple of the error; farther from zero a condition has no zero in an interval that is too coarse: a change large
            enough to get there would be resolved.
        finer: ratio of an interval that is too coarse to the next one.
        short: T; within a window of that length a condition has a jump or a kink, or varies all along.
        finest: T; changes within a window of that length are not resolved any more.
    """

    per_time: int = 16
    resolved: float = 0.05
    miss: float = 1 / 4
    far: float = 1 / 0.05
    finer: int = 8
    short: float = 1e-6
    finest: float = 1e-9


RESOLUTION = Resolution()
SHORT_PAIR = RESOLUTION.short / 16  # T: two of the 32 intervals of a window of that length
FINEST = 1e-9  # T: changes within a window of that length are not resolved any more
MOST_JUMPS = 3  # of conditions, before intervals are as long again as they were: of more, some are oscillations
# Two intervals meet at this share of them, and are shorter than they may be by up to another, which turns by the golden ratio, so
# that no oscillation is zero at all nodes.
MIDDLE, VARIES, TURN = 0.47, 0.2, 0.618
MOST_STUCK = 4  # times in a row that intervals become finer: before a jump, some of the finer ones are clear
FIRST, SECOND, THIRD = range(3)  # the node of two intervals that is next
LAST_CHANGE = 1e-7  # of the event time, in T: Taylor's step makes an error of its square
MOST_LANDINGS = 5  # steps that end at a crossing: one, as a rule
LEAST_STEP = 10  # times the smallest, to a crossing: the next may be a fifth as long
WANTED, UNDER_WAY = 1, 2  # the states of a landing: from the point before the crossing a step is to be taken, or is being taken
SHORTEST_SPAN = 100  # times the smallest step: shorter ones are not distinguished
VARIES_FAST, UNDEFINED = 1.0, 2.0  # faults of intervals: a condition is not resolved, or not a number
FORCE_STEP = 1e-7  # T: over which the rate of a contact force is its difference


@dataclass(frozen=True)
class Conditions:
    """Conditions g(t, q, v), and contact forces, that a run watches; equal where `key` and `rows` are.

    Attributes:
        key: texts of the programs.
        program: g and their rates, of t, q, v, a and numbers of their own.
        at_state: g, rates, second rates, and the derivatives of all g by t, by q and by v, of the same.
        number_count: of numbers of their own.
        by_velocity: mask of the conditions that depend on velocities; they have no second rates.
        rows: of Psi, whose multipliers, with the other sign, are watched behind the conditions.
    """

    key: Hashable
    program: ScalarProgram = field(compare=False)
    at_state: ScalarProgram = field(compare=False)
    number_count: int = field(compare=False)
    by_velocity: tuple[bool, ...] = field(compare=False)
    rows: tuple[int, ...] = ()

    # Numbers about the end of a run before its sides: the event, or -1; the time; the largest violation at a node.
    head: ClassVar[int] = 3

    @property
    def own_count(self) -> int:
        """The number of conditions that are programs."""
        return len(self.program.outputs) // 2

    @property
    def count(self) -> int:
        """The number of all that is watched."""
        return self.own_count + len(self.rows)

    def output_count(self, n: int) -> int:
        """Return the count of numbers that a run of n coordinates returns about its end."""
        return self.head + self.count + 2 * n
