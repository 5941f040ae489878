"""Types of values that vary over the devices of `jax.shard_map`, for results and inputs of primitives."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray, Tracer
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array


def result_type(shape: Sequence[int], inputs: Sequence[Any], dtype: Any = float) -> ShapedArray:
    """Return the type of a primitive's result, which varies over the same devices as its inputs."""
    dtype = jnp.result_type(dtype)
    varying = max(inputs, key=_axis_count, default=None)
    if varying is None or not _axis_count(varying):
        return ShapedArray(shape, dtype)
    sharding = NamedSharding(varying.sharding.mesh, PartitionSpec(*[None] * len(shape)))
    return varying.update(shape=tuple(shape), dtype=dtype, weak_type=False, sharding=sharding)


def vary_together(xs: Sequence[Array]) -> list[Array]:
    """Return arrays of the same values that vary over all devices over which any of them varies.

    The transpose sums cotangents over these devices.
    """
    if not any(map(varies, xs)):
        return list(xs)
    zero = sum(zero_of(x) for x in xs)
    return [x + zero for x in xs]


def varies(x: Any) -> bool:
    """Return True for a traced array that varies over devices, within `jax.shard_map`."""
    return isinstance(x, Tracer) and _axis_count(jax.typeof(x)) > 0


def zero_of(x: Array) -> Array | float:
    """Return a zero that varies over devices and is batched, also by outer `vmap`s, like x; XLA removes the computation."""
    if jnp.size(x) == 0:
        return 0.0
    first = jnp.ravel(x)[0]
    return jax.lax.select(first == first, jnp.zeros_like(first), jnp.zeros_like(first))


def _axis_count(type_: Any) -> int:
    manual = getattr(type_, "manual_axis_type", None)
    return len(manual.varying) if manual is not None else 0
