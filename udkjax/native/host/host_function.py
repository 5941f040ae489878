"""Python functions as operations of compiled JAX programs, on float64 arrays whose first axis is the batch.

XLA calls a handler, as for machine code (ffi.py); this handler is a ctypes callback, and the function takes NumPy arrays. The
function must not call JAX: JAX may wait for the thread that runs the function.
"""

import ctypes
import hashlib
import math
import re
import traceback
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from threading import Lock
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array

from udkjax.native.gpu import host_handler
from udkjax.native.host.ffi import (
    API,
    ARGUMENTS,
    BUFFERS,
    COUNT,
    CREATE_ERROR,
    DATA,
    DIMS,
    EXTENSIONS,
    INTERNAL,
    MAJOR,
    METADATA,
    MINOR,
    RANK,
    RESULTS,
    VERSION,
)
from udkjax.programs.deferred import deferred_p, trace_once
from udkjax.programs.numpy_program import Meter, evaluate_as, has_rules, numpy_program
from udkjax.programs.varying_axes import result_type


class HostFunction(Hashable, Protocol):
    """A function of arrays, each (1 or members, ...). Equal functions are registered with XLA once.

    A function may have a `description`, a text that differs from those of other functions and is the same in all processes:
    JAX can then store programs that call the function. It may also have a text `needed_by`: the reason for calling the host, for
    messages.
    """

    def __call__(self, *inputs: Any) -> Sequence[Any]:
        """Return the outputs, all (members, ...)."""
        ...

    def shapes(self, members: int) -> Sequence[tuple[int, ...]]:
        """Return the shapes of the outputs for a number of members."""
        ...


def call_host(function: HostFunction, inputs: Sequence[Any]) -> list[Array]:
    """Return the outputs of a function, which the host evaluates; inputs may be traced, and have members along the first axis."""
    return host_p.bind(*(jnp.asarray(x, float) for x in inputs), function=function)


def call_seldom(function: Callable[..., Any], *given: Any) -> Any:
    """Return function(*given). In a compiled program NumPy evaluates it on the host when it is reached; it has no derivatives.

    For rarely executed parts of programs that would take most of the compile time.

    Args:
        function: a top-level function of trees, traced once for all calls of the same structure.
        given: trees of arrays, which may be traced, and of static values.
    """
    if deferred_p is None or not jax.config.jax_enable_x64:
        return function(*given)
    program, leaves, out = trace_once(function, given)
    if not has_rules(program):  # JAX must not be called from a running program
        return function(*given)
    results = call_host(_TracedFunction(program), [jnp.asarray(x)[None] for x in leaves])
    return out.rebuild([x[0].astype(aval.dtype) for x, aval in zip(results, program.out_avals, strict=True)])


class _TracedFunction:
    """A program of JAX as a `HostFunction`, which NumPy evaluates for one member after another."""

    def __init__(self, program: Any):
        self._program = program

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _TracedFunction) and self._program is other._program

    def __hash__(self) -> int:
        return hash(id(self._program))

    @property
    def description(self) -> str:
        """The text of the program."""
        return str(self._program)

    def __call__(self, *inputs: Any) -> Sequence[Any]:
        members = max(len(x) for x in inputs)
        results = [self._of_member([x[min(k, len(x) - 1)] for x in inputs]) for k in range(members)]
        return [np.stack(x) for x in zip(*results, strict=True)]

    def shapes(self, members: int) -> Sequence[tuple[int, ...]]:
        """Return the shapes of the results for a number of members."""
        return [(members, *aval.shape) for aval in self._program.out_avals]

    def _of_member(self, inputs: Sequence[Any]) -> list[Any]:
        arguments = [np.asarray(x, aval.dtype) for x, aval in zip(inputs, self._program.in_avals, strict=True)]
        with np.errstate(all="ignore"):
            return [np.asarray(x, float) for x in numpy_program(self._program)(Meter(math.inf), arguments)]


def _members(inputs: Sequence[Any]) -> int:
    return max(x.shape[0] for x in inputs)


def _evaluate(*inputs: np.ndarray, function: HostFunction) -> list[np.ndarray]:
    return [np.asarray(x, float) for x in function(*inputs)]


def _abstract_eval(*inputs: Any, function: HostFunction) -> list[Any]:
    return [result_type(shape, inputs) for shape in function.shapes(_members(inputs))]


def _batch(inputs: Sequence[Any], axes: Sequence[int | None], function: HostFunction) -> tuple[list[Array], list[int]]:
    """Call a function for a batch, whose elements become further members; return the results and their batch axes."""
    size = next(x.shape[axis] for x, axis in zip(inputs, axes, strict=True) if axis is not None)
    members = max(x.shape[0] if axis is None else np.delete(x.shape, axis)[0] for x, axis in zip(inputs, axes, strict=True))

    def as_members(x: Any, axis: int | None) -> Any:
        if axis is None and x.shape[0] <= 1:
            return x
        x = x[None] if axis is None else jnp.moveaxis(x, axis, 0)
        return jnp.broadcast_to(x, (size, members, *x.shape[2:])).reshape(size * members, *x.shape[2:])

    results = host_p.bind(*(as_members(x, axis) for x, axis in zip(inputs, axes, strict=True)), function=function)
    return [x.reshape(size, members, *x.shape[1:]) for x in results], [0] * len(results)


