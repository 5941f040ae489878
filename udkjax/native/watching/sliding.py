"""Joints with set-valued friction that stop, stick or slip while a run goes on.

The mode of a joint is to slide in a direction or to stick. The modes follow by the pivots of complementarity/stick_or_slip.py:
the equations of motion are solved in given modes; then a joint that sticks with a force beyond its limit changes to sliding, and
one that accelerates against its direction of sliding sticks again.
Where joints stop together, as in a linkage with one degree of freedom that swings back, where a lock would depend on other rows,
and in the mechanism of the scene, which lacks the locks, joints that stop can only all turn round, or go on as they slid.

All other decisions are left to the loop of events in Python: where joints stick that stopped together or depend on each other,
where both directions obey the law of friction, and where pivots do not end.
"""

from collections.abc import Callable

from udkjax.native.language.ir import BOOL, DOUBLE, INT, POINTER, Function, Value
from udkjax.native.language.program import write
from udkjax.native.module.layout import Lane
from udkjax.native.watching.conditions import LAST_CHANGE
from udkjax.native.watching.passed_events import Sliding
from udkjax.native.watching.passing import PassingRuns


def write_slide(module: PassingRuns, slides: Sliding, zero: float):
    """Write `pass_slides(work, call)`: begin anew the runs that have ended where a joint stops or slips."""
    _write_locks(module, slides)
    f, s = module.function("pass_slides", [(POINTER, "work"), (POINTER, "call")])
    first_force = module.conditions.own_count + slides.first_force
    stops = module.may_pass(f, s) & _is_among(s.event, slides.first, slides.count)
    leaves = module.may_pass(f, s) & _is_among(s.event, first_force, slides.count if slides.locks else 0)
    with f.if_(f.any_of(stops | leaves)):
        event = s.event - f.select(leaves, f.const(float(first_force), DOUBLE, f.width), float(slides.first))
        joint = f.intrinsic("floor", event * 0.5)
        sign = 1.0 - (event - joint * 2.0) * 2.0
        (_Choice if slides.locks else _ChoiceWithoutLocks)(module, slides, zero, f, s, joint).pass_events(stops, leaves, sign)


def _is_among(event: Value, first: int, count: int) -> Value:
    return (event >= float(first)) & (event < float(first + 2 * count))


def _write_locks(module: PassingRuns, slides: Sliding):
    """Write `lock<j>(work)` for each joint j: compute those numbers of its lock that depend on q, at `state q`.

    They are stored in the array `new locks`.
    """
    p, constants, place = module.places, 0, 2 * len(slides.locks)
    for j, lock in enumerate(slides.locks):
        count = lock.constants(module.n)
        inputs = [("work", p["state q"] + i) for i in range(module.n)]
        inputs += [("work", p["lock constants"] + constants + i) for i in range(count)]
        outputs = [("work", p["new locks"] + place + i) for i in range(len(lock.program.outputs))]
        written = write(lock.program, f"lock{j}", module.plan.width, ("work",), inputs, outputs, cold=True)
        module.functions.append(written)
        constants, place = constants + count, place + len(lock.program.outputs)


