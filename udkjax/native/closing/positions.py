"""Machine code of the positions of batches of mechanisms (equations/programs/position_programs.py), W members at a time.

The constants are computed once for each member. Then q is predicted, closed by Newton's method, and measured, at one position
after another. A march follows positions from the drawn position on; otherwise each position starts from a given guess.
"""

import ctypes
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from udkjax.equations.programs.position_programs import PositionPrograms
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.native.code import machine, processor
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value, Variable
from udkjax.native.language.program import consecutive, write
from udkjax.native.language.text import ALLOCATION_DECLARATIONS, text_of_module
from udkjax.threads import thread_count

# A Newton step shorter than this, in units of the coordinates, is the last: the next would be of the order of its square.
LAST_STEP = 1e-7
LONGEST_CORRECTION = 0.5  # largest Newton step, in units of the coordinates; longer steps lead to another position
LONGEST_OF_MARCH = 0.1  # largest Newton step in a march; otherwise the step of the march is shortened
SHORTEST_STEP = 2.0**-15  # shortest step of a march, relative to the longest; a member that fails even so has reached its end
MOST_CORRECTIONS = 12
LARGEST_EXTRAPOLATION = 4.0  # largest extrapolation by the cubic through two positions, relative to the previous step
MOST_SUBSTEPS = 1000  # maximum number between two positions; more indicate a wrong unit of the values
POINTER_FIELDS = ("x", "s", "guess", "data", "unit", "q", "out", "end", "next")
CALL_FIELDS = ("members", "count", "marches", "s stride", "data stride", *POINTER_FIELDS, "longest")


class Positions(NamedTuple):
    """Positions of M members at J values each.

    Attributes:
        q: coordinates (M, J, n).
        out: the outputs of the programs (M, J, K).
        end: the last Newton step (M, J), in units of the coordinates; NaN where a position was not reached.
    """

    q: np.ndarray
    out: np.ndarray
    end: np.ndarray


