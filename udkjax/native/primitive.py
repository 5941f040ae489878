"""Machine code of operations as a JAX primitive: batches, devices, and the scales of traced mechanisms."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array

from udkjax.equations.programs.scales import scales_p
from udkjax.native import records
from udkjax.native.gpu.launch import kernel_target
from udkjax.native.host import host_program, state_loops
from udkjax.native.loaded_code import QUICK_MEMBERS, call_members, select_code
from udkjax.native.module.layout import INPUTS
from udkjax.native.operations import FindScales, Operation
from udkjax.native.runs import goes_back
from udkjax.native.sharding import call_by_members, divide_members, knows_devices
from udkjax.native.shared_loads import bind_by_rows
from udkjax.native.unsupported import unsupported
from udkjax.programs.numpy_program import evaluate_as
from udkjax.programs.varying_axes import result_type


def _call(*inputs: Any, operation: Operation, times: int) -> list[Array]:
    return jax.device_put(call_members(*map(np.asarray, inputs), operation=operation, times=times))


def _lower_on_cpu(context: Any, *inputs: Any, operation: Operation, times: int) -> Any:
    """Lower the primitive for the CPU: members are divided among the devices of the program if these are known."""
    lowered = partial(_lower, divides=knows_devices(context))
    return mlir.lower_fun(lowered)(context, *inputs, operation=operation, times=times)


def _lower(*inputs: Any, operation: Operation, times: int, divides: bool = False) -> Sequence[Array]:
    """Return the outputs of machine code, called as a target of XLA.

    `divides`: True if members may be divided among the devices of the program.
    """
    if operation.code.shares_by_marks:
        return bind_by_rows(call_members, inputs, operation, times)

    def call(*inputs: Any) -> Sequence[Array]:
        return _call_target(select_code(inputs, operation).name, inputs, operation, times)

    return call_by_members(call, inputs, operation.shapes(inputs, times)) if divides else call(*inputs)


def _lower_for_card(*inputs: Any, operation: Operation, times: int) -> Sequence[Array]:
    """Lower the primitive for an NVIDIA graphics card: large batches run as a kernel; the host computes everything else."""

    def call(inputs: Sequence[Any], operation: Operation) -> Sequence[Array]:
        kernel = kernel_target(operation, inputs)
        if kernel is None:
            return _call_target(select_code(inputs, operation).name_on_card, inputs, operation, times)
        return _call_target(kernel, records.with_longest(inputs, operation), operation, times)

    members = operation.shapes(inputs, times)[0][0]
    if operation.code.shares_by_marks:
        return bind_by_rows(call_members, inputs, operation, times)
    if records.are_stored(inputs, operation, members, on_card=True):
        return call(inputs, operation)
    *outputs, last = call(*records.without_records(inputs, operation))
    return [*outputs, last if goes_back(inputs) else records.absent_records(operation, members)]


def _lower_for_others(*inputs: Any, operation: Operation, times: int) -> Sequence[Array]:
    """Lower the primitive for all other devices: JAX calls the host, which computes."""
    results = _result_shapes(inputs, operation, times)
    call = partial(call_members, operation=operation, times=times)
    return jax.pure_callback(lambda *arrays: call(*map(np.asarray, arrays)), results, *inputs)


def _result_shapes(inputs: Sequence[Any], operation: Operation, times: int) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in operation.shapes(inputs, times)]


def _call_target(name: str, inputs: Sequence[Any], operation: Operation, times: int) -> Sequence[Array]:
    """Return the outputs of the FFI target of XLA with this name."""
    return jax.ffi.ffi_call(name, _result_shapes(inputs, operation, times))(*inputs)


def _abstract_eval(*inputs: Any, operation: Operation, times: int) -> list[Any]:
    return [result_type(shape, inputs) for shape in operation.shapes(inputs, times)]


def _batch(
    inputs: Sequence[Any], axes: Sequence[int | None], operation: Operation, times: int
) -> tuple[list[Any], list[int | None]]:
    """Batching rule: bind a batch as more members, or, if only directions are batched, as more directions.

    Returns:
        The results, and the axis of the batch of each; None if a result has no batch.
    """
    size = next(x.shape[axis] for x, axis in zip(inputs, axes, strict=True) if axis is not None)
    first = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(inputs, axes, strict=True)]
    shared, results = len(inputs) - operation.tangents, operation.results
    if operation.tangents and all(axis is None for axis in axes[:shared]):

        def directions(x: Any, axis: int | None) -> Any:
            xp = np if isinstance(x, np.ndarray) else jnp
            x = xp.broadcast_to(x, (size, *x.shape)) if axis is None else x
            x = xp.moveaxis(x, 0, 1)
            return x.reshape(x.shape[0], x.shape[1] * x.shape[2], *x.shape[3:])

        changed = [directions(x, axis) for x, axis in zip(first[shared:], axes[shared:], strict=True)]
        outputs = native_p.bind(*first[:shared], *changed, operation=operation, times=times)
        changes = [x.reshape(x.shape[0], size, x.shape[1] // size, *x.shape[2:]) for x in outputs[results:]]
        return [*outputs[:results], *changes], [*[None] * results, *[1] * len(changes)]
    members = max(x.shape[0 if axis is None else 1] for x, axis in zip(first, axes, strict=True))
    if not records.are_stored(first, operation, size * members):
        inputs, without = records.without_records(first, operation)
        outputs, batched = _batch(inputs, [None if axis is None else 0 for axis in axes], without, times)
        if not goes_back(inputs):
            outputs[-1], batched[-1] = records.absent_records(operation, members), None
        return outputs, batched

    def as_members(x: Any, axis: int | None) -> Any:
        if axis is None and x.shape[0] <= 1:
            return x
        x = x[None] if axis is None else x
        return jnp.broadcast_to(x, (size, members, *x.shape[2:])).reshape(size * members, *x.shape[2:])

    outputs = native_p.bind(*(as_members(x, axis) for x, axis in zip(first, axes, strict=True)), operation=operation, times=times)
    return [x.reshape(size, members, *x.shape[1:]) for x in outputs], [0] * len(outputs)


native_p = Primitive("native_trajectory")
native_p.multiple_results = True
native_p.def_impl(_call)
native_p.def_abstract_eval(_abstract_eval)
batching.primitive_batchers[native_p] = _batch
divide_members(native_p)
mlir.register_lowering(native_p, mlir.lower_fun(_lower_for_others))
mlir.register_lowering(native_p, _lower_on_cpu, platform="cpu")
mlir.register_lowering(native_p, mlir.lower_fun(_lower_for_card), platform="cuda")
evaluate_as(native_p, call_members)


# --- the scales of traced mechanisms, by the primitive of equations/programs/scales.py


def _scale_inputs(numbers: Any) -> list[Any]:
    empty = np.zeros((1, 0))
    return [numbers.reshape(-1, numbers.shape[-1]), np.zeros((1, 1)), *[empty] * (len(INPUTS) - 2)]


def _find_scales(numbers: Array, programs: Any) -> Array:
    if numbers.dtype != np.float64 or unsupported(programs):
        return scales_p.by_jax(numbers, programs)
    (scales,) = native_p.bind(*_scale_inputs(numbers), operation=FindScales(programs), times=1)
    return scales.reshape(*numbers.shape[:-1], -1)


def _scales_of_batch(numbers: np.ndarray, programs: Any) -> np.ndarray:
    """Return the scales of each vector of `numbers`, outside compiled programs; for few vectors by NumPy, without compilation."""
    if numbers.size <= QUICK_MEMBERS * numbers.shape[-1] or unsupported(programs):
        return scales_p.by_numpy(numbers, programs)
    (scales,) = call_members(*_scale_inputs(np.asarray(numbers, float)), operation=FindScales(programs), times=1)
    return scales.reshape(*numbers.shape[:-1], -1)


for _platform in ("cpu", "cuda"):
    mlir.register_lowering(scales_p, mlir.lower_fun(_find_scales, multiple_results=False), platform=_platform)
scales_p.def_impl(lambda numbers, programs: jax.device_put(_scales_of_batch(np.asarray(numbers), programs)))
evaluate_as(scales_p, _scales_of_batch)

# --- programs that users wait for, by the primitive of programs/deferred.py

host_program.register()

# --- programs of loops that Python runs often, by expressions/loops/compiled_loops.py

state_loops.register()