class _Modes:
    """The code that chooses the modes of the joints at an event, and begins runs anew in these."""

    def __init__(self, module: PassingRuns, slides: Sliding, least: float, f: Function, s: Lane, joint: Value):
        self._module, self._slides, self._least, self._f, self._s, self._joint = module, slides, least, f, s, joint
        self._zero, self._one = (f.const(x, DOUBLE, f.width) for x in (0.0, 1.0))

    def pass_events(self, stops: Value, leaves: Value, sign: Value):
        """Handle the events of lanes in which the decision about the modes is clear; restore the others, for Python to handle.

        `stops`: the lanes in which the joint of the event stops; `leaves`: those in which it leaves its lock, in the direction
        `sign`.
        """
        f, s, module = self._f, self._s, self._module
        self._look("sure v")
        # The forces of joints are compared with their limits below; only those of contacts are among the other conditions.
        forces = module.conditions.force_count - (2 * self._slides.count if self._slides.locks else 0)
        conditions = "conditions" if forces else "own_conditions"
        module.look_at_event(f, s, conditions=conditions)
        asked = (stops | leaves) & ~self._is_beside_others(leaves)
        for name in ("sides", "locks"):
            self._copy_numbers(name, f"kept {name}", asked)
        found = self._choose(stops & asked, leaves & asked, sign)
        self._look("after v")
        module.look_at_event(f, s, "after v", conditions)
        passes = found & ~self._others_are_beyond()
        fails = asked & ~passes
        with f.if_(f.any_of(fails)):
            for name in ("sides", "locks"):
                self._copy_numbers(f"kept {name}", name, fails)
            self._enter(fails)
        self._watch(passes)
        module.begin_anew(f, s, passes)

    def _choose(self, stops: Value, leaves: Value, sign: Value) -> Value:
        """Hook: choose the modes and `after v`; return the lanes in which they obey the law of friction.

        The arguments are those of `pass_events`.
        """
        raise NotImplementedError

    # --- numbers and conditions

    def _each_joint(self, do: Callable[[Value, Value], None]):
        """Run `do` for each joint j, with the mask of the lanes whose event is its own."""
        with self._f.each(self._slides.count) as j:
            do(j, self._joint.is_(self._f.like(j, DOUBLE, self._f.width)))

    def _entry(self, name: str, i: Value) -> Value:
        return self._module.entry(self._f, name, i)

    def _put(self, name: str, i: Value, new: Value, mask: Value):
        self._module.put_entry(self._f, name, i, self._f.select(mask, new, self._entry(name, i)))

    def _copy_numbers(self, source: str, to: str, mask: Value):
        with self._f.each(self._module.places_of(to.removeprefix("kept "))) as i:
            self._put(to, i, self._entry(source, i), mask)

    def _enter(self, mask: Value):
        """Compute the constants of the masked lanes from their numbers."""
        with self._module.each_lane(self._f, mask) as k:
            self._f.call("enter", self._f.given["work"], self._f.given["call"], k)

    def _is_of_joint(self, c: Value) -> Value:
        """Return a mask that is true in all lanes if condition c belongs to a joint that may stick, else in none."""
        f, slides = self._f, self._slides
        found = (c >= slides.first) & (c < slides.first + 2 * slides.count)
        if slides.locks:
            first = self._module.conditions.own_count + slides.first_force
            found = found | ((c >= first) & (c < first + 2 * slides.count))
        return f.like(found, BOOL, f.width)

    def _is_beside_others(self, leaves: Value) -> Value:
        """Mark the joints that stop, and return the lanes in which the run cannot pass the event.

        They are the lanes in which a condition of no joint is zero, too, or a joint is kept at rest by others; and those of the
        lanes `leaves`, where a joint leaves its lock, in which a joint stops as well.
        """
        f, s, module, slides = self._f, self._s, self._module, self._slides
        is_near = module.any_condition(f, lambda c, g, _, floor: ~(f.abs(g) > floor) & ~self._is_of_joint(c))
        found = f.variable(is_near, BOOL)
        wider = f.max(slides.closed / f.max(s.atol, self._least), self._one) / slides.slow
        all_ = f.const(True, BOOL, f.width)

        def look(j: Value, here: Value):
            c = j * 2 + slides.first
            is_slow = here | ~(f.abs(self._entry("condition g", c)) > module.floor_of(f, s, c) * wider)
            if slides.locks:
                is_slow = is_slow & (self._entry("locks", j) < 0.5)
            self._put("joints that stop", j, f.select(is_slow, self._one, self._zero), all_)
            found.value = found.value | (leaves & is_slow) | (self._entry("sides", j * 2 + 1) > 0.5)

        self._each_joint(look)
        return found.value

    def _others_are_beyond(self) -> Value:
        """Return the lanes in which a condition of no joint is not clearly on its side."""
        return self._module.any_condition(self._f, lambda c, g, side, floor: ~(g * side > floor) & ~self._is_of_joint(c))

    def _watch(self, mask: Value):
        """Let the lanes of `mask` watch the speeds of joints that slide, and the forces of those that stick."""
        slides, zero, one = self._slides, self._zero, self._one
        f = self._f

        def put(j: Value, _: Value):
            direction = self._entry("sides", j * 2)
            starts = [(slides.first, (direction > 0.5, direction < -0.5))]
            if slides.locks:
                sticks = self._entry("locks", j) > 0.5
                starts.append((self._module.conditions.own_count + slides.first_force, (sticks, sticks)))
            for start, masks in starts:
                for k, is_on in enumerate(masks):
                    c = j * 2 + (start + k)
                    self._put("condition on", c, f.select(is_on, one, zero), mask)
                    self._put("condition side", c, one, mask)

        self._each_joint(put)

    # --- the equations of motion

    def _look(self, v: str):
        """Compute the accelerations at the event with the velocities in the array `v`; conditions take them as `node a`."""
        f, s, module = self._f, self._s, self._module
        setattr(s, "state t", s.sure_t)
        module.copy(f, "sure q", "state q")
        module.copy(f, v, "state v")
        module.copy(f, v, "result v")
        module.accelerations.accelerate(f, "result a")
        module.copy(f, "result a", "node a")

    def _respond(self) -> tuple[Value, Value]:
        """Solve the equations of motion in the present modes.

        Returns:
            The lanes that have a solution, and the largest acceleration of a joint.
        """
        f, s, module, slides = self._f, self._s, self._module, self._slides
        self._look("sure v")
        f.call("own_conditions", f.given["work"])
        largest, total = f.variable(0.0), f.variable(0.0)
        with f.each(slides.count) as j:
            largest.value = f.max(f.abs(self._acceleration(j)), largest.value)
        with f.each(module.n) as i:  # NaN if the loads of joints have not settled
            total.value = f.fma(self._entry("result a", i), 0.0, total.value)
        is_known = total.value.is_(0.0)
        return module.fallback.if_safe(s, is_known), largest.value

    def _acceleration(self, j: Value) -> Value:
        return self._entry("condition rate", j * 2 + self._slides.first)

    def _find_forces(self):
        """Compute the distances of the forces of joints from their limits (array `forces`), if joints have locks."""
        if self._slides.locks:
            self._module.invoke(self._f, "multipliers_of_settled")
            self._f.call("own_forces", self._f.given["work"])

    def _slips(self, j: Value) -> tuple[Value, Value]:
        """Return the lanes in which joint j is locked with a force beyond a limit, and those where it is the forward limit."""
        f = self._f
        ahead, back = (self._entry("forces", j * 2 + (self._slides.first_force + k)) for k in range(2))
        least = f.max(f.abs(ahead), f.abs(back)) * -self._slides.still
        return (self._entry("locks", j) > 0.5) & ((ahead < least) | (back < least)), ahead < least

    # --- directions of sliding

    def _set_mode(self, j: Value, direction: Value, mask: Value):
        """Let joint j slide in a direction, or stick if this is zero, in the lanes of `mask`.

        The row of a lock that is on is marked as independent of all other rows.
        """
        f = self._f
        self._put("sides", j * 2, direction, mask)
        if self._slides.locks:
            sticks = f.select(direction.is_(0.0), self._one, self._zero)
            for k in range(2):
                self._put("locks", j + k * self._slides.count, sticks, mask)

    def _turn(self, mask: Value) -> Value:
        """Let all joints that stop turn round, or all go on as they slid.

        Returns:
            The lanes in which exactly one of these two choices obeys the law of friction.
        """
        f = self._f
        turns = self._try(-self._one, mask)
        goes_on = self._try(self._one, mask & ~turns)
        # Where both obey the law, neither is known to be right: the first is tried again after the second.
        also = self._try(self._one, mask & turns)
        found = (goes_on | (turns & ~also)) & mask
        self._slide(f.select(goes_on, self._one, -self._one), found)
        return found

    def _slide(self, direction: Value, mask: Value):
        """Let all joints that stop slide on (1) or back (-1) in the lanes of `mask`, and compute their constants."""

        def put(j: Value, _: Value):
            stops = self._entry("joints that stop", j) > 0.5
            self._set_mode(j, self._entry("kept sides", j * 2) * direction, mask & stops)

        self._each_joint(put)
        self._enter(mask)

    def _try(self, direction: Value, mask: Value) -> Value:
        """Return the lanes in which all joints that stop clearly slide on (1) or back (-1), and locked joints stay so."""
        f = self._f
        obeys = f.variable(f.const(False, BOOL, f.width), BOOL)
        with f.if_(f.any_of(mask)):
            self._slide(direction, mask)
            is_known, largest = self._respond()
            self._find_forces()
            obeys.value = mask & is_known

            def judge(j: Value, _: Value):
                stops, ahead = self._entry("joints that stop", j) > 0.5, self._acceleration(j) * self._entry("sides", j * 2)
                # A speed that is zero has an error, of which a stiff damper makes an acceleration.
                error = f.abs(self._entry("condition g", j * 2 + self._slides.first)) * self._s.omega / LAST_CHANGE
                wrong = stops & ~(ahead > f.max(largest * self._slides.still, error))
                if self._slides.locks:
                    wrong = wrong | self._slips(j)[0]
                obeys.value = obeys.value & ~wrong

            self._each_joint(judge)
        return obeys.value