class PositionCode:
    """The compiled machine code of position programs; a call computes a batch of positions."""

    def __init__(self, programs: PositionPrograms):
        self.programs, self.width = programs, processor.lanes()
        self._library = machine.library(_Text(programs, self.width).text(), ("run",))
        self._run = machine.function(self._library["run"], ctypes.c_void_p)

    def __call__(
        self,
        x: np.ndarray,
        s: np.ndarray,
        unit: np.ndarray,
        data: np.ndarray | None = None,
        guess: np.ndarray | None = None,
        longest: float = np.inf,
        threads: int | None = None,
    ) -> Positions:
        """Close the positions of a batch, and evaluate the outputs of the programs there.

        Args:
            x: Free numbers of each member (M, P).
            s: Values of the driver, for all members (J,) or for each (M, J).
            unit: Units of the coordinates (n,), in which corrections are measured.
            data: Data of the positions, for all members (J, D) or for each (M, J, D).
            guess: Initial guesses (M, J, n); None: a march from the drawn position.
            longest: Longest step of s in a march.
            threads: Number of threads that share the members; by default one for each core, or `UDKJAX_THREADS`.

        Returns:
            The positions; NaN where a position was not reached.
        """
        members, count, sizes = len(x), s.shape[-1], self.programs.sizes
        data = np.zeros((count, sizes.data)) if data is None else data
        inputs = {"x": x, "s": s, "data": data, "unit": unit, "guess": np.zeros(1) if guess is None else guess}
        arrays = {name: np.ascontiguousarray(a, np.float64) for name, a in inputs.items()}
        arrays |= {
            "q": np.empty((members, count, sizes.coordinates)),
            "out": np.empty((members, count, self.programs.output_count)),
            "end": np.empty((members, count)),
            "next": np.zeros(2, np.int64),  # the index of the next member, and whether memory was refused
        }
        fields = {name: a.ctypes.data for name, a in arrays.items()}
        fields |= {"members": members, "count": count, "marches": guess is None, "longest": np.float64(longest).view(np.int64)}
        fields |= {"s stride": count if s.ndim > 1 else 0, "data stride": count * sizes.data if data.ndim > 2 else 0}
        call = (ctypes.c_int64 * len(CALL_FIELDS))(*(int(fields[name]) for name in CALL_FIELDS))
        threads = min(threads or thread_count(), -(-members // self.width)) if members else 0
        if threads == 1:
            self._run(ctypes.addressof(call))
        elif threads:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(lambda _: self._run(ctypes.addressof(call)), range(threads)))
        if arrays["next"][1]:
            raise MemoryError("no memory for a batch of positions")
        return Positions(arrays["q"], arrays["out"], arrays["end"])


class _Text:
    """The writer of LLVM's text of the code."""

    def __init__(self, programs: PositionPrograms, width: int):
        self.programs, self.width = programs, width
        n, self.places, self.size = programs.sizes.coordinates, {}, 0
        arrays = {"constants": programs.constant_count, "q0": n, "s0": 1, "x": programs.sizes.parameters, "s": 1, "q": n}
        arrays |= {"new": n, "rate": n, "sign": 1, "violation": 1, "d": programs.sizes.data, "out": programs.output_count}
        arrays |= {"q before": n, "rate before": n, "target": 1, "unit": n, "end": 1}
        for name, count in arrays.items():
            self.places[name] = self.size
            self.size += count

    def text(self) -> str:
        p, programs = self.places, self.programs
        sizes = programs.sizes

        def places(name: str, count: int) -> list[tuple[str, int]]:
            return [(pointer, p[name] + k) for pointer, k in consecutive("work", count)]

        state = [*places("constants", programs.constant_count), ("work", p["s"]), *places("q", sizes.coordinates)]
        functions = [
            write(programs.prologue, "prologue", self.width, ["work"], places("x", sizes.parameters),
                  places("constants", programs.constant_count + sizes.coordinates + 1)),
            write(programs.newton, "newton", self.width, ["work"], state, places("new", 2 * sizes.coordinates + 2)),
            write(programs.measure, "measure", self.width, ["work"], [*state, *places("d", sizes.data)],
                  places("out", programs.output_count)),
            self._close(),
            self._run(),
        ]  # fmt: skip
        for f in functions[:3]:
            f.noinline = True
        return text_of_module(functions, declared=ALLOCATION_DECLARATIONS)

    # --- memory

    def _load(self, f: Function, name: str, i: Value | int = 0) -> Value:
        return f.load(f.given["work"], (f.like(i, INT, 1) + self.places[name]) * self.width, self.width)

    def _put(self, f: Function, name: str, x: Value, i: Value | int = 0):
        f.store(x, f.given["work"], (f.like(i, INT, 1) + self.places[name]) * self.width, self.width)

    def _field(self, f: Function, name: str, base: str = INT) -> Value:
        return f.load(f.given["call"], CALL_FIELDS.index(name), base=base)

    def _gather(self, f: Function, addresses: Sequence[Value], name: str, count: int):
        """Load `count` numbers for each lane, from the address of that lane, into the array `name`."""
        with f.each(count) as i:
            for k, address in enumerate(addresses):
                f.store(f.load(address, i), f.given["work"], (i + self.places[name]) * self.width + k)

    def _scatter(self, f: Function, name: str, count: int, addresses: Sequence[Value]):
        end = self._load(f, "end")
        reached = end.is_(end)
        with f.each(count) as i:
            x = f.select(reached, self._load(f, name, i), np.nan)
            for k, address in enumerate(addresses):
                f.store(f.lane(x, f.const(k, INT)), address, i)

    # --- functions

    def _close(self) -> Function:
        """Write `close(work, most)`: compute q at s by Newton's method, with steps shorter than `most`.

        `end` becomes the length of the last Newton step, or NaN if the method fails.
        """
        arguments = [(POINTER, "work"), (DOUBLE, "most")]
        f, n = Function("close", arguments, self.width), self.programs.sizes.coordinates
        most = f.given["most"]
        continues = f.variable(f.select(self._load(f, "end").is_(self._load(f, "end")), f.const(1.0, DOUBLE, self.width), 0.0))
        rounds = f.variable(0, INT, 1)
        with f.while_(lambda: f.any_of(continues.value > 0.5) & (rounds.value < MOST_CORRECTIONS)):
            f.call("newton", f.given["work"])
            size = f.variable(0.0)
            with f.each(n) as i:
                step = f.abs(self._load(f, "new", i) - self._load(f, "q", i)) / self._load(f, "unit", i)
                size.value = f.select(step <= size.value, size.value, step)  # NaN stays
            succeeds = (continues.value > 0.5) & (size.value < f.repeat(most, self.width))
            with f.each(n) as i:
                self._put(f, "q", f.select(succeeds, self._load(f, "new", i), self._load(f, "q", i)), i)
            last = f.select(continues.value > 0.5, f.select(succeeds, size.value, np.nan), self._load(f, "end"))
            self._put(f, "end", last)
            is_open = (size.value >= LAST_STEP) | (self._load(f, "violation") > CLOSURE.tol**2)
            continues.value = f.select(succeeds & is_open, f.const(1.0, DOUBLE, self.width), 0.0)
            rounds.value = rounds.value + 1
        self._put(f, "end", f.select(continues.value > 0.5, np.nan, self._load(f, "end")))
        return f

    def _run(self) -> Function:
        f = Function("run", [(POINTER, "call")], self.width)
        n, width = self.programs.sizes.coordinates, self.width
        block = f.op(f"call ptr @malloc(i64 {(self.size * width + width) * 8 + 64})", POINTER)
        with f.if_(f.is_null(block)):
            f.store(1, self._field(f, "next", POINTER), 1, base=INT)
            f.leave()
        number = f.op(f"ptrtoint ptr {block.name} to i64", INT)
        f.given["work"] = f.op(f"inttoptr i64 {f.logic('and', number + 63, -64).name} to ptr", POINTER)
        with f.each(self.size) as i:
            f.store(f.const(0.0, DOUBLE, width), f.given["work"], i * width, width)
        with f.each(n) as i:
            self._put(f, "unit", f.repeat(f.load(self._field(f, "unit", POINTER), i), width), i)
        members = self._field(f, "members")
        with self._groups(f, members) as first:
            lanes = [f.select(first + k < members, first + k, members - 1) for k in range(width)]
            self._run_group(f, lanes)
        f.line(f"call void @free(ptr {block.name})")
        return f

    @contextmanager
    def _groups(self, f: Function, members: Value) -> Iterator[Value]:
        """Run the block for each group of members, with the index of its first member; threads take groups in turn."""
        next_member = self._field(f, "next", POINTER)
        first = f.variable(0, INT, 1)

        def take() -> Value:
            first.value = f.op(f"atomicrmw add ptr {next_member.name}, i64 {self.width} seq_cst", INT)
            return first.value < members

        with f.while_(take):
            yield first.value

    def _run_group(self, f: Function, lanes: Sequence[Value]):
        p, n, width, work = self.programs, self.programs.sizes.coordinates, self.width, f.given["work"]
        count, marches = self._field(f, "count"), self._field(f, "marches").is_not(0)

        def addresses(name: str, stride: Value | int, size: int, j: Value | int = 0) -> list[Value]:
            pointer = self._field(f, name, POINTER)
            return [f.at(pointer, lane * stride + j * f.like(size, INT, 1) if size else f.const(0, INT)) for lane in lanes]

        self._gather(f, addresses("x", p.sizes.parameters, 1), "x", p.sizes.parameters)
        f.call("prologue", work)
        self._put(f, "end", f.const(0.0, DOUBLE, width))
        before, sign = f.variable(0.0), f.variable(0.0)
        longest = f.variable(self._field(f, "longest", DOUBLE), width=1)
        with f.if_(marches):
            self._put(f, "s", self._load(f, "s0"))
            with f.each(n) as i:
                self._put(f, "q", self._load(f, "q0", i), i)
            f.call("close", work, f.const(LONGEST_CORRECTION))
            sign.value = self._load(f, "sign")
        with f.each(count) as j:
            self._gather(f, addresses("s", self._field(f, "s stride"), 1, j), "target", 1)
            self._gather(f, addresses("data", self._field(f, "data stride"), p.sizes.data, j), "d", p.sizes.data)
            f.choose(
                marches,
                lambda: self._march(f, before, sign, longest),
                lambda: self._close_guess(f, addresses("guess", count * n, n, j)),
            )
            f.call("measure", work)
            for name, size in (("q", n), ("out", p.output_count), ("end", 1)):
                self._scatter(f, name, size, addresses(name, count * size, size, j))

    def _close_guess(self, f: Function, guesses: Sequence[Value]):
        self._gather(f, guesses, "q", self.programs.sizes.coordinates)
        self._put(f, "s", self._load(f, "target"))
        self._put(f, "end", f.const(0.0, DOUBLE, self.width))
        f.call("close", f.given["work"], f.const(LONGEST_CORRECTION))

    def _march(self, f: Function, before: Variable, sign: Variable, longest: Variable):
        """Continue to the value `target`, in steps that are halved if a lane fails, and doubled if none does.

        The variables keep the previous step (`before`), the sign of the determinant at the drawn position, and the longest step.
        """
        n, goes_on = self.programs.sizes.coordinates, f.variable(1.0, width=1)
        limit = self._field(f, "longest", DOUBLE)

        def restore(alive: Value, step: Value, size: Value):
            for name in ("q", "rate"):
                with f.each(n) as i:
                    self._put(f, name, self._load(f, f"{name} before", i), i)
            self._put(f, "s", self._load(f, "s") - step)
            self._put(f, "end", alive)
            before.value = 0.0
            longest.value = size * 0.5

        def accept(step: Value, steps: Value):
            before.value = step
            longest.value = f.min(longest.value * 2.0, limit)
            goes_on.value = f.select((steps > 1.5) & (rounds.value < MOST_SUBSTEPS), f.const(1.0), 0.0)

        rounds = f.variable(0, INT, 1)
        with f.while_(lambda: goes_on.value > 0.5):
            rounds.value = rounds.value + 1
            alive = self._load(f, "end")
            rest = f.select(alive >= 0.0, self._load(f, "target") - self._load(f, "s"), 0.0)
            farthest = f.reduce("fmax", f.abs(rest))
            steps = f.max(f.intrinsic("ceil", farthest / longest.value), f.const(1.0))
            step = rest / f.repeat(steps, self.width)
            self._predict(f, step, before.value)
            self._put(f, "s", self._load(f, "s") + step)
            f.call("close", f.given["work"], f.const(LONGEST_OF_MARCH))
            end = self._load(f, "end")
            lost = (self._load(f, "sign") * sign.value <= 0.0) | end.is_not(end)
            self._put(f, "end", f.select(lost, np.nan, end))
            size = farthest / steps
            repeats = f.any_of(lost & (alive >= 0.0)) & (size > limit * SHORTEST_STEP) & (rounds.value < MOST_SUBSTEPS)
            f.choose(
                repeats,
                lambda alive=alive, step=step, size=size: restore(alive, step, size),
                lambda step=step, steps=steps: accept(step, steps),
            )
        arrived = f.abs(self._load(f, "s") - self._load(f, "target")) <= LAST_STEP * limit
        self._put(f, "end", f.select(arrived, self._load(f, "end"), np.nan))
        self._put(f, "s", self._load(f, "target"))

    def _predict(self, f: Function, step: Value, before: Value):
        """Predict q after a step of s by the cubic through the last two positions and their rates, or by the last rate alone.

        `before`: the previous step of s; zero if there is none.
        """
        has_previous = (f.abs(before) > 0.0) & (f.abs(before) * LARGEST_EXTRAPOLATION >= f.abs(step))
        u = f.select(has_previous, step / f.select(has_previous, before, 1.0), 0.0) + 1.0
        u2, u3 = u * u, u * u * u
        old, old_rate = u3 * 2.0 - u2 * 3.0 + 1.0, (u3 - u2 * 2.0 + u) * before
        now, now_rate = u2 * 3.0 - u3 * 2.0, (u3 - u2) * before
        first = f.select(has_previous, 0.0, step)
        with f.each(self.programs.sizes.coordinates) as i:
            q, rate = self._load(f, "q", i), self._load(f, "rate", i)
            old_part = old * self._load(f, "q before", i) + old_rate * self._load(f, "rate before", i)
            old_part = f.fma(now, q, f.fma(now_rate + first, rate, old_part))
            self._put(f, "q before", q, i)
            self._put(f, "rate before", rate, i)
            self._put(f, "q", f.select(has_previous, old_part, f.fma(step, rate, q)), i)
