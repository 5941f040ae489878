"""A value and its tangent, computed by one program wherever no further transformation applies.

JAX splits a derivative into parts: the value with its residuals, then linear maps of tangents, which `linearize` stores and a
batch of tangents shares. If both run together in any case, one program that computes both need not store the residuals.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jax.extend.core import Literal, Primitive, new_jaxpr_eqn, no_effects, set_current_trace
from jax.interpreters import ad, batching, mlir, partial_eval
from jaxtyping import Array, PyTree

from udkjax.programs.numpy_program import expand_as
from udkjax.programs.varying_axes import result_type

OutputShapes = tuple[list[jax.ShapeDtypeStruct], list[jax.ShapeDtypeStruct]]  # of a value and of its tangent
SplitFunction = Callable[..., tuple[list[Array], list[Array]]]  # (at, direction) -> value, tangent: lists of arrays


def split_jvp(
    seen: SplitFunction, run: SplitFunction, at: PyTree, direction: PyTree, shapes: OutputShapes
) -> tuple[list[Array], list[Array]]:
    """Return the value at `at` and its derivative along `direction`, trees of arrays, by `run`; JAX transforms `seen` instead.

    Both are mapped over any batch. `shapes` are the shapes of the value and of the derivative.
    """
    direction = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, direction)  # a tangent may be 1.0
    (place, way), static = eqx.partition((at, direction), eqx.is_array)
    (start, places), (ways, form) = jax.tree.flatten(place), jax.tree.flatten(way)

    def flat(parts: SplitFunction) -> Callable[..., list[Array]]:
        def function(*xs: Array) -> list[Array]:
            given = places.unflatten(xs[: len(start)]), form.unflatten(xs[len(start) :])
            return [x for found in parts(*eqx.combine(given, static)) for x in found]

        return function

    both = SplitForms(flat(seen), flat(run), len(start), [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in ways], shapes)
    found = along_p.bind(*start, *ways, both=both)
    return list(found[: both.values]), list(found[both.values :])


class SplitForms:
    """The forms `seen` and `run` as functions of arrays: `start` arrays of the point, then the direction, of shapes `ways`."""

    def __init__(
        self,
        seen: Callable[..., list[Array]],
        run: Callable[..., list[Array]],
        start: int,
        ways: Sequence[jax.ShapeDtypeStruct],
        shapes: OutputShapes,
    ):
        self.seen, self.run, self.start, self.ways, self.shapes = seen, run, start, ways, shapes
        self.values = len(shapes[0])

    def mapped(self, axes: Sequence[int | None], size: int) -> "SplitForms":
        """Return both forms for a batch."""
        seen, run = (jax.vmap(f, in_axes=tuple(axes), axis_size=size) for f in (self.seen, self.run))
        value, change = ([jax.ShapeDtypeStruct((size, *x.shape), x.dtype) for x in part] for part in self.shapes)
        ways = [
            x if axis is None else jax.ShapeDtypeStruct((*x.shape[:axis], size, *x.shape[axis:]), x.dtype)
            for x, axis in zip(self.ways, axes[self.start :], strict=True)
        ]
        return SplitForms(seen, run, self.start, ways, (value, change))


def _avals(*xs: Array, both: SplitForms) -> list[jax.core.ShapedArray]:
    return [result_type(x.shape, xs, x.dtype) for part in both.shapes for x in part]


def _batched(xs: Sequence[Array], axes: Sequence[int | None], both: SplitForms) -> tuple[list[Array], list[int | None]]:
    size = next(x.shape[axis] for x, axis in zip(xs, axes, strict=True) if axis is not None)
    found = along_p.bind(*xs, both=both.mapped(axes, size))
    if any(axis is not None for axis in axes[: both.start]):
        return found, [0] * len(found)
    value, change = found[: both.values], found[both.values :]
    return [*(x[0] for x in value), *change], [*[None] * len(value), *[0] * len(change)]


def _derivative(
    primals: Sequence[Array], tangents: Sequence[Array], both: SplitForms
) -> tuple[list[Array], list[Array | ad.Zero]]:
    return _jvp(both.seen, primals, tangents)


def _jvp(
    run: Callable[..., list[Array]], primals: Sequence[Array], tangents: Sequence[Array]
) -> tuple[list[Array], list[Array | ad.Zero]]:
    moving = [not isinstance(dx, ad.Zero) for dx in tangents]

    def function(*some: Array) -> list[Array]:
        rest = iter(some)
        return run(*[next(rest) if m else x for x, m in zip(primals, moving, strict=True)])

    some, changes = ([x for x, m in zip(xs, moving, strict=True) if m] for xs in (primals, tangents))
    found, slopes = jax.jvp(function, some, changes)
    none = [dx.dtype == jax.dtypes.float0 for dx in slopes]
    return found, [ad.Zero(jax.typeof(x).to_tangent_aval()) if n else dx for x, dx, n in zip(found, slopes, none, strict=True)]


def _part(trace: Any, *xs: Array, both: SplitForms) -> list[Array]:
    with set_current_trace(trace):
        return both.seen(*xs)


def _checkpointed(saveable: Any, unknown: Sequence[bool], there: Sequence[bool], eqn: Any) -> tuple[Any, ...]:
    """Split under `jax.checkpoint`: if only directions are unknown the value is computed; the backward pass recomputes both."""
    del saveable
    both: SplitForms = eqn.params["both"]
    inputs = [x for x, t in zip(eqn.invars, there, strict=True) if not t and not isinstance(x, Literal)]
    if any(unknown[: both.start]):
        return None, eqn, [True] * len(eqn.outvars), [True] * len(eqn.outvars), inputs
    value = new_jaxpr_eqn(eqn.invars[: both.start], eqn.outvars[: both.values], value_p, {"both": both}, no_effects)
    changes = len(eqn.outvars) - both.values
    return value, eqn, [*[False] * both.values, *[True] * changes], [True] * len(eqn.outvars), inputs


def _value(*xs: Array, both: SplitForms) -> list[Array]:
    return both.seen(*xs, *(jnp.zeros(x.shape, x.dtype) for x in both.ways))[: both.values]


def _value_batched(xs: Sequence[Array], axes: Sequence[int | None], both: SplitForms) -> tuple[list[Array], list[int]]:
    found = jax.vmap(partial(_value, both=both), in_axes=tuple(axes))(*xs)
    return found, [0] * len(found)


value_p = Primitive("value_along_no_direction")
value_p.multiple_results = True
value_p.def_impl(_value)
value_p.def_abstract_eval(lambda *xs, both: _avals(*xs, both=both)[: both.values])
batching.primitive_batchers[value_p] = _value_batched
ad.primitive_jvps[value_p] = lambda xs, dxs, both: _jvp(partial(_value, both=both), xs, dxs)
mlir.register_lowering(value_p, mlir.lower_fun(_value))

along_p = Primitive("along")
along_p.multiple_results = True
along_p.def_impl(lambda *xs, both: both.seen(*xs))
along_p.def_abstract_eval(_avals)
batching.primitive_batchers[along_p] = _batched
ad.primitive_jvps[along_p] = _derivative
partial_eval.custom_partial_eval_rules[along_p] = _part
partial_eval.partial_eval_jaxpr_custom_rules[along_p] = _checkpointed
mlir.register_lowering(along_p, lambda ctx, *values, both: mlir.lower_fun(both.run)(ctx, *values))
expand_as(along_p, lambda both: both.run)
