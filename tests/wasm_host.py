"""WebAssembly outside of a page: a module of the engine with its own memory, by wasmtime."""

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

wasmtime: Any = pytest.importorskip("wasmtime")
STACK, PAGE, LINE = 2**20, 2**16, 64


class Host:
    """An instance of a module, and calls of its exports; `imports` are functions of an address, beside those of memory."""

    def __init__(self, code: bytes, data_end: int, imports: Mapping[str, Callable[[int], None]] | None = None):
        store = self.store = wasmtime.Store()
        module = wasmtime.Module(store.engine, code)
        self._start = self._end = -(-(data_end + STACK) // LINE) * LINE
        self.memory = wasmtime.Memory(store, wasmtime.MemoryType(wasmtime.Limits(self._start // PAGE + 2, None)))
        kinds = {"i32": wasmtime.ValType.i32(), "i64": wasmtime.ValType.i64(), "f64": wasmtime.ValType.f64()}
        pointer = wasmtime.Global(store, wasmtime.GlobalType(kinds["i32"], True), wasmtime.Val.i32(self._start))
        given = {"__linear_memory": self.memory, "__stack_pointer": pointer}
        functions = {"malloc": self._reserve, "free": lambda address: None, **(imports or {})}
        for imported in module.imports:
            if imported.name not in given:
                given[imported.name] = wasmtime.Func(store, imported.type, functions[imported.name])
        self.exports = wasmtime.Instance(store, module, [given[imported.name] for imported in module.imports]).exports(store)

    def _reserve(self, size: int) -> int:
        place, self._end = self._end, -(-(self._end + size) // LINE) * LINE
        missing = self._end - self.memory.data_len(self.store)
        if missing > 0:
            self.memory.grow(self.store, -(-missing // PAGE))
        return place

    def begin(self):
        """Forget everything in memory."""
        self._end = self._start

    def put(self, numbers: Any) -> int:
        """Write numbers to memory; return their address."""
        data = np.ascontiguousarray(numbers, float)
        place = self._reserve(data.nbytes)
        self.memory.write(self.store, data.tobytes(), place)
        return place

    def numbers(self, place: int, count: int) -> np.ndarray:
        """Return numbers from memory."""
        return np.frombuffer(bytes(self.memory.read(self.store, place, place + 8 * count)))

    def call(self, name: str, *addresses: int):
        """Call a function."""
        self.exports[name](self.store, *addresses)

    def run(self, module: Any, inputs: Sequence[np.ndarray], shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
        """Call `run` of an operation's module, as `native.primitive.Compiled` does."""
        self.begin()
        places = iter([self.put(x) for x in inputs])
        results = [self.put(np.full(shape, np.nan)) for shape in shapes]
        record = record_of(module, inputs, shapes, lambda x: next(places), results, self.put([0.0]))
        self.call("run", self.put(np.array(record, np.int64).view(float)))
        return [self.numbers(k, math.prod(shape)).reshape(shape) for k, shape in zip(results, shapes, strict=True)]


def record_of(
    module: Any,
    inputs: Sequence[np.ndarray],
    shapes: Sequence[tuple[int, ...]],
    address: Callable[[np.ndarray], int],
    results: Sequence[int],
    following: int,
) -> list[int]:
    """Return the words of the call record of `run`."""
    from udkjax.native.module.layout import INPUTS

    names, outputs = (*INPUTS, *module.inputs), (*module.results, *module.outputs)
    fields: dict[str, int] = {"members": shapes[0][0], "next": following}
    for name, x in zip(names, inputs, strict=True):
        fields |= {name: address(x), f"{name} stride": math.prod(x.shape[1:]) if len(x) > 1 else 0}
    given: Mapping[str, np.ndarray] = dict(zip(names, inputs, strict=True))
    fields |= {"times": given["ts"].shape[1], "knots": given["breaks"].shape[1]}
    fields |= {"directions": inputs[-1].shape[module.directions_in], **dict(zip(outputs, results, strict=True))}
    return [fields[name] for name in module.call_fields]


def run_without_contraction(module: Any, inputs: Sequence[np.ndarray], shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
    """Run the same code on this processor, compiled without fused multiply-add."""
    from udkjax.native.code import machine, processor

    llvm = processor.llvm()
    target = llvm.Target.from_default_triple().create_target_machine(
        cpu="generic", features="-fma,-fma4", opt=machine.OPTIMIZATION_LEVEL, reloc="pic", codemodel="small", jit=True
    )
    code = machine.object_code(module.written_text, target, llvm.get_default_triple())
    library = machine.Library([code], ("run",))
    found, following = [np.full(shape, np.nan) for shape in shapes], np.zeros(1, np.int64)
    inputs = [np.ascontiguousarray(x, float) for x in inputs]
    words = record_of(module, inputs, shapes, lambda x: x.ctypes.data, [x.ctypes.data for x in found], following.ctypes.data)
    record = np.array(words, np.int64)
    machine.function(library["run"], ctypes.c_void_p)(record.ctypes.data)
    return found
