"""The run of the members of a module: `run` for the threads of a processor, `run_member` for a thread of a GPU."""

from abc import abstractmethod
from collections.abc import Callable

from udkjax.native.code import interrupts
from udkjax.native.language.ir import BOOL, DOUBLE, INT, POINTER, Function, Value
from udkjax.native.language.loops import LoopWriter
from udkjax.native.language.text import ALLOCATION_DECLARATIONS, text_of_module
from udkjax.native.module.layout import Lane
from udkjax.native.module.memory import Memory, ThreadCode
from udkjax.native.module.parts import StiffnessPart

Repeat = Callable[[Callable[[], Value], Callable[[], None]], None]  # repeats a step while a condition holds: (goes_on, step)


class Running(Memory):
    """A module that runs members in lanes.

    The function `begin(work, call, lane, member)` loads a member into a lane; the code of `step_all` takes the members in all
    lanes a step further, and finishes those that are complete.
    """

    ways: tuple[str, ...] = ()  # prefixes of the inputs of each tangent of a group, in forward mode
    group = 1  # directions of a tangent
    tangents_begin: int | None = None
    """Where the memory of directions begins, relative to `work`; None if it is a block of its own."""

    functions: list[Function]
    stiffness: StiffnessPart
    loops: LoopWriter
    is_interruptible = True
    """True if Ctrl-C ends runs: on a page, which has no signals, it cannot."""

    def text(self) -> str:
        """Write all functions; return LLVM's text of the whole module."""
        self.write_functions()
        self._write_run()
        pointers = [*self.stiffness.pointers, *([interrupts.POINTER_GLOBAL] if self._has_signals else [])]
        text = text_of_module([*self.functions, *self.loops.functions], [*self.loops.globals, *pointers], ALLOCATION_DECLARATIONS)
        return self.stiffness.mark(text)

    def thread_code(self) -> ThreadCode:
        self.write_functions()
        self._write_run_member()
        programs, kernels = self.loops.parts
        return ThreadCode([*self.functions, *programs], kernels, self.loops.globals, self._memory_size)

    @abstractmethod
    def write_functions(self):
        """Write all functions except `run` and `run_member`."""

    def present(self, f: Function, s: Lane) -> Value:
        """Return the mask of the lanes that have a member."""
        return s.active > 0.5

    @abstractmethod
    def step_all(self, f: Function, s: Lane, fill: Callable[[], None]):
        """Take one step in all lanes, and finish completed members; the code of `fill()` loads the next ones into empty lanes."""

    def member_of(self, f: Function, thread: Value) -> Value:
        """Return the index of the member that a thread of a GPU runs, from the number of the thread."""
        return thread

    def write_member(self, f: Function, s: Lane, repeat: Repeat):
        """Take the member of a thread of a GPU through all its steps, by loops that `repeat(goes_on, step)` writes."""
        repeat(lambda: f.any_of(self.present(f, s)), lambda: self.step_all(f, s, lambda: None))

    def take_next(self, f: Function, s: Lane, fill: Callable[[], None]):
        """Load the next members into the lanes of completed ones, by the code of `fill()`."""
        fill()

    def release(self, f: Function, s: Lane):
        """Hook: write code that frees memory of the members in lanes when they leave the module."""

    def begin_memory(self, f: Function):
        """Store the numbers that all members share, once per call, in memory that has been cleared."""
        for begin in self.begins:
            begin(f)

    @property
    def _has_signals(self) -> bool:
        return self.is_interruptible and self.plan.steps

    @property
    def _memory_size(self) -> int:
        """The number of float64 numbers in the memory of a run."""
        return self.places.size * self.plan.width + 2 * self.plan.vector

    def _clear_memory(self, f: Function):
        """Clear the memory at `work`; store the numbers that all members share, and harmless ones for lanes that stay empty."""
        work, width = f.given["work"], self.plan.width
        s = Lane(f, self.places)
        start, end = (place * width for place in self.unused)
        for first, count in ((0, start), (end, self._memory_size - end)):
            with f.each(count) as i:
                f.store(0.0, work, i + first)
        f.store(f.given["call"], work, self.start("call", "work"), base=POINTER)
        self.begin_memory(f)
        for name in ("length", "omega", "rtol", "atol", "smallest"):
            setattr(s, name, f.const(1.0, DOUBLE, width))
        with f.each(-(-self.n // max(self.plan.vector // width, 1)) * max(self.plan.vector // width, 1)) as i:
            for name in ("atol q", "atol v"):
                self.put_entry(f, name, i, 1.0)

    def _write_run(self):
        """Write `run(call)`: run all members. In a later module, write `resume(call, members)` and a `run` that calls it."""
        width, (name, arguments) = self.plan.width, self.stiffness.entry
        f = Function(name, [(POINTER, x) for x in arguments], width)
        self.functions.append(f)
        call = f.given["call"]
        self.stiffness.begin_run(f)
        block, work = self.allocate(f, f.const(self._memory_size, INT))
        f.given["work"], s = work, Lane(f, self.places)
        self._clear_memory(f)
        blocks = [block, *self.allocate_tangents(f, block)]
        members, following = self.field(f, "members"), self.field(f, "next", POINTER)

        def take() -> Value:
            # Threads share the index of the next member.
            return f.op(f"atomicrmw add ptr {following.name}, i64 1 seq_cst", INT)

        def begin(k: Value, member: Value):
            with f.if_(member < members):
                f.call("begin", work, call, k, member)

        def fill():
            with f.each(width) as k, f.if_(f.lane(s.active, k) < 0.5):
                begin(k, take())

        self.stiffness.begin_members(f, take, begin, fill)
        interruption = interrupts.Interruption(f) if self._has_signals else None

        def present() -> Value:
            return self.present(f, s)

        with f.while_(lambda: self.stiffness.stays(f, s, f.any_of(present()), present)):
            if interruption:
                with f.if_(interruption.has_come()):
                    s.max_steps = f.const(-1.0, DOUBLE, width)
            self.step_all(f, s, fill)

        def free():
            for block in blocks:
                f.line(f"call void @free(ptr {block.name})")

        self.stiffness.end_run(f, s, free)
        self.functions += self.stiffness.write_entries()

    def _write_run_member(self):
        """Write `run_member(call, work, thread)`: run the member of a thread in the memory at `work`.

        A thread of a GPU calls it, together with the other threads of its block: `meet(goes_on)` waits for them before each
        step, and returns whether one of them goes on, so that all run the same instructions at the same time.
        """
        f = Function("run_member", [(POINTER, "call"), (POINTER, "work"), (INT, "thread")], self.plan.width)
        self.functions.append(f)
        call, work, s = f.given["call"], f.given["work"], Lane(f, self.places)
        member = self.member_of(f, f.given["thread"])
        self._clear_memory(f)
        with f.if_(member < self.field(f, "members")):
            f.call("begin", work, call, f.const(0, INT), member)

        def together(goes_on: Callable[[], Value], step: Callable[[], None]):
            with f.while_(lambda: f.op(f"call i1 @meet(i1 {goes_on().name})", BOOL)), f.if_(goes_on()):
                step()

        self.write_member(f, s, together)

    # --- memory of directions

    def groups(self, f: Function) -> Value:
        """Return the number of groups into which the directions of the call are divided."""
        return f.arithmetic("div", self.field(f, "directions") + (self.group - 1), self.group)

    def first_tangent(self, f: Function) -> Value:
        """Return the address of the memory of the first direction."""
        work = f.given["work"]
        if self.tangents_begin is not None:
            return f.at(work, self.tangents_begin)
        return f.load(work, self.start("tangents", "work"), base=POINTER)

    def allocate_tangents(self, f: Function, block: Value) -> list[Value]:
        """Allocate memory for all directions, and store its address in `work`; return the blocks to free.

        Without memory, `block` is freed, and the function returns (`allocate`)."""
        if not self.ways:
            return []
        size = self.groups(f) * (len(self.ways) * self.tangents.size * self.tangents.width)
        tangent_block, start = self.allocate(f, size, [block])
        with f.each(size) as i:
            f.store(0.0, start, i)
        f.store(start, f.given["work"], self.start("tangents", "work"), base=POINTER)
        return [tangent_block]
