"""The conditions that a run watches (watching.py): their programs and inputs, and their resolution in time."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

from udkjax.expressions import ScalarProgram
from udkjax.native.module.steps import ROUNDING_UNIT


class Resolution(NamedTuple):
    """The resolution of conditions in time; T is the shortest time in which anything changes, the inverse of the scene's rate.

    Attributes:
        per_time: number of intervals in T.
        resolved: largest error of the cubic, as a fraction of the change of a condition in an interval; an interval with a larger
            error is too coarse. A resolved oscillation has at least 7 intervals in a period, and no interval with two zeros; a
            smaller fraction needs more windows for the same events.
        miss: error in one interval, as a fraction of the error over two intervals. In fine intervals the fraction is 1/16, since
            the error grows with the fourth power of the length; four times as much is safe in coarser intervals. With rates by
            differences, the full error counts.
        far: distance from zero, in errors, beyond which a condition has no zero even in an interval that is too coarse: so
            large a change would be resolved.
        finer: factor by which an interval that is too coarse is refined.
        short: length of a window, in T, in which an unresolved condition has a jump or a kink, or varies throughout.
        finest: length of a window, in T, that is not refined further, so that changes within it are not resolved.
        late: largest error of the time of a located event, in T; the error of a Taylor step of this length, its square, is
            rounding.
    """

    per_time: int = 16
    resolved: float = 0.05
    miss: float = 1 / 4
    far: float = 1 / 0.05
    finer: int = 8
    short: float = 1e-6
    finest: float = 1e-9
    late: float = 1e-8

    def classify_interval(
        self, arithmetic: Any, ends: Sequence[Any], step: Any, error: Any, side: Any, floor: Any
    ) -> tuple[Any, Any]:
        """Classify an interval between two nodes: a condition certainly crosses zero in it once, certainly never, or neither.

        The condition is Hermite's cubic up to E x^2 (1 - x)^2, with 0 <= x <= 1. It crosses zero once if the Bernstein
        coefficients of degree 4 of the cubic, plus and minus this bound, change sign once (Descartes' rule), and never if they do
        not change sign. A condition that is far beyond zero in the whole interval has crossed zero once, at the first node. The
        same code serves lanes of machine code and arrays of JAX.

        Args:
            arithmetic: an object with functions `min` and `max` of two values, such as a `Function`.
            ends: value and rate at the first node, and at the second.
            step: length of the interval (s).
            error: E.
            side: the side of zero before the interval, 1 or -1.
            floor: distance from zero below which a condition counts as zero.

        Returns:
            The mask of intervals with certainly one crossing, and the mask of those with certainly none.
        """
        a, b = ends[0] * side, ends[2] * side
        inner_start, inner_end = a + ends[1] * side * step * (1 / 3), b - ends[3] * side * step * (1 / 3)
        # 16 x^2 (1 - x)^2 is 8/3 of the middle Bernstein polynomial.
        second, fourth, middle, e = (
            (a + inner_start * 3.0) * 0.25,
            (inner_end * 3.0 + b) * 0.25,
            (inner_start + inner_end) * 0.5,
            error * (8 / 3),
        )
        low = arithmetic.min(arithmetic.min(a, b), arithmetic.min(second, fourth))
        high = arithmetic.max(arithmetic.max(a, b), arithmetic.max(second, fourth))
        low, high = arithmetic.min(low, middle - e), arithmetic.max(high, middle + e)
        is_resolved = error <= (high - low) * self.resolved
        # An error below the distance that counts as zero hides no crossing.
        is_away = (low >= -floor) & (is_resolved | (error <= floor) | (low >= error * self.far - floor))

        def changes_once(x: Any) -> Any:
            signs = [second > 0.0, x > 0.0, fourth > 0.0, b > 0.0]  # the coefficient before them counts as positive
            result = ~signs[-1]
            for now, later in pairwise(signs):
                result = result & (now | ~later)
            return result

        # A force that jumps at the first node is beyond zero throughout. If it is then constant, its error is rounding, which
        # exceeds its changes.
        is_beyond = high <= -(error * self.far)
        return (changes_once(middle - e) & changes_once(middle + e) & is_resolved) | is_beyond, is_away


RESOLUTION = Resolution()
SHORT_PAIR = RESOLUTION.short / 16  # length in T of two of the 32 intervals of such a window
FINEST_WINDOW = 1e-9  # length of a window, in T, in which changes are no longer resolved
MOST_JUMPS = 3  # maximum number of jumps before intervals regain their length; more are an oscillation
# Position of the middle node in two intervals; largest reduction of their length, as a fraction; and the increment of its phase,
# the golden ratio, so that no oscillation is zero at all nodes.
MIDDLE_NODE, LARGEST_REDUCTION, PHASE_INCREMENT = 0.47, 0.2, 0.618
MOST_STUCK = 4  # maximum number of successive refinements; before a jump, some finer intervals are resolved
FIRST, SECOND, THIRD = range(3)  # the next node of two intervals
LAST_CHANGE = RESOLUTION.late  # largest final correction of the event time, in T
MOST_AIMS = 12  # maximum number of Newton's steps to a crossing on the polynomial, before bisection goes on
MOST_LANDINGS = 5  # maximum number of steps that end at a crossing; usually one
LEAST_STEP = 10  # shortest step to a crossing, in smallest steps, as the next may be a fifth as long
WANTED, UNDER_WAY = 1, 2  # states of a landing: a step from the point before the crossing is requested, or has been planned
# Longest time, in smallest steps, from the last state before a breakpoint to the first one after it.
ACROSS_BREAK = 8 * ROUNDING_UNIT
SHORTEST_SPAN = 100  # shortest span, in smallest steps, that is refined
VARIES_FAST, UNDEFINED = 1.0, 2.0  # faults of intervals: a condition is unresolved, or NaN
FORCE_STEP = 1e-7  # time difference, in T, for the rate of a force


@dataclass(frozen=True)
class Conditions:
    """The conditions g(t, q, v) and the forces of constraints that a run watches; they are equal if their texts are equal.

    Attributes:
        key: texts of the programs.
        program: g and their rates, from t, q, v, a and the numbers of the conditions.
        at_state: g, rates, second rates, and the derivatives of all g with respect to t, q and v, from the same inputs.
        number_count: number of numbers of the conditions.
        by_velocity: mask of the conditions that depend on velocities; they have no second rates.
        forces: functions of the multipliers of all rows of Psi, watched after the conditions: the forces of contacts, and how far
            the forces of sticking joints are from their limits; from the numbers of the conditions and lambda. None: no forces.
        force_key: text of that program.
    """

    key: Hashable
    program: ScalarProgram = field(compare=False)
    at_state: ScalarProgram = field(compare=False)
    number_count: int  # compared: a program may use none of the numbers, and the room for them is part of the code
    by_velocity: tuple[bool, ...]
    forces: ScalarProgram | None = field(compare=False, default=None)
    force_key: Hashable = ""

    # Number of values of the end of a run before the sides: the event, or -1; the time; the largest violation at a node.
    head: ClassVar[int] = 3

    @property
    def own_count(self) -> int:
        """The number of conditions g, without the watched forces."""
        return len(self.program.outputs) // 2

    @property
    def force_count(self) -> int:
        """The number of watched forces."""
        return 0 if self.forces is None else len(self.forces.outputs)

    @property
    def count(self) -> int:
        """The number of conditions g and watched forces; the forces come last."""
        return self.own_count + self.force_count

    def output_count(self, n: int) -> int:
        """Return the length of the output "crossing" of a run with n coordinates: `head`, the sides, q and v at its end."""
        return self.head + self.count + 2 * n
