"""The handler of a kernel: it writes the call record, and launches the kernel on XLA's stream.

The call record is a parameter of the kernel, so that nothing is allocated in a call, except in the second pass of reverse mode.
There threads record their steps in one buffer, as many as the longest run took in the first pass. Members run in chunks for which
the buffer has room. If a run takes more steps than in the first pass, because it was computed elsewhere and rounded otherwise,
all members run again with longer records.
"""

from udkjax.native.derivatives.record import FIRST_POINTS, Recorded
from udkjax.native.gpu.driver_calls import (
    CONTEXT_OF_STREAM,
    COPY_TO_DEVICE,
    COPY_TO_HOST,
    POP_CONTEXT,
    PUSH_CONTEXT,
    WAIT_FOR_STREAM,
    Words,
    stream_of,
)
from udkjax.native.gpu.kernel import KernelCode
from udkjax.native.host.ffi import (
    ALLOCATE,
    CONTEXT,
    DESTROY_ERROR,
    FREE,
    answer_metadata,
    arguments_struct,
    call_api,
    call_record,
    call_with,
    word,
)
from udkjax.native.language.ir import BOOL, DOUBLE, INT, POINTER, Function, Operand, Value

BLOCK_THREADS = 128  # threads of a block; of 64, 128 and 256 the fastest for the paper's linkage on an H100
LAUNCH, KERNEL = "cuLaunchKernel", "kernel"
LAUNCH_WORDS = Words((LAUNCH, COPY_TO_HOST, COPY_TO_DEVICE, WAIT_FOR_STREAM), (KERNEL,))
LAUNCH_FAILED = b"launching a kernel for a batch failed: "
# Bytes of the buffer of records. On an H100, 2**30 to 2**34 are equally fast: 262,144 gradients of the paper's linkage over 20 s.
MOST_RECORDS = 2**30
# Bytes before the records: the two words to which the field `next` of the call record points. They are also the alignment of the
# memory, the largest that XLA grants.
SHARED_BYTES = 16
DATA_OFFSET = 40  # offset in bytes of the address in the arguments of XLA's function that allocates memory


def launch_handler(code: KernelCode) -> Function:
    """Return the handler `launch(frame)` for a kernel."""
    f = Function("launch", [(POINTER, "frame")], returns="ptr", cold=True)
    answer_metadata(f, f.given["frame"])
    _Launch(f, code).write()
    f.line("ret ptr null")
    return f


