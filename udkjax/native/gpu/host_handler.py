"""Operations of the host in programs of a graphics card: a handler copies, calls the operation's own handler, and copies back.

XLA calls the handler on the host with buffers of the card, when the program of the card reaches the operation. It copies the
arguments to the host on the program's stream, waits for them, and calls the operation with the same frame but with buffers of
the host, and with threads, of which XLA has none here. It copies the results back and waits again, since it frees its memory.

The driver waits for the end of each copy unless the memory of the host is pinned. Pinning takes long; hence there is one block of
pinned memory for all operations, for one call at a time. Calls that find it in use or too small use other memory.

The code is the same for all operations. Each of them loads it once, with its own `words`: the addresses that it calls.
"""

import ctypes
from functools import cache
from threading import Lock

import jax

from udkjax.native.code import machine
from udkjax.native.gpu.driver import CudaDriver, driver
from udkjax.native.gpu.driver_calls import (
    ARGUMENTS_OFFSET,
    CONTEXT_OF_STREAM,
    COPY_TO_DEVICE,
    COPY_TO_HOST,
    PLATFORM,
    POP_CONTEXT,
    PUSH_CONTEXT,
    WAIT_FOR_STREAM,
    Words,
    stream_of,
)
from udkjax.native.host.ffi import (
    API,
    ARGUMENTS,
    BUFFERS,
    COUNT,
    DATA,
    DIMS,
    RANK,
    RESULTS,
    SCHEDULE,
    THREAD_COUNT,
    answer_metadata,
    no_memory,
    word,
)
from udkjax.native.language.ir import BOOL, INT, POINTER, Function, Value, Variable
from udkjax.native.language.text import ALLOCATION_DECLARATIONS, text_of_module
from udkjax.threads import cores

# The handler of the operation, the number of threads, and the address and the number of bytes of the pinned memory.
HANDLER, THREADS, PINNED, PINNED_SIZE = "handler", "threads", "pinned", "pinned size"
HANDLER_WORDS = Words((COPY_TO_HOST, COPY_TO_DEVICE, WAIT_FOR_STREAM), (HANDLER, THREADS, PINNED, PINNED_SIZE))
BUFFER_BYTES = 48  # XLA_FFI_Buffer
ALIGNMENT = 64  # of arrays, in bytes; as many precede the pinned memory, whose first number is 1 while it is in use
PINNED_BYTES = 2**20
PORTABLE_MEMORY = 1  # CU_MEMHOSTALLOC_PORTABLE: for all devices
COPY_FAILED = b"copying between the graphics card and the host failed: "
LIBC_DECLARATIONS = (
    *ALLOCATION_DECLARATIONS,
    "declare i32 @pthread_create(ptr, ptr, ptr, ptr)",
    "declare i32 @pthread_detach(i64)",
)


def register(name: str, handler: int) -> str:
    """Make an operation of the CPU callable from programs of graphics cards; return the name of its FFI target there.

    Without a graphics card nothing is registered: programs are then only written here, to run elsewhere.

    Args:
        name: the name of the target on the CPU.
        handler: the address of its handler.
    """
    copied, found = f"{name}_copied", driver()
    with _REGISTERING_LOCK:
        if found is not None and copied not in _REGISTERED:
            library = load(found, handler)
            jax.ffi.register_ffi_target(copied, jax.ffi.pycapsule(ctypes.c_void_p(library["copy_and_call"])), platform=PLATFORM)
            _REGISTERED[copied] = library
    return copied


_REGISTERED: dict[str, machine.Library] = {}  # XLA may call these for as long as the process runs
_REGISTERING_LOCK = Lock()


def load(of: CudaDriver, handler: int, threads: int | None = None) -> machine.Library:
    """Return the loaded code of the handler `copy_and_call(frame)` for one operation.

    Args:
        of: the driver.
        handler: the address of the operation's handler on the CPU.
        threads: the number of threads that it may use; None: one for each core.
    """
    library = machine.library(module_text(), ("copy_and_call", "words"))
    pinned = _pinned(of)
    HANDLER_WORDS.fill(library, of, handler, cores() if threads is None else threads, pinned, PINNED_BYTES if pinned else 0)
    return library


@cache
def _pinned(of: CudaDriver) -> int:
    """Return the address of the page-locked memory of the host that all operations share; 0 if the driver cannot allocate it."""
    place = ctypes.c_int64()
    try:
        with of.current(_device()):
            of("cuMemHostAlloc", ctypes.addressof(place), ALIGNMENT + PINNED_BYTES, PORTABLE_MEMORY)
    except RuntimeError:  # the driver has no memory, or JAX does not compute on the card
        return 0
    ctypes.memset(place.value, 0, ALIGNMENT)
    return place.value