def _lower(*inputs: Any, function: HostFunction) -> Sequence[Array]:
    """Lower a call for the CPU: XLA calls the handler of the function."""
    return jax.ffi.ffi_call(_target(function).name, _result_shapes(inputs, function))(*inputs)


def _lower_for_card(*inputs: Any, function: HostFunction) -> Sequence[Array]:
    """Lower a call for NVIDIA's graphics cards: a handler copies the arrays to the host and back (gpu/host_handler.py)."""
    name = host_handler.register(*_target(function))
    return jax.ffi.ffi_call(name, _result_shapes(inputs, function))(*inputs)


def _lower_for_others(*inputs: Any, function: HostFunction) -> Sequence[Array]:
    """Lower a call for all other devices: JAX calls the function."""
    call = lambda *arrays: _evaluate(*map(np.asarray, arrays), function=function)  # noqa: E731
    return jax.pure_callback(call, _result_shapes(inputs, function), *inputs)


def _result_shapes(inputs: Sequence[Any], function: HostFunction) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in function.shapes(_members(inputs))]


class _Target(NamedTuple):
    """A Python function that is registered as an FFI target of XLA."""

    name: str  # unique in this process; functions of equal descriptions have the same name in each, which stored programs call
    handler: int  # its address


@lru_cache(maxsize=256)
def _target(function: HostFunction) -> _Target:
    """Return a function as a target of custom calls; the first call for equal functions registers it with XLA."""

    @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
    def handle(frame: int) -> int | None:
        if extension := _word(frame + EXTENSIONS):  # XLA asks for the version alone
            metadata = _word(extension + METADATA)
            for offset, number in zip((MAJOR, MINOR), VERSION, strict=True):
                ctypes.c_int32.from_address(metadata + offset).value = number
            return None
        try:
            outputs = _buffers(frame + RESULTS)
            for output, x in zip(outputs, function(*_buffers(frame + ARGUMENTS)), strict=True):
                output[...] = x
        except Exception:  # exceptions must not propagate into C
            return _error(_word(frame + API), traceback.format_exc())
        return None

    name = _name(function)
    address = ctypes.cast(handle, ctypes.c_void_p)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")
    _REGISTERED.append(handle)
    _NEEDED_BY[name] = getattr(function, "needed_by", "")
    assert address.value
    return _Target(name, address.value)


def _name(function: HostFunction) -> str:
    """Return a name for a function that is unique in this process, and the same in the next one.

    It is a digest of the function's description, and a counter: JAX finds stored programs by their text, which contains the name.
    """
    text = f"{type(function).__name__} {getattr(function, 'description', '')} {function.shapes(1)}"
    digest = hashlib.sha256(re.sub("0x[0-9a-f]+", "", text).encode()).hexdigest()[:32]  # without addresses of this process
    with _LOCK:
        _EQUALLY_DESCRIBED[digest] += 1
        return f"udkjax_host_{digest}_{_EQUALLY_DESCRIBED[digest]}"


_LOCK, _EQUALLY_DESCRIBED = Lock(), Counter[str]()
_REGISTERED: list[Any] = []  # XLA may call these for as long as the process runs
_NEEDED_BY: dict[str, str] = {}


def needed_by(name: str) -> str:
    """Return the reason why programs call the function of this name in XLA, with the cure, for messages; "" if unknown."""
    return _NEEDED_BY.get(name, "")


def _word(address: int) -> int:
    return ctypes.c_int64.from_address(address).value


def _words(address: int, count: int) -> list[int]:
    return (ctypes.c_int64 * count).from_address(address)[:] if count else []


def _buffers(block: int) -> list[np.ndarray]:
    """Return the arrays in a block of a frame of XLA: of its arguments, or of its results. They share XLA's memory."""
    return [_array(buffer) for buffer in _words(_word(block + BUFFERS), _word(block + COUNT))]


def _array(buffer: int) -> np.ndarray:
    shape = _words(_word(buffer + DIMS), _word(buffer + RANK))
    size = math.prod(shape)
    if not size:
        return np.zeros(shape)
    return np.ndarray(shape, float, (ctypes.c_double * size).from_address(_word(buffer + DATA)))


def _error(api: int, text: str) -> int:
    create = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(_word(api + CREATE_ERROR))
    message = ctypes.create_string_buffer(text.encode())
    arguments = (ctypes.c_int64 * 4)(32, 0, ctypes.addressof(message), INTERNAL)
    return create(ctypes.addressof(arguments))


host_p = Primitive("host_function")
host_p.multiple_results = True
host_p.def_impl(lambda *inputs, function: jax.device_put(_evaluate(*map(np.asarray, inputs), function=function)))
host_p.def_abstract_eval(_abstract_eval)
batching.primitive_batchers[host_p] = _batch
mlir.register_lowering(host_p, mlir.lower_fun(_lower_for_others))
mlir.register_lowering(host_p, mlir.lower_fun(_lower), platform="cpu")
mlir.register_lowering(host_p, mlir.lower_fun(_lower_for_card), platform="cuda")
evaluate_as(host_p, _evaluate)
