"""Generated code as an operation of compiled JAX programs, by XLA's typed foreign function interface, without a C++ compiler.

XLA calls a handler with a frame whose layout is its stable C interface (jaxlib/include/xla/ffi/api/c_api.h). The handler is
generated along with the code that it calls: it reads the buffers of the frame and writes the call record of `run`
(trajectory.py).

Threads of XLA's pool help with large batches. A thread that starts too late finds the work closed and returns. The handler waits
only for threads that have started, so a pool whose threads are all busy cannot cause a deadlock.
"""

from typing import Any

import numpy as np

from udkjax.native.language.ir import INT, POINTER, Function, Value
from udkjax.native.module.layout import INPUTS, MEMBERS_PER_THREAD
from udkjax.native.module.memory import Memory
from udkjax.threads import thread_limit

# Offsets in bytes. XLA_FFI_CallFrame: size, extensions, api, context, stage, then the arguments and the results, 40 bytes each:
# size, extensions, count, types, buffers.
EXTENSIONS, API, CONTEXT, ARGUMENTS, RESULTS, COUNT, BUFFERS = 8, 16, 24, 40, 80, 16, 32
# Functions of XLA_FFI_Api. The only argument of each is the address of a struct: size, extensions, then the actual arguments.
CREATE_ERROR, DESTROY_ERROR, STREAM, ALLOCATE, FREE, SCHEDULE, THREAD_COUNT = 48, 64, 80, 120, 128, 136, 144
# XLA_FFI_Buffer: size, extensions, dtype, data, rank, dims.
DATA, RANK, DIMS = 24, 32, 40
# Offset of the address of the metadata in an extension that requests metadata; offsets of the interface version in the metadata.
METADATA, MAJOR, MINOR = 24, 24, 28
VERSION = (0, 1)  # major, minor
# Words of the work that threads share: the number of threads that may still access the work, the number that have started (plus
# CLOSED_MARK once no more may start), the number that have finished, the next member, whether memory was refused, and the call
# record of `run`.
USERS, THREADS_BEGUN, THREADS_ENDED, NEXT_MEMBER, MEMORY_REFUSED, CALL = range(6)
CLOSED_MARK = 2**32
RESOURCE_EXHAUSTED, INTERNAL = 8, 13  # XLA_FFI_Error_Code
NO_MEMORY = b"no memory for a computation by machine code"


def handler(module: Memory, name: str) -> list[Function]:
    """Return the functions of the handler `name(frame)`, which runs the members of a call: its helpers, then the handler itself.

    In the calls by XLA, inputs are float64 arrays (1 or members, ...). Outputs are (members, ...); derivatives have the
    directions as their second axis.
    """
    f, count = Function(name, [(POINTER, "frame")], returns="ptr", cold=True), len(module.call_fields)
    frame = f.given["frame"]
    answer_metadata(f, frame)
    call, members = call_record(f, frame, module)
    progress = Value(f, f.reserve(INT, 2), POINTER)
    for k in range(2):
        f.store(0, progress, k, base=INT)
    f.store(progress, call, module.call_fields.index("next"), base=POINTER)
    shares = f.arithmetic("div", members, MEMBERS_PER_THREAD)
    threads = f.variable(1, INT, 1)
    with f.if_(shares > 1):
        threads.value = _thread_count(f, frame)
    helpers = f.select(threads.value < shares, threads.value, shares) - 1
    f.choose(helpers > 0, lambda: _run_shared(f, frame, call, count, helpers), lambda: f.call("run", call))
    with f.if_(f.load(progress, 1, base=INT).is_not(0)):
        f.leave(f"ptr {no_memory(f, frame).name}")
    f.line("ret ptr null")
    return [_help(), f]


def call_record(f: Function, frame: Value, module: Memory) -> tuple[Value, Value]:
    """Write a call record on the stack from the buffers of a frame: all fields except the last one, `next`.

    Returns:
        The address of the record, and the number of members.
    """
    fields, inputs, outputs = module.call_fields, (*INPUTS, *module.inputs), (*module.results, *module.outputs)
    call, buffers = Value(f, f.reserve(INT, len(fields)), POINTER), {}

    def put(field: str, value: Any, base: str = INT):
        f.store(value, call, fields.index(field), base=base)

    for start, names in ((ARGUMENTS, inputs), (RESULTS, outputs)):
        pointers = word(f, frame, start + BUFFERS, POINTER)
        for k, field in enumerate(names):
            buffers[field] = f.load(pointers, k, base=POINTER)
            put(field, word(f, buffers[field], DATA, POINTER), POINTER)

    def dimension(field: str, k: Any) -> Value:
        return f.load(word(f, buffers[field], DIMS, POINTER), k, base=INT)

    members = dimension(outputs[0], 0)
    put("members", members)
    put("times", dimension("ts", 1))
    put("knots", dimension("breaks", 1))
    put("directions", dimension(inputs[-1], module.directions_in))
    for field in module.lengths:
        put(f"{field} length", dimension(field, 1))
    for field in inputs:
        length = f.variable(1, INT, 1)
        with f.each(word(f, buffers[field], RANK), 1) as k:
            length.value = length.value * dimension(field, k)
        put(f"{field} stride", f.select(dimension(field, 0) > 1, length.value, f.const(0, INT)))
    return call, members


def word(f: Function, pointer: Value, offset: int, base: str = INT) -> Value:
    """Return the field of a struct at an offset in bytes: an integer of 64 bits or, if `base` is `POINTER`, an address."""
    return f.load(f.at(pointer, offset, "i8"), 0, base=base)


