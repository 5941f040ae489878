"""The machine code of operations (operations.py): compiled once for each operation, and called directly on concrete numbers."""

import ctypes
import math
import time
import weakref
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from functools import cached_property, lru_cache, partial
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from udkjax.native import records
from udkjax.native.code import interrupts, machine, processor
from udkjax.native.gpu import host_handler
from udkjax.native.host.ffi import handler
from udkjax.native.language.text import text_of_module
from udkjax.native.module.layout import INFO_NAMES, INPUTS, OUTPUTS
from udkjax.native.module.loading import Code, load
from udkjax.native.module.memory import Memory
from udkjax.native.module.steps import Status
from udkjax.native.operations import Operation
from udkjax.native.runs import RunCotangents, goes_back
from udkjax.native.shared_loads import call_by_rows
from udkjax.programs.identity_cache import cached_by_size
from udkjax.threads import shared_threads, thread_count

CODE_BYTES = 1.4  # memory of loaded code, with the programs of its scene, for each character of the text
QUICK_MEMBERS = 16  # maximum number of members of a call by quickly compiled code
QUICK_STEPS = 4_000  # maximum number of steps of all members of such a call together, some 20 ms
QUICK_SECONDS_OF_LINE = 2e-6  # total time of such calls per line of text: a tenth of its compile time
TIMES_INPUT, BREAKS_INPUT = INPUTS.index("ts"), INPUTS.index("breaks")
FEW_MEMBERS = 2  # maximum number of members that run one after another: eight lanes take as long as two members


@lru_cache(maxsize=1)  # a module takes ten times as much memory as its code
def generate(operation: Operation, width: int, tangent_lanes: int) -> Memory:
    """Return the module of an operation for `width` lanes, with its text; raise `UnsupportedError` if that is impossible.

    `tangent_lanes`: the number of directions that are computed together, in lanes, if there is a single member.
    """
    module = operation.module(width, tangent_lanes, processor.lanes())
    handlers = handler(module, "call_frame")
    module.written_text = f"{module.text()}\n{text_of_module(handlers)}"
    return module


class PreparedCall(NamedTuple):
    """A prepared call of machine code: the call record (module/memory.py), and the arrays to which it points."""

    run: Callable[[int], Any]
    record: ctypes.Array
    shared: ctypes.Array  # the index of the next member, and whether memory was refused
    threads: int
    inputs: list[np.ndarray]  # float64, contiguous in memory
    outputs: list[np.ndarray]

    def __call__(self) -> list[np.ndarray]:
        """Run the code and return the outputs, which the next call overwrites; raise `MemoryError` if memory was refused."""
        self.shared[:], address = (0, 0), ctypes.addressof(self.record)
        interrupts.handler().install()
        others = [shared_threads().submit(self.run, address) for _ in range(self.threads - 1)]
        try:
            self.run(address)
        finally:
            if others:
                _wait_for(others)  # they write to the arrays
        if self.shared[1]:
            raise MemoryError("no memory for a computation by machine code")
        return self.outputs


def _wait_for(calls: Sequence[Future[Any]]) -> None:
    """Wait until all calls of machine code have ended, even after Ctrl-C; then raise the interruption, or an error of a call."""
    interruption: BaseException | None = None
    for call in calls:
        while not call.done():
            try:
                wait([call])
            except KeyboardInterrupt as error:  # machine code ends, too
                interruption = error
    if interruption is not None:
        raise interruption
    for call in calls:
        call.result()


