"""A function of ours as an operation of a compiled JAX program: XLA's typed foreign functions, without a C++ compiler.

XLA calls a handler with a frame whose layout is its stable C interface (jaxlib/include/xla/ffi/api/c_api.h). The handler is
generated along with the code that it calls: it reads the buffers of the frame and writes what `run` is told (trajectory.py).
"""

from typing import Any

from udkjax.native.ir import INT, POINTER, Function, Value
from udkjax.native.layout import INPUTS
from udkjax.native.trajectory import Trajectory

# Offsets in bytes. XLA_FFI_CallFrame: size, extensions, api, context, stage, and in it the arguments and results, 40 bytes each:
# size, extensions, count, types, buffers.
EXTENSIONS, ARGUMENTS, RESULTS, BUFFERS = 8, 40, 80, 32
# XLA_FFI_Buffer: size, extensions, dtype, data, rank, dims.
DATA, RANK, DIMS = 24, 32, 40
# Of an extension that asks for metadata: where they go, and in them the version (of the interface) that the handler speaks.
METADATA, MAJOR, MINOR = 24, 24, 28
VERSION = (0, 1)


def handler(trajectory: Trajectory, name: str) -> Function:
    """`name(frame)`: every input is (1 or members, ...), of float64; outputs have all members, and then their directions."""
    f, fields = Function(name, [(POINTER, "frame")], returns="ptr", cold=True), trajectory.call_fields
    inputs, outputs = (*INPUTS, *trajectory.inputs), (*trajectory.results, *trajectory.outputs)
    frame = f.given["frame"]

    def word(pointer: Value, offset: int, base: str = INT) -> Value:
        return f.load(f.at(pointer, offset, "i8"), 0, base=base)

    extension = word(frame, EXTENSIONS)
    with f.if_(extension.is_not(0)):
        metadata = word(word(frame, EXTENSIONS, POINTER), METADATA, POINTER)
        for offset, number in ((MAJOR, VERSION[0]), (MINOR, VERSION[1])):
            f.line(f"store i32 {number}, ptr {f.at(metadata, offset, 'i8').name}, align 4")
        f.line("ret ptr null")
        f.line(f"{f._label('after')}:")
    call = Value(f, f.reserve(INT, len(fields)), POINTER)

    def put(field: str, value: Any, base: str = INT):
        f.store(value, call, fields.index(field), base=base)

    buffers = [word(f.at(frame, start, "i8"), BUFFERS, POINTER) for start in (ARGUMENTS, RESULTS)]
    found = {}
    for pointers, names in zip(buffers, (inputs, outputs), strict=True):
        for k, field in enumerate(names):
            found[field] = f.load(pointers, k, base=POINTER)
            put(field, word(found[field], DATA, POINTER), POINTER)

    def dimension(field: str, k: int) -> Value:
        return f.load(word(found[field], DIMS, POINTER), k, base=INT)

    put("members", dimension(outputs[0], 0))
    put("times", dimension("ts", 1))
    put("knots", dimension("breaks", 1))
    put("directions", dimension(inputs[-1], trajectory.directions_in))
    for field in trajectory.lengths:
        put(f"{field} length", dimension(field, 1))
    for field in inputs:
        length = f.variable(1, INT, 1)
        with f.each(word(found[field], RANK), 1) as k:
            length.value = length.value * f.load(word(found[field], DIMS, POINTER), k, base=INT)
        put(f"{field} stride", f.select(dimension(field, 0) > 1, length.value, f.const(0, INT)))
    following = Value(f, f.reserve(INT), POINTER)
    f.store(0, following, base=INT)
    put("next", following, POINTER)
    f.call("run", call)
    f.line("ret ptr null")
    return f