class _ChoiceWithoutLocks(_Modes):
    """Modes of joints in a mechanism without locks: a joint that stops turns round, or goes on."""

    def _choose(self, stops, leaves, sign):
        found = self._turn(stops)
        self._module.copy(self._f, "sure v", "after v")
        return found


class _Choice(_Modes):
    """Modes of joints in a mechanism with locks: a joint that stops may also stick."""

    def _choose(self, stops, leaves, sign):
        f, module = self._f, self._module
        # Otherwise locks that depend on others would not show.
        can_stick = module.plan.projected and module.fallback.finds_dependent_rows
        alone = stops & ~self._several_stop() if can_stick else f.const(False, BOOL, f.width)
        found = self._pivot_modes(alone, leaves, sign)
        turns = f.variable(stops & ~found, BOOL)
        module.copy(f, "sure v", "after v")
        with f.if_(f.any_of(turns.value)):
            for name in ("sides", "locks"):
                self._copy_numbers(f"kept {name}", name, turns.value)
            turns.value = self._turn(turns.value)
        sticks = found & self._sticks_newly()
        with f.if_(f.any_of(sticks)):
            self._project(sticks)
        return found | turns.value

    def _several_stop(self) -> Value:
        count = self._f.variable(0.0)

        def add(j: Value, _: Value):
            count.value = count.value + self._entry("joints that stop", j)

        self._each_joint(add)
        return count.value > 1.5

    def _pivot_modes(self, stops: Value, leaves: Value, sign: Value) -> Value:
        """Choose the modes of joints by pivots; return the lanes in which the modes obey the law of friction."""
        f, slides = self._f, self._slides
        open_ = f.variable(stops | leaves, BOOL)
        found, step = f.variable(f.const(False, BOOL, f.width), BOOL), f.variable(0, INT, 1)
        self._find_locks(stops)

        def begin(j: Value, here: Value):
            rests = here | (self._entry("locks", j) > 0.5)
            self._put("joints at rest", j, f.select(rests, self._one, self._zero), stops | leaves)
            self._set_mode(j, f.select(stops, self._zero, sign), here & (stops | leaves))

        self._each_joint(begin)
        with f.while_(lambda: f.any_of(open_.value) & (step.value < slides.most_pivots)):
            asked = open_.value
            self._enter(asked)
            is_known, largest = self._respond()
            self._find_forces()
            violates = self._pivot(asked & is_known, largest, step.value)
            found.value = found.value | (asked & is_known & ~violates)
            open_.value = asked & is_known & violates
            step.value = step.value + 1
        return found.value

    def _pivot(self, mask: Value, largest: Value, step: Value) -> Value:
        """Change the modes of joints that violate the law of friction; return the lanes in which one of them violated it.

        `largest`: the largest acceleration of a joint; `step`: the number of pivots before. After too many of them, only the
        first such joint changes its mode.
        """
        f, slides = self._f, self._slides
        found = f.variable(f.const(False, BOOL, f.width), BOOL)
        single = f.like(step >= slides.block_steps * slides.count, BOOL, f.width)

        def change(j: Value, _: Value):
            (slips, forwards), direction = self._slips(j), self._entry("sides", j * 2)
            returns = (self._entry("locks", j) < 0.5) & (self._acceleration(j) * direction < largest * -slides.still)
            violates = mask & (self._entry("joints at rest", j) > 0.5) & (slips | returns)
            new = f.select(returns, self._zero, f.select(forwards, self._one, -self._one))
            self._set_mode(j, new, violates & ~(single & found.value))
            found.value = found.value | violates

        self._each_joint(change)
        return found.value

    def _find_locks(self, mask: Value):
        """Set the numbers of locks that depend on q, for the joint of the event, in the masked lanes."""
        f, module, place = self._f, self._module, 2 * self._slides.count
        module.copy(f, "sure q", "state q")
        for j, lock in enumerate(self._slides.locks):
            f.call(f"lock{j}", f.given["work"])
            here = mask & self._joint.is_(float(j))
            for i in range(place, place + len(lock.program.outputs)):
                module.put_entry(f, "locks", i, f.select(here, module.entry(f, "new locks", i), module.entry(f, "locks", i)))
            place += len(lock.program.outputs)

    def _sticks_newly(self) -> Value:
        """Return the lanes in which the joint of the event sticks."""
        found = self._f.variable(0.0)
        self._each_joint(lambda j, here: found.where(here, self._entry("locks", j)))
        return found.value > 0.5

    def _project(self, mask: Value):
        """Set `after v` to the velocities after projection onto the constraints, including the new locks, in lanes of `mask`."""
        f, s, module = self._f, self._s, self._module
        setattr(s, "state t", s.sure_t)
        module.copy(f, "sure q", "state q")
        module.copy(f, "sure v", "state v")
        s.due = f.select(mask, self._one, self._zero)
        module.projection.project_output(f, s, s.due > 0.5)
        module.copy(f, "result v", "after v", mask)