class LoadedCode:
    """The machine code of one operation in `width` lanes.

    When members first leave the module for that of the later operation (`Operation.later`), the code of the later module is
    loaded at the same level of optimization, and is called directly from then on.

    The first calls use code that is compiled quickly and runs slowly, if they have few members and steps, and until they have
    taken a tenth of the time that compiling optimized code takes. Both codes give the same results, bit for bit.
    """

    def __init__(self, operation: Operation, width: int, tangent_lanes: int):
        module = generate(operation, width, tangent_lanes)
        self._operation, self._lanes = operation, (width, tangent_lanes)
        self._later: LoadedCode | None = None  # the code of the later operation, once a run has needed it
        self._packed_text, self._directions_in = zlib.compress((text := module.written_text).encode(), 1), module.directions_in
        self._field_count, self._share = len(module.call_fields), operation.share
        self._step_limit = {name: k for k, name in enumerate(operation.all_settings)}.get("max_steps")
        self._seconds = QUICK_SECONDS_OF_LINE * text.count("\n") if operation.code.is_small else 0.0
        names = (*INPUTS, *module.inputs, *module.results, *module.outputs)
        self._lengths = [names.index(name) for name in module.lengths]
        self.size = round(CODE_BYTES * len(text))  # an estimate of its memory, with that of the scene's programs

    def _load(self, level: int) -> Code:
        later = self._operation.later
        load_later = None if later is None else partial(_load_later, weakref.ref(self), later, self._lanes, level)
        return load(zlib.decompress(self._packed_text).decode(), level, load_later)

    @property
    def name(self) -> str:
        """The name of the optimized code as an FFI target of XLA in programs of the CPU; the first access registers the code."""
        return (self._later or self).code(machine.OPTIMIZATION_LEVEL).name

    @property
    def name_on_card(self) -> str:
        """The name of the FFI target in programs of a graphics card: a function with which the host computes for the card.

        The driver calls this function from threads of its own, which should not wait for Python to load code. Therefore the
        target is the code of the later operation, if there is one: it contains all functions that a run may need.
        """
        if self._operation.later:
            return LoadedCode(self._operation.later, *self._lanes).name_on_card
        return host_handler.register(self.name, self._optimized.library["call_frame"])

    def code(self, level: int) -> Code:
        """Return the code at a level, `machine.OPTIMIZATION_LEVEL` or `machine.QUICK_LEVEL`; its first use compiles it."""
        return self._optimized if level == machine.OPTIMIZATION_LEVEL else self._quick

    @cached_property
    def _optimized(self) -> Code:
        self._seconds = 0.0
        return self._load(machine.OPTIMIZATION_LEVEL)

    @cached_property
    def _quick(self) -> Code:
        return self._load(machine.QUICK_LEVEL)

    def __call__(self, inputs: Sequence[np.ndarray], shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
        """Return the outputs for these inputs, arrays of the given shapes.

        They are computed by `thread_count` threads, or by fewer if there are few members.
        """
        if self._later:
            return self._later(inputs, shapes)
        if self._seconds > 0.0 and shapes[0][0] <= QUICK_MEMBERS and self.is_quick(inputs):
            outputs = self._call_quickly(inputs, shapes)
            if outputs is not None:
                return outputs
        return (self._later or self).prepare(inputs, shapes)()

    def is_quick(self, inputs: Sequence[np.ndarray]) -> bool:
        """Return True if quickly compiled code is to run a call with few members and these inputs.

        Such a call must end after a limited number of steps. The second pass of reverse mode cannot do so if it integrates again.
        """
        if self._seconds <= 0.0 or self._quick.library.is_optimized:
            return False
        return not isinstance(self._operation, RunCotangents) or not goes_back(inputs) or records.are_given(inputs)

    def _call_quickly(self, inputs: Sequence[np.ndarray], shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray] | None:
        """Return the outputs, computed by quickly compiled code; None if a run exceeds its share of `QUICK_STEPS` steps."""
        inputs, allowed, column = [*inputs], QUICK_STEPS / shapes[0][0], self._step_limit
        if column is not None:
            k = INPUTS.index("settings")
            settings = inputs[k] = np.array(inputs[k], np.float64)
            is_limited = settings[:, column] > allowed
            settings[is_limited, column] = allowed
        start = time.perf_counter()
        outputs = self.prepare(inputs, shapes, self._quick)()
        self._seconds -= time.perf_counter() - start
        if column is not None:
            info = outputs[OUTPUTS.index("info")]
            if info.size and np.any(is_limited & (info[:, INFO_NAMES.index("code")] == Status.STEP_LIMIT)):
                self._seconds = 0.0
                return None
        return outputs

    def prepare(self, inputs: Sequence[np.ndarray], shapes: Sequence[tuple[int, ...]], code: Code | None = None) -> PreparedCall:
        """Return a call of `code`, by default of the optimized code, which may be repeated with other numbers in its `inputs`.

        The arrays of `PreparedCall.inputs` are the given ones if these are contiguous and of float64; otherwise they are copies.
        """
        code, inputs = code or self._optimized, [np.ascontiguousarray(x, np.float64) for x in inputs]
        outputs = [np.full(shape, np.nan) for shape in shapes]
        members, times, knots = shapes[0][0], inputs[TIMES_INPUT].shape[1], inputs[BREAKS_INPUT].shape[1]
        arrays, following = (*inputs, *outputs), (ctypes.c_int64 * 2)()
        record = (  # the fields in the order of `Memory.call_fields`
            *(members, times, knots, inputs[-1].shape[self._directions_in]),
            *(x.__array_interface__["data"][0] for x in inputs),
            *(x.size // len(x) if len(x) > 1 else 0 for x in inputs),
            *(x.__array_interface__["data"][0] for x in outputs),
            *(arrays[k].shape[1] for k in self._lengths),
            ctypes.addressof(following),
        )
        assert len(record) == self._field_count
        call = (ctypes.c_int64 * len(record))(*record)
        shares = members // self._share
        threads = 1 if shares <= 1 else min(shares, thread_count())
        return PreparedCall(code.run, call, following, threads, inputs, outputs)


def _load_later(owner: Callable[[], LoadedCode | None], operation: Operation, lanes: tuple[int, int], level: int) -> Code:
    """Return the code of the later operation `operation`, and make its owner call this code from then on.

    `owner()` returns the `LoadedCode` of the first operation, or None if it has been deleted.
    """
    later, loaded = LoadedCode(operation, *lanes), owner()
    if loaded is not None:
        loaded._later = later
    return later.code(level)


@cached_by_size(lambda code: code.size)
def machine_code(operation: Operation, width: int, tangent_lanes: int) -> LoadedCode:
    """Return the machine code of an operation, from the cache if it has been requested before."""
    return LoadedCode(operation.first, width, tangent_lanes)


def call_concrete(operation: Operation, inputs: Sequence[np.ndarray], times: int) -> list[np.ndarray]:
    """Return the outputs of an operation for one member, without tracing; `inputs` are concrete arrays (1, ...)."""
    if operation.code.shares_by_marks:
        return call_by_rows(call_members, inputs, operation, times)
    return machine_code(operation, 1, 1)(inputs, operation.shapes(inputs, times))


def select_code(inputs: Sequence[Any], operation: Operation) -> LoadedCode:
    """Return the code that suits the members and directions of these inputs: few members run one after another, more in lanes."""
    one_by_one = not operation.in_lanes or max(x.shape[0] for x in inputs) <= FEW_MEMBERS
    directions = inputs[-1].shape[1] if operation.tangents and one_by_one and operation.code.is_small else 1
    tangent_lanes = min(2 ** math.ceil(math.log2(directions)), processor.lanes())  # shorter registers are faster
    return machine_code(operation, 1 if one_by_one else processor.lanes(), tangent_lanes)


def call_members(*inputs: np.ndarray, operation: Operation, times: int) -> list[np.ndarray]:
    """Return the outputs of an operation for any number of members; `inputs` are concrete arrays (1 or members, ...)."""
    if operation.code.shares_by_marks:
        return call_by_rows(call_members, inputs, operation, times)
    return select_code(inputs, operation)(inputs, operation.shapes(inputs, times))


class MemberCalls:
    """A function that runs one operation on concrete numbers, and keeps a prepared call for inputs of the same shapes."""

    def __init__(self, operation: Operation):
        self._operation, self._shapes, self._lock = operation, (), Lock()
        self._prepared: PreparedCall | None = None

    def __call__(self, *inputs: np.ndarray, times: int) -> list[np.ndarray]:
        """Return the outputs for any number of members, at `times` output times."""
        return call_members(*inputs, operation=self._operation, times=times)

    def of_one(self, *inputs: np.ndarray, times: int) -> list[np.ndarray]:
        """Return copies of the outputs of `at_states`, for one member at `times` output times; threads may call it at once."""
        with self._lock:
            return [x.copy() for x in self.at_states(*inputs, times=times)]

    def at_states(self, *inputs: np.ndarray, times: int = 2) -> list[np.ndarray]:
        """Return the outputs, which the next call overwrites.

        If the inputs have the same shapes as in the last call, its prepared call is repeated. Therefore the operation must
        write all of its outputs, as operations at single states do, and must not have a later operation.
        """
        if self._operation.code.shares_by_marks:
            return self(*inputs, times=times)
        shapes = tuple([x.shape for x in inputs])
        if self._prepared is not None and shapes == self._shapes:
            for own, x in zip(self._prepared.inputs, inputs, strict=True):
                own[...] = x
            return self._prepared()
        code, results = select_code(inputs, self._operation), self._operation.shapes(inputs, times)
        if results[0][0] <= QUICK_MEMBERS and code.is_quick(inputs):
            return code(inputs, results)
        self._prepared, self._shapes = code.prepare([np.array(x, float) for x in inputs], results), shapes
        return self._prepared()
