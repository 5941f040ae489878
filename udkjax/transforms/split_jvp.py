"""A value and its tangent, computed by one program wherever no further transformation applies.

JAX splits a derivative into parts: the value with its residuals, then linear maps of tangents, which `linearize` stores and a
batch of tangents shares. If both are needed together, one program that computes both need not store the residuals.
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

OutputShapes = tuple[list[jax.ShapeDtypeStruct], list[jax.ShapeDtypeStruct]]  # shapes of a value and of its tangent
SplitFunction = Callable[..., tuple[list[Array], list[Array]]]  # (point, direction) -> value, tangent: lists of arrays


def split_jvp(
    seen: SplitFunction, run: SplitFunction, point: PyTree, direction: PyTree, shapes: OutputShapes
) -> tuple[list[Array], list[Array]]:
    """Return the value of a function at a point and its derivative along a direction.

    Args:
        seen: (point, direction) -> (value, derivative), which JAX differentiates and linearizes.
        run: A function with the same results, which compiled programs execute wherever no derivative of `seen` is taken. A batch
            maps both functions.
        point: A tree of arrays.
        direction: A tangent of the point.
        shapes: The shapes of the value and of the derivative.

    Returns:
        The value and the derivative, as lists of arrays.
    """
    direction = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, direction)  # a tangent may be 1.0
    (point_arrays, direction_arrays), static = eqx.partition((point, direction), eqx.is_array)
    (start, point_tree), (changes, direction_tree) = jax.tree.flatten(point_arrays), jax.tree.flatten(direction_arrays)

    def flat(form: SplitFunction) -> Callable[..., list[Array]]:
        def function(*xs: Array) -> list[Array]:
            arguments = point_tree.unflatten(xs[: len(start)]), direction_tree.unflatten(xs[len(start) :])
            return [x for part in form(*eqx.combine(arguments, static)) for x in part]

        return function

    forms = SplitForms(flat(seen), flat(run), len(start), [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in changes], shapes)
    results = along_p.bind(*start, *changes, forms=forms)
    return list(results[: forms.values]), list(results[forms.values :])


class SplitForms:
    """The forms `seen` and `run` as functions of arrays: first `start` arrays of the point, then those of the direction."""

    def __init__(
        self,
        seen: Callable[..., list[Array]],
        run: Callable[..., list[Array]],
        start: int,
        direction_types: Sequence[jax.ShapeDtypeStruct],
        shapes: OutputShapes,
    ):
        self.seen, self.run, self.start, self.direction_types, self.shapes = seen, run, start, direction_types, shapes
        self.values = len(shapes[0])

    def mapped(self, axes: Sequence[int | None], size: int) -> "SplitForms":
        """Return both forms for a batch of `size` members, along the given axes of the arrays."""
        seen, run = (jax.vmap(f, in_axes=tuple(axes), axis_size=size) for f in (self.seen, self.run))
        value, change = ([jax.ShapeDtypeStruct((size, *x.shape), x.dtype) for x in part] for part in self.shapes)
        direction_types = [
            x if axis is None else jax.ShapeDtypeStruct((*x.shape[:axis], size, *x.shape[axis:]), x.dtype)
            for x, axis in zip(self.direction_types, axes[self.start :], strict=True)
        ]
        return SplitForms(seen, run, self.start, direction_types, (value, change))


def _avals(*xs: Array, forms: SplitForms) -> list[jax.core.ShapedArray]:
    return [result_type(x.shape, xs, x.dtype) for part in forms.shapes for x in part]


def _batched(xs: Sequence[Array], axes: Sequence[int | None], forms: SplitForms) -> tuple[list[Array], list[int | None]]:
    size = next(x.shape[axis] for x, axis in zip(xs, axes, strict=True) if axis is not None)
    results = along_p.bind(*xs, forms=forms.mapped(axes, size))
    if any(axis is not None for axis in axes[: forms.start]):
        return results, [0] * len(results)
    value, change = results[: forms.values], results[forms.values :]
    return [*(x[0] for x in value), *change], [*[None] * len(value), *[0] * len(change)]


def _derivative(
    primals: Sequence[Array], tangents: Sequence[Array], forms: SplitForms
) -> tuple[list[Array], list[Array | ad.Zero]]:
    return _jvp(forms.seen, primals, tangents)


def _jvp(
    run: Callable[..., list[Array]], primals: Sequence[Array], tangents: Sequence[Array]
) -> tuple[list[Array], list[Array | ad.Zero]]:
    moving = [not isinstance(dx, ad.Zero) for dx in tangents]

    def function(*moving_primals: Array) -> list[Array]:
        values = iter(moving_primals)
        return run(*[next(values) if m else x for x, m in zip(primals, moving, strict=True)])

    moving_primals, changes = ([x for x, m in zip(xs, moving, strict=True) if m] for xs in (primals, tangents))
    results, slopes = jax.jvp(function, moving_primals, changes)
    has_no_tangent = [dx.dtype == jax.dtypes.float0 for dx in slopes]
    return results, [
        ad.Zero(jax.typeof(x).to_tangent_aval()) if n else dx for x, dx, n in zip(results, slopes, has_no_tangent, strict=True)
    ]


def _part(trace: Any, *xs: Array, forms: SplitForms) -> list[Array]:
    with set_current_trace(trace):
        return forms.seen(*xs)


def _checkpointed(saveable: Any, unknown: Sequence[bool], instantiated: Sequence[bool], eqn: Any) -> tuple[Any, ...]:
    """Rule of `jax.checkpoint`: if only the direction is unknown, the value is computed at once.

    The backward pass computes both the value and the derivative again.
    """
    del saveable
    forms: SplitForms = eqn.params["forms"]
    inputs = [x for x, t in zip(eqn.invars, instantiated, strict=True) if not t and not isinstance(x, Literal)]
    if any(unknown[: forms.start]):
        return None, eqn, [True] * len(eqn.outvars), [True] * len(eqn.outvars), inputs
    value = new_jaxpr_eqn(eqn.invars[: forms.start], eqn.outvars[: forms.values], value_p, {"forms": forms}, no_effects)
    changes = len(eqn.outvars) - forms.values
    return value, eqn, [*[False] * forms.values, *[True] * changes], [True] * len(eqn.outvars), inputs


def _value(*xs: Array, forms: SplitForms) -> list[Array]:
    return forms.seen(*xs, *(jnp.zeros(x.shape, x.dtype) for x in forms.direction_types))[: forms.values]


def _value_batched(xs: Sequence[Array], axes: Sequence[int | None], forms: SplitForms) -> tuple[list[Array], list[int]]:
    results = jax.vmap(partial(_value, forms=forms), in_axes=tuple(axes))(*xs)
    return results, [0] * len(results)


value_p = Primitive("value_along_no_direction")
value_p.multiple_results = True
value_p.def_impl(_value)
value_p.def_abstract_eval(lambda *xs, forms: _avals(*xs, forms=forms)[: forms.values])
batching.primitive_batchers[value_p] = _value_batched
ad.primitive_jvps[value_p] = lambda xs, dxs, forms: _jvp(partial(_value, forms=forms), xs, dxs)
mlir.register_lowering(value_p, mlir.lower_fun(_value))

along_p = Primitive("along")
along_p.multiple_results = True
along_p.def_impl(lambda *xs, forms: forms.seen(*xs))
along_p.def_abstract_eval(_avals)
batching.primitive_batchers[along_p] = _batched
ad.primitive_jvps[along_p] = _derivative
partial_eval.custom_partial_eval_rules[along_p] = _part
partial_eval.partial_eval_jaxpr_custom_rules[along_p] = _checkpointed
mlir.register_lowering(along_p, lambda ctx, *values, forms: mlir.lower_fun(forms.run)(ctx, *values))
expand_as(along_p, lambda forms: forms.run)
