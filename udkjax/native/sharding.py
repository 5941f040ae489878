"""Calls of machine code in programs of several devices: each device computes the members that it holds."""

from collections.abc import Callable, Sequence
from typing import Any

from jax.experimental.custom_partitioning import custom_partitioning
from jax.extend.core import Primitive
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array

try:  # JAX tells the rule which devices a program has only if the primitive is in this set, for which there is no public function
    from jax._src.dispatch import prim_requires_devices_during_lowering as _told_devices
except ImportError:
    _told_devices = None


def divide_members(primitive: Primitive) -> None:
    """Make JAX tell the lowering rule of a primitive the devices of the program, which `call_by_members` needs."""
    if _told_devices is not None:
        _told_devices.add(primitive)


def knows_devices(context: Any) -> bool:
    """Return True if the devices of a program are known while it is lowered.

    They are known only if a primitive of the set above is in the program itself; JAX does not look into the lowering rules of
    other primitives, such as that of scales.
    """
    return getattr(context.module_context.axis_context, "device_assignment", ()) is not None


def call_by_members(
    function: Callable[..., Sequence[Array]], inputs: Sequence[Any], shapes: Sequence[tuple[int, ...]]
) -> Sequence[Array]:
    """Return the results of a function, with a rule by which XLA may divide the members among the devices of a program.

    Args:
        function: A function of arrays like `inputs`, for any number of members; the result of a member depends on it alone.
        inputs: Arrays whose first axis is that of the members, or has length one if all members share them.
        shapes: The shapes of the results, (members, ...).
    """
    members = shapes[0][0]
    if members == 1 or _told_devices is None:
        return function(*inputs)

    def lower(mesh: Any, arguments: Any, results: Any) -> tuple[Any, Callable, tuple[Any, ...], tuple[Any, ...]]:
        axes = results[0].sharding.spec[:1]
        given, found = (tuple(_of_members(mesh, x.shape, members, axes) for x in arrays) for arrays in (arguments, results))
        return mesh, lambda *local: tuple(function(*local)), found, given

    def infer(mesh: Any, arguments: Any, results: Any) -> tuple[Any, ...]:  # for programs that do not use Shardy
        of_members = [x.sharding.spec[:1] for x in arguments if x.shape[0] == members and x.sharding is not None]
        axes = next((spec for spec in of_members if spec and spec[0] is not None), ())
        return tuple(_of_members(mesh, x.shape, members, axes) for x in results)

    call = custom_partitioning(lambda *arrays: tuple(function(*arrays)))
    call.def_partition(lower, infer, sharding_rule=_rule([x.shape for x in inputs], shapes, members))
    return call(*inputs)


def _of_members(mesh: Any, shape: Sequence[int], members: int, axes: Sequence[Any]) -> NamedSharding:
    return NamedSharding(mesh, PartitionSpec(*axes) if shape[0] == members else PartitionSpec())


def _rule(inputs: Sequence[Sequence[int]], results: Sequence[Sequence[int]], members: int) -> str:
    """Return a sharding rule for arrays of these shapes, in which all axes have different names, except those of members: m."""
    count = 0

    def factors(shape: Sequence[int]) -> str:
        nonlocal count
        names = []
        for k, size in enumerate(shape):
            count += 1
            names.append("m" if k == 0 and size == members else f"a{count}")
        return " ".join(names)

    return " -> ".join(", ".join(factors(shape) for shape in arrays) for arrays in (inputs, results))