def answer_metadata(f: Function, frame: Value):
    """If XLA calls a handler only to ask for its metadata, store the version of the interface, and return from the handler."""
    with f.if_(word(f, frame, EXTENSIONS).is_not(0)):
        metadata = word(f, word(f, frame, EXTENSIONS, POINTER), METADATA, POINTER)
        for offset, number in ((MAJOR, VERSION[0]), (MINOR, VERSION[1])):
            f.line(f"store i32 {number}, ptr {f.at(metadata, offset, 'i8').name}, align 4")
        f.leave("ptr null")


def call_api(f: Function, frame: Value, function: int, *arguments: Value) -> Value:
    """Call the function of XLA at the offset `function` of its API; return the address of its error, or null."""
    return call_with(f, frame, function, arguments_struct(f, *arguments))


def arguments_struct(f: Function, *arguments: Value) -> Value:
    """Return the address of a struct of arguments on the stack, into which the called function may write as well."""
    struct = Value(f, f.reserve(INT, 2 + len(arguments)), POINTER)
    for k, x in enumerate((f.const(8 * (2 + len(arguments)), INT), f.const(0, INT), *arguments)):
        f.store(x, struct, k, base=x.base)
    return struct


def call_with(f: Function, frame: Value, function: int, struct: Value) -> Value:
    """Call a function of XLA, as `call_api`, with the address of a struct of arguments; return its error's address, or null."""
    address = word(f, word(f, frame, API, POINTER), function, POINTER)
    return f.op(f"call ptr {address.name}(ptr {struct.name})", POINTER)


def no_memory(f: Function, frame: Value) -> Value:
    """Return the address of a new error of XLA: there is no memory for a computation."""
    return call_api(f, frame, CREATE_ERROR, text_of(f, NO_MEMORY), f.const(RESOURCE_EXHAUSTED, INT))


def text_of(f: Function, characters: bytes, space: int = 0) -> Value:
    """Return the address of a copy of a string on the stack, with a zero at its end and `space` further bytes."""
    words = np.frombuffer(characters + bytes(8 - len(characters) % 8), np.int64)
    text = Value(f, f.reserve(INT, len(words) + space // 8), POINTER)
    for k, x in enumerate(words):
        f.store(int(x), text, k, base=INT)
    return text


def _thread_count(f: Function, frame: Value) -> Value:
    """Return the number of threads in XLA's pool, at most `UDKJAX_THREADS`; one if there is no pool.

    The pool has a thread for each core that the process may use. The limit is a constant of the text, because XLA calls the
    handler without Python.
    """
    count = Value(f, f.reserve(INT), POINTER)
    f.store(1, count, base=INT)
    error = call_api(f, frame, THREAD_COUNT, word(f, frame, CONTEXT, POINTER), count)
    with f.if_(~f.is_null(error)):
        call_api(f, frame, DESTROY_ERROR, error)
    available, limit = f.load(count, base=INT), thread_limit()
    return available if limit is None else f.select(available < limit, available, f.const(limit, INT))


def _add(f: Function, work: Value, word: int, number: Value | int) -> Value:
    """Add a number atomically to a word of shared work; return the word's previous value."""
    number = f.like(number, INT, 1)
    return f.op(f"atomicrmw add ptr {f.at(work, word, 'i64').name}, i64 {number.name} seq_cst", INT)


def _leave(f: Function, work: Value):
    """Release this thread's share of the work; the last thread frees the memory."""
    with f.if_(_add(f, work, USERS, -1).is_(1)):
        f.line(f"call void @free(ptr {work.name})")


def _help() -> Function:
    """Return the function `help(work)`: a thread of the pool calls it to join a run, unless the work is closed."""
    f = Function("help", [(POINTER, "work")], cold=True)
    work = f.given["work"]
    with f.if_(_add(f, work, THREADS_BEGUN, 1) < CLOSED_MARK):
        f.call("run", f.at(work, CALL, "i64"))
        _add(f, work, THREADS_ENDED, 1)
    _leave(f, work)
    return f


def _run_shared(f: Function, frame: Value, call: Value, count: int, helpers: Value):
    """Run the members together with `helpers` threads of the pool; without memory for the shared work, run them alone."""
    work = f.op(f"call ptr @malloc(i64 {8 * (CALL + count)})", POINTER)
    f.choose(f.is_null(work), lambda: f.call("run", call), lambda: _share(f, frame, call, count, helpers, work))


def _share(f: Function, frame: Value, call: Value, count: int, helpers: Value, work: Value):
    """Set up the memory `work` for `_run_shared`, start the helpers, run members, and wait for the helpers that have started."""
    f.store(helpers + 1, work, USERS, base=INT)
    for k in (THREADS_BEGUN, THREADS_ENDED, NEXT_MEMBER, MEMORY_REFUSED):
        f.store(0, work, k, base=INT)
    with f.each(count - 1) as k:  # all but the last field, the address of the next member
        f.store(f.load(call, k, base=INT), work, k + CALL, base=INT)
    f.store(f.at(work, NEXT_MEMBER, "i64"), work, CALL + count - 1, base=POINTER)
    context, task = word(f, frame, CONTEXT, POINTER), f.op("getelementptr i8, ptr @help, i64 0", POINTER)
    with f.each(helpers):
        error = call_api(f, frame, SCHEDULE, context, task, work)
        with f.if_(~f.is_null(error)):
            call_api(f, frame, DESTROY_ERROR, error)
            _add(f, work, USERS, -1)
    f.call("run", f.at(work, CALL, "i64"))
    begun = _add(f, work, THREADS_BEGUN, CLOSED_MARK)
    with f.while_(lambda: _add(f, work, THREADS_ENDED, 0) < begun):
        pass
    f.store(f.load(work, MEMORY_REFUSED, base=INT), f.load(call, count - 1, base=POINTER), 1, base=INT)
    _leave(f, work)