def _device() -> int:
    """Return the number of a card on which JAX computes already: a new context on another card would take memory there."""
    return jax.local_devices(backend="cuda")[0].local_hardware_id


@cache
def module_text() -> str:
    """Return LLVM's text of the module with the handler, the same for all operations."""
    functions = [_thread_count(), _schedule(), _copy_and_call()]
    return text_of_module(functions, [HANDLER_WORDS.text], LIBC_DECLARATIONS)


def _copy_and_call() -> Function:
    """Return the handler: it copies inputs to the host, runs the operation there, and copies outputs back."""
    f = Function("copy_and_call", [(POINTER, "frame")], returns="ptr", cold=True)
    frame = f.given["frame"]
    answer_metadata(f, frame)
    stream = stream_of(f, frame)
    block, is_pinned = _block(f, _total_bytes(f, frame))
    with f.if_(f.is_null(block)):
        f.leave(f"ptr {no_memory(f, frame).name}")
    on_host = _frame_on_host(f, frame, block)
    answer, error = _run(f, frame, on_host, stream)
    f.choose(
        is_pinned,
        lambda: f.line(f"store atomic i64 0, ptr {HANDLER_WORDS.load(f, PINNED).name} seq_cst, align 8"),
        lambda: f.line(f"call void @free(ptr {block.name})"),
    )
    with f.if_(answer.value.is_not(0)):
        f.leave(f"ptr {HANDLER_WORDS.error(f, frame, COPY_FAILED, answer.value).name}")
    f.line(f"ret ptr {error.value.name}")
    return f


def _block(f: Function, size: Value) -> tuple[Value, Value]:
    """Return the address of `size` bytes, or null; and whether they are in the pinned memory, which is then marked as in use."""
    block, is_pinned = f.variable(Value(f, "null", POINTER), POINTER, 1), f.variable(False, BOOL, 1)
    pinned = HANDLER_WORDS.load(f, PINNED)
    with f.if_(size <= HANDLER_WORDS.load(f, PINNED_SIZE, INT)):
        is_pinned.value = f.op(f"atomicrmw xchg ptr {pinned.name}, i64 1 seq_cst", INT).is_(0)

    def take():
        block.value = f.at(pinned, ALIGNMENT, "i8")

    def allocate():
        block.value = f.op(f"call ptr @malloc(i64 {size.name})", POINTER)

    f.choose(is_pinned.value, take, allocate)
    return block.value, is_pinned.value


def _buffers(f: Function, frame: Value, kind: int) -> tuple[Value, Value]:
    """Return the number of the arguments or results of a frame, and the address of the pointers to their buffers."""
    return word(f, frame, kind + COUNT), word(f, frame, kind + BUFFERS, POINTER)


def _bytes(f: Function, buffer: Value) -> Value:
    """Return the number of bytes of an array of float64 numbers."""
    size = f.variable(8, INT, 1)
    with f.each(word(f, buffer, RANK)) as k:
        size.value = size.value * f.load(word(f, buffer, DIMS, POINTER), k, base=INT)
    return size.value


def _aligned(f: Function, size: Value) -> Value:
    """Return a number of bytes rounded up to a multiple of the alignment."""
    return f.logic("and", size + (ALIGNMENT - 1), -ALIGNMENT)


def _total_bytes(f: Function, frame: Value) -> Value:
    """Return the number of bytes that `_frame_on_host` needs for a frame."""
    fixed = (word(f, frame, 0), word(f, word(f, frame, API, POINTER), 0))
    total = f.variable(ALIGNMENT, INT, 1)
    for size in fixed:
        total.value = total.value + _aligned(f, size)
    for kind in (ARGUMENTS, RESULTS):
        count, pointers = _buffers(f, frame, kind)
        total.value = total.value + _aligned(f, count * 8)
        with f.each(count) as k:
            array = _bytes(f, f.load(pointers, k, base=POINTER))
            total.value = total.value + _aligned(f, array) + ALIGNMENT
    return total.value


