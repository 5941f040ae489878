"""The results of a program as one vector, in the form that the compiler makes one kernel of."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

# Before, XLA ignores optimization barriers on the CPU: of scalars that are stacked it makes one kernel for each, with everything
# before it computed anew, and each kernel costs 100 to 150 ns to start.
BARRIERS_HOLD = (0, 11)


def vector(values: Sequence[Any]) -> Any:
    """Return scalars (or vectors over a batch) side by side along a new first axis."""
    dtype = jnp.result_type(float)
    values = [x if isinstance(x, jax.Array) and x.dtype == dtype else jnp.asarray(x, dtype) for x in values]
    if not values:
        return jnp.zeros(0)
    if jax.__version_info__ < BARRIERS_HOLD and all(x.ndim == 0 for x in values):
        return in_one_kernel(values)
    return jnp.stack(values)


def in_one_kernel(scalars: Sequence[Any]) -> Any:
    """As `jnp.stack` of scalars, on the CPU by a selection for each element: one loop, out of which the scalars are hoisted.

    Of batches, which fill loops of their own, it is `jnp.stack`, and on other devices too.
    """
    return in_one_kernel_p.bind(*scalars)


def _selected(*scalars: Any) -> Any:
    place = jax.lax.iota(jnp.int32, len(scalars))
    found = jnp.zeros(len(scalars), scalars[0].dtype)
    for k, x in enumerate(scalars):
        found = jnp.where(place == k, x, found)
    return found


def _stacked(*scalars: Any) -> Any:
    return jnp.stack(scalars)


def _batched(scalars: Sequence[Any], axes: Sequence[int | None]) -> tuple[Any, int]:
    (size,) = {x.shape[axis] for x, axis in zip(scalars, axes, strict=True) if axis is not None}
    return jnp.stack([jnp.broadcast_to(x, (size,)) for x in scalars], 1), 0


in_one_kernel_p = Primitive("in_one_kernel")
in_one_kernel_p.def_impl(jax.jit(in_one_kernel_p.bind))
in_one_kernel_p.def_abstract_eval(lambda *xs: ShapedArray((len(xs),), xs[0].dtype))
batching.primitive_batchers[in_one_kernel_p] = _batched
ad.deflinear2(in_one_kernel_p, lambda ct, *xs: [ct[k] for k in range(len(xs))])
mlir.register_lowering(in_one_kernel_p, mlir.lower_fun(_stacked, multiple_results=False))
mlir.register_lowering(in_one_kernel_p, mlir.lower_fun(_selected, multiple_results=False), platform="cpu")
