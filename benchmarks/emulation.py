"""Kernels without a GPU: their functions compiled for this processor, one thread after another."""

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.native import loaded_code, primitive, records
from udkjax.native.code import machine, processor
from udkjax.native.derivatives.record import FIRST_POINTS, Recorded
from udkjax.native.gpu.kernel import VECTOR_LENGTH, KernelCode, kernel_code
from udkjax.native.loaded_code import BREAKS_INPUT
from udkjax.native.module.layout import INPUTS
from udkjax.native.operations import Operation

ALONE = "define i1 @meet(i1 %goes_on) { ret i1 %goes_on }\n"  # a block of one thread


class Called(NamedTuple):
    """A call of machine code with a batch."""

    operation: Operation
    inputs: list[np.ndarray]
    times: int
    outputs: list[np.ndarray]

    @property
    def kernel(self) -> KernelCode:
        directions = self.inputs[-1].shape[1] if self.operation.tangents else 0
        return kernel_code(self.operation, directions, len(self.inputs[0]) == 1)


def calls_of(function: Callable, *given: Any) -> list[Called]:
    """The calls of machine code with many members that a function makes."""
    calls, call_members = [], loaded_code.call_members

    def record(*inputs: Any, operation: Operation, times: int) -> list[np.ndarray]:
        arrays = [np.array(x, float) for x in inputs]  # copies, as callers may change theirs
        code = loaded_code.machine_code(operation, 1, 1)  # dense methods round otherwise in lanes
        outputs = code(arrays, operation.shapes(arrays, times))
        calls.append(Called(operation, arrays, times, [np.array(x) for x in outputs]))
        return outputs

    caches, lanes, largest = (loaded_code.generate, loaded_code.machine_code), processor.lanes, records.LARGEST_RECORDS
    for cache in caches:
        cache.cache_clear()
    # Sums over vectors depend on the size of a register.
    primitive.call_members = loaded_code.call_members = record
    processor.lanes = lambda: VECTOR_LENGTH
    records.LARGEST_RECORDS = 0  # as for the large batches of kernels
    try:
        with jax.disable_jit():
            function(*given)
    finally:
        primitive.call_members = loaded_code.call_members = call_members
        processor.lanes, records.LARGEST_RECORDS = lanes, largest
        for cache in caches:
            cache.cache_clear()
    return [call for call in calls if call.outputs[0].shape[0] > 1]


def call_record(code: KernelCode, call: Called, addresses: Sequence[int], buffer: Sequence[int] = ()) -> np.ndarray:
    """The call record of a kernel, from the addresses of its inputs and outputs; `buffer` has the fields of a buffer."""
    inputs, module = call.inputs, code.module
    names, arrays = (*INPUTS, *module.inputs, *module.results, *module.outputs), (*inputs, *call.outputs)
    words = [len(call.outputs[0]), call.times, inputs[BREAKS_INPUT].shape[1], inputs[-1].shape[module.directions_in]]
    words += addresses[: len(inputs)]
    words += [x.size // len(x) if len(x) > 1 else 0 for x in inputs]
    words += addresses[len(inputs) :]
    words += [arrays[names.index(name)].shape[1] for name in module.lengths]
    words += [*buffer, 0]
    assert len(words) == len(module.call_fields)
    return np.array(words, np.int64)


class Thread:
    """A thread of a kernel on this processor."""

    def __init__(self, code: KernelCode):
        self._library = machine.Library([machine.compile_module(ALONE + code.functions_text(()))], ["run_member"])
        kinds = ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64
        self._run = ctypes.CFUNCTYPE(None, *kinds)(self._library["run_member"])
        self._memory = np.full(code.code.size + 8, np.nan)

    def __call__(self, record: int, member: int):
        """Run a member, from the address of the call record."""
        self._run(record, -(-self._memory.ctypes.data // 64) * 64, member)


class Arrays:
    """The arrays of a call of a kernel: its outputs, its buffer of records, and its call record."""

    def __init__(self, code: KernelCode, call: Called):
        self.outputs, fields = [np.full(x.shape, np.nan) for x in call.outputs], []
        if isinstance(code.module, Recorded):
            steps = call.inputs[-records.GIVEN_STEPS]
            points = int(steps.max(initial=0.0)) + FIRST_POINTS
            self._buffer = np.full(len(self.outputs[0]) * points * code.module.row + 1, np.nan)
            fields = [self._buffer.ctypes.data, points, 0]
        self.record = call_record(code, call, [x.ctypes.data for x in (*call.inputs, *self.outputs)], fields)

    @property
    def address(self) -> int:
        """The address of the call record."""
        return self.record.ctypes.data


def run_threads(code: KernelCode, call: Called) -> list[np.ndarray]:
    """Run the threads one after another; return the outputs."""
    thread, arrays = Thread(code), Arrays(code, call)
    for member in range(len(arrays.outputs[0]) + 3):  # a block has threads without a member
        thread(arrays.address, member)
    return arrays.outputs