class _Launch:
    """The writer of a handler's code after the answer to a request of metadata."""

    def __init__(self, f: Function, code: KernelCode):
        self.f, self.module, self.frame = f, code.module, f.given["frame"]
        self.call, self.members = call_record(f, self.frame, code.module)
        self.stream, self.context = stream_of(f, self.frame), Value(f, f.reserve(POINTER), POINTER)
        self.answer = f.variable(0, INT, 1)  # of the driver; what follows an error is left out

    def write(self):
        f, has_records = self.f, isinstance(self.module, Recorded)
        self._put("next", f.const(0, INT))
        self._drive(CONTEXT_OF_STREAM, self.stream, self.context)
        with f.if_((self.members > 0) & self._is_well):
            self._drive(PUSH_CONTEXT, f.load(self.context, base=POINTER))
            with f.if_(self._is_well):
                if has_records:
                    self._put("first", f.const(0, INT))
                    f.choose(self._field("directions") > 0, self._run_in_chunks, lambda: self._run(self.members))
                else:
                    self._run(self.members)
                LAUNCH_WORDS.drive(f, POP_CONTEXT, self.context)
        with f.if_(~self._is_well):
            f.leave(f"ptr {LAUNCH_WORDS.error(f, self.frame, LAUNCH_FAILED, self.answer.value).name}")

    @property
    def _is_well(self) -> Value:
        return self.answer.value.is_(0)

    def _put(self, name: str, value: Value):
        self.f.store(value, self.call, self.module.call_fields.index(name), base=value.base)

    def _field(self, name: str, base: str = INT) -> Value:
        return self.f.load(self.call, self.module.call_fields.index(name), base=base)

    def _drive(self, name: str, *arguments: Value | str):
        with self.f.if_(self._is_well):
            self.answer.value = LAUNCH_WORDS.drive(self.f, name, *arguments)

    def _run(self, members: Value):
        """Launch the kernel, with one thread for each of a number of members."""
        f, parameters = self.f, Value(self.f, self.f.reserve(POINTER), POINTER)
        f.store(self.call, parameters, base=POINTER)
        blocks = f.arithmetic("div", members + (BLOCK_THREADS - 1), BLOCK_THREADS)
        grid = f.op(f"trunc i64 {blocks.name} to i32", "i32")
        sizes = f"i32 {grid.name}", "i32 1", "i32 1", f"i32 {BLOCK_THREADS}", "i32 1", "i32 1", "i32 0"
        self._drive(LAUNCH, LAUNCH_WORDS.load(f, KERNEL), *sizes, self.stream, parameters, "ptr null")

    # --- reverse mode

    def _run_in_chunks(self):
        """Run all members with a buffer of records, which is doubled until every record fits."""
        f, longest = self.f, Value(self.f, self.f.reserve(DOUBLE), POINTER)
        self._copy(COPY_TO_HOST, longest, self._field("given steps", POINTER), 8)
        steps = f.select(self._is_well, self.module.to_int(f, f.load(longest)), f.const(0, INT))
        capacity, goes_on = f.variable(steps + FIRST_POINTS, INT, 1), f.variable(True, BOOL, 1)
        with f.while_(lambda: goes_on.value & self._is_well):
            is_short = self._run_with(capacity.value)
            capacity.value, goes_on.value = capacity.value * 2, is_short

    def _copy(self, function: str, to: Value, source: Value, size: int):
        """Copy `size` bytes between the host and the card, in the direction of the driver's `function`, and wait."""
        self._drive(function, to, source, f"i64 {size}", self.stream)
        self._drive(WAIT_FOR_STREAM, self.stream)

    def _run_with(self, capacity: Value) -> Value:
        """Run all members with room for `capacity` points in each record; return whether a record was too short."""
        f, module = self.f, self.module
        assert isinstance(module, Recorded)
        each = capacity * (8 * module.row)
        chunk, memory, size = self._allocate(each)
        for name, value in (("next", memory), ("records", f.at(memory, SHARED_BYTES, "i8")), ("capacity", capacity)):
            self._put(name, value)
        words = Value(f, f.reserve(INT, 2), POINTER)
        for k in range(2):
            f.store(0, words, k, base=INT)
        self._copy(COPY_TO_DEVICE, memory, words, 16)
        first = f.variable(0, INT, 1)
        with f.while_(lambda: (first.value < self.members) & self._is_well):
            self._put("first", first.value)
            first.value = _smaller(f, first.value + chunk, self.members)
            self._put("members", first.value)  # threads of later members do nothing
            self._run(first.value - self._field("first"))
        self._copy(COPY_TO_HOST, words, memory, 16)
        self._destroy(call_api(f, self.frame, FREE, word(f, self.frame, CONTEXT, POINTER), size, memory))
        return f.load(words, 1, base=INT).is_not(0)

    def _allocate(self, each: Value) -> tuple[Value, Value, Value]:
        """Allocate the buffer of a chunk of members, `each` bytes for the record of each member.

        Chunks are halved until there is memory for one; the handler returns XLA's error if there is none for a single member.

        Returns:
            The number of members of a chunk, the address of the memory, and its size in bytes.
        """
        f, context = self.f, word(self.f, self.frame, CONTEXT, POINTER)
        chunks = f.variable(f.arithmetic("div", each * self.members, MOST_RECORDS) + 1, INT, 1)
        chunk, size, memory = (f.variable(0, INT, 1) for _ in range(3))
        refused, goes_on = f.variable(Value(f, "null", POINTER), POINTER, 1), f.variable(True, BOOL, 1)
        with f.while_(lambda: goes_on.value):
            # As many blocks in each chunk as possible are full.
            chunk.value = f.arithmetic("div", self.members + (chunks.value - 1), chunks.value)
            chunk.value = f.select(
                chunk.value > BLOCK_THREADS,
                f.arithmetic("div", chunk.value + (BLOCK_THREADS - 1), BLOCK_THREADS) * BLOCK_THREADS,
                chunk.value,
            )
            size.value = _smaller(f, chunk.value, self.members) * each + SHARED_BYTES
            given = arguments_struct(f, context, size.value, f.const(SHARED_BYTES, INT), f.const(0, INT))
            refused.value = call_with(f, self.frame, ALLOCATE, given)
            memory.value = word(f, given, DATA_OFFSET)
            goes_on.value = ~f.is_null(refused.value) & (chunk.value > 1)
            with f.if_(goes_on.value):
                self._destroy(refused.value)
            chunks.value = chunks.value * 2
        with f.if_(~f.is_null(refused.value)):
            LAUNCH_WORDS.drive(f, POP_CONTEXT, self.context)
            f.leave(f"ptr {refused.value.name}")
        return chunk.value, f.op(f"inttoptr i64 {memory.value.name} to ptr", POINTER), size.value

    def _destroy(self, error: Value):
        with self.f.if_(~self.f.is_null(error)):
            call_api(self.f, self.frame, DESTROY_ERROR, error)


def _smaller(f: Function, a: Value, b: Operand) -> Value:
    return f.select(a < b, a, b)
