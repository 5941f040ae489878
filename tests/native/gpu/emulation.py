"""Kernels without a GPU: their functions compiled for this processor, one thread after another."""

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.native import primitive
from udkjax.native.base import machine
from udkjax.native.gpu.kernel import KernelCode
from udkjax.native.operations import Operation

ALONE = "define i1 @meet(i1 %goes_on) { ret i1 %goes_on }\n"  # a block of one thread


class Called(NamedTuple):
    """A call of machine code: what a batch made it do."""

    operation: Operation
    inputs: list[np.ndarray]
    times: int
    outputs: list[np.ndarray]

    @property
    def directions(self) -> int:
        return self.inputs[-1].shape[1] if self.operation.tangents else 0


def calls_of(function: Callable, *given: Any) -> list[Called]:
    """The calls of machine code with many members that a function makes."""
    calls, call_members = [], primitive.call_members

    def record(*inputs: Any, operation: Operation, times: int) -> list[np.ndarray]:
        arrays = [np.ascontiguousarray(x, float) for x in inputs]
        outputs = call_members(*arrays, operation=operation, times=times)
        calls.append(Called(operation, arrays, times, [np.array(x) for x in outputs]))
        return outputs

    primitive.call_members = record
    try:
        with jax.disable_jit():
            function(*given)
    finally:
        primitive.call_members = call_members
    return [call for call in calls if call.outputs[0].shape[0] > 1]


def call_record(code: KernelCode, call: Called, addresses: Sequence[int]) -> np.ndarray:
    """The call record of a kernel, from the addresses of its inputs and outputs."""
    inputs, count = call.inputs, len(call.inputs)
    words = [len(call.outputs[0]), call.times, inputs[6].shape[1], inputs[-1].shape[code.module.directions_in]]
    words += addresses[:count]
    words += [x.size // len(x) if len(x) > 1 else 0 for x in inputs]
    words += [*addresses[count:], 0]
    assert len(words) == len(code.module.call_fields)
    return np.array(words, np.int64)


def run_threads(code: KernelCode, call: Called) -> list[np.ndarray]:
    """What the threads write, one after another."""
    text = ALONE + code.functions_text(())
    library = machine.Library([machine.compile_module(text)], ["run_member"])
    run = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(library["run_member"])
    outputs = [np.full(x.shape, np.nan) for x in call.outputs]
    record = call_record(code, call, [x.ctypes.data for x in (*call.inputs, *outputs)])
    block = np.full(code.code.size + 8, np.nan)
    work = -(-block.ctypes.data // 64) * 64
    for member in range(len(outputs[0]) + 3):  # a block has threads without a member
        run(record.ctypes.data, work, member)
    return outputs