def _frame_on_host(f: Function, frame: Value, block: Value) -> Value:
    """Return a copy of the frame in `block`, with arrays of the host, and with `schedule` and `thread_count` in its API."""
    start = f.op(f"ptrtoint ptr {block.name} to i64", INT)
    place = f.variable(_aligned(f, start) - start, INT, 1)

    def take(size: Value) -> Value:
        taken = f.at(block, place.value, "i8")
        place.value = place.value + _aligned(f, size)
        return taken

    def copy(struct: Value, size: Value) -> Value:
        copied = take(size)
        with f.each(f.arithmetic("div", size, 8)) as k:
            f.store(f.load(struct, k, base=INT), copied, k, base=INT)
        return copied

    def put(x: Value, struct: Value, offset: int):
        f.store(x, f.at(struct, offset, "i8"), base=POINTER)

    on_host, api = copy(frame, word(f, frame, 0)), word(f, frame, API, POINTER)
    api = copy(api, word(f, api, 0))
    put(api, on_host, API)
    for offset, name in ((SCHEDULE, "@schedule"), (THREAD_COUNT, "@thread_count")):
        put(Value(f, name, POINTER), api, offset)
    for kind in (ARGUMENTS, RESULTS):
        count, given = _buffers(f, frame, kind)
        pointers = take(count * 8)
        put(pointers, on_host, kind + BUFFERS)
        with f.each(count) as k:
            buffer = copy(f.load(given, k, base=POINTER), f.const(BUFFER_BYTES, INT))
            f.store(buffer, pointers, k, base=POINTER)
            put(take(_bytes(f, buffer)), buffer, DATA)
    return on_host


def _run(f: Function, frame: Value, on_host: Value, stream: Value) -> tuple[Variable, Variable]:
    """Copy the arguments to the host, call the operation, and copy the results back.

    Returns:
        The first error number of the driver, 0 without an error; and the operation's error of XLA, null without an error.
    """
    place, error = Value(f, f.reserve(POINTER), POINTER), f.variable(Value(f, "null", POINTER), POINTER, 1)
    answer = f.variable(HANDLER_WORDS.drive(f, CONTEXT_OF_STREAM, stream, place), INT, 1)

    def copy(kind: int, function: str):
        (count, on_card), (_, copies) = _buffers(f, frame, kind), _buffers(f, on_host, kind)
        with f.each(count) as k:
            card, host = (f.load(x, k, base=POINTER) for x in (on_card, copies))
            size = _bytes(f, card)
            with f.if_(answer.value.is_(0) & (size > 0)):
                ends = [word(f, x, DATA, POINTER) for x in ((host, card) if function == COPY_TO_HOST else (card, host))]
                answer.value = HANDLER_WORDS.drive(f, function, *ends, size, stream)
        waited = HANDLER_WORDS.drive(f, WAIT_FOR_STREAM, stream)  # also after an error, for the copies before it
        answer.value = f.select(answer.value.is_(0), waited, answer.value)

    with f.if_(answer.value.is_(0)):
        answer.value = HANDLER_WORDS.drive(f, PUSH_CONTEXT, f.load(place, base=POINTER))
        with f.if_(answer.value.is_(0)):
            copy(ARGUMENTS, COPY_TO_HOST)
            with f.if_(answer.value.is_(0)):
                handler = HANDLER_WORDS.load(f, HANDLER)
                error.value = f.op(f"call ptr {handler.name}(ptr {on_host.name})", POINTER)
                with f.if_(f.is_null(error.value)):
                    copy(RESULTS, COPY_TO_DEVICE)
            HANDLER_WORDS.drive(f, POP_CONTEXT, place)
    return answer, error


def _thread_count() -> Function:
    """Return a function in place of XLA_FFI_ThreadPool_NumThreads: it answers the number of threads in the word `THREADS`."""
    f = Function("thread_count", [(POINTER, "given")], returns="ptr", cold=True)
    f.store(HANDLER_WORDS.load(f, THREADS, INT), word(f, f.given["given"], ARGUMENTS_OFFSET, POINTER), base=INT)
    f.line("ret ptr null")
    return f


def _schedule() -> Function:
    """Return a function in place of XLA_FFI_ThreadPool_Schedule: it starts a thread (20 us) for each task.

    If no thread can be started, the caller's thread runs the task.
    """
    f = Function("schedule", [(POINTER, "given")], returns="ptr", cold=True)
    task, data = (word(f, f.given["given"], offset, POINTER) for offset in (ARGUMENTS_OFFSET, ARGUMENTS_OFFSET + 8))
    thread = Value(f, f.reserve(INT), POINTER)
    # A thread's function returns a pointer, a task returns nothing: the pointer is never read.
    begun = f.op(f"call i32 @pthread_create(ptr {thread.name}, ptr null, ptr {task.name}, ptr {data.name})", "i32")
    f.choose(
        f.op(f"zext i32 {begun.name} to i64", INT).is_(0),
        lambda: f.line(f"call i32 @pthread_detach(i64 {f.load(thread, base=INT).name})"),
        lambda: f.line(f"call void {task.name}(ptr {data.name})"),
    )
    f.line("ret ptr null")
    return f
