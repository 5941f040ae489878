"""Derivatives of results that may be undefined: NaN, where a run has failed or a mechanism cannot be closed.

Everywhere in the package, in forward and in reverse mode:

    where a value is NaN, so is its tangent;
    a cotangent of such a value that is zero contributes nothing, and any other makes all cotangents NaN.

Therefore `where(ok, x, 0)` has the derivatives of x where x is defined, and zero elsewhere. Without this rule, JAX would treat a
NaN that stands for a failure as a constant, whose tangent is zero, and in reverse mode multiply zero cotangents by infinite
slopes.

Two linear primitives enclose the linear map of a derivative. `enter` passes on the directions and a token, which is zero; `leave`
passes on the results of the map, with NaN where values are undefined. In reverse mode, `leave` comes first and drops the
cotangents of undefined values. The cotangent of the token tells `enter` about them: LOST_COTANGENT if one of them was not zero;
otherwise a number that is zero if no other cotangent is nonzero either. In that case `enter` replaces a NaN that the map makes of
zeros by zero.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from udkjax.programs.numpy_program import expand_as
from udkjax.programs.varying_axes import result_type

# Cotangent of the token if an undefined value is used; otherwise a count, zero if all cotangents are zero.
LOST_COTANGENT = np.nan
Result = TypeVar("Result")
LinearMap = Callable[[list[Array]], Sequence[Array]]


def defined(function: Callable[..., Result]) -> Callable[..., Result]:
    """Return a function of trees of arrays with the rule of this module for its derivatives; it computes the same values.

    The function must depend on no other traced numbers than those of its arguments.
    """

    @functools.wraps(function)
    def run(*args: Any) -> Result:
        leaves, tree = jax.tree.flatten(args)
        places = [k for k, x in enumerate(leaves) if isinstance(x, Tracer)]
        if not places:
            return function(*args)
        form: list[Any] = []

        def of_traced(*xs: Array) -> list[Array]:
            given = list(leaves)
            for k, x in zip(places, xs, strict=True):
                given[k] = x
            # Results that do not depend on traced numbers stay concrete.
            arrays, rest = eqx.partition(function(*jax.tree.unflatten(tree, given)), lambda x: isinstance(x, Tracer))
            results, structure = jax.tree.flatten(arrays)
            form[:] = structure, rest
            return _as_mapped(results, xs)

        results = _with_rule(of_traced)(*(leaves[k] for k in places))
        structure, rest = form
        return eqx.combine(jax.tree.unflatten(structure, results), rest)

    return run


def _as_mapped(results: list[Array], xs: Sequence[Array]) -> list[Array]:
    """Return the results, unchanged in value, but batched by every `vmap` that batches an argument.

    The token makes the tangents of all results batched, and JAX requires the same of the results themselves.
    """
    mapped = [x for x in xs if type(x) in _mapped_types() and x.size]
    if not mapped:
        return results
    is_any = functools.reduce(operator.or_, (jnp.ravel(x)[0] == jnp.ravel(x)[0] for x in mapped))
    return [jax.lax.select(jnp.broadcast_to(is_any, x.shape), x, x) for x in results]


@functools.cache
def _mapped_types() -> tuple[type, ...]:
    """Return the types of tracers that `vmap` uses."""
    types: list[type] = []
    with jax.ensure_compile_time_eval():
        jax.vmap(lambda x: [types.append(type(x)), x][1])(np.zeros(1))
    return tuple(types)


def at_each(function: Callable[..., Result], shared: Any, *members: Any) -> Result:
    """Return the results of function(shared, *members) for all members, which the first axes of arrays in `members` number.

    Derivatives have the rule of this module, for each member separately.
    """
    return jax.vmap(defined(function), (None, *[0] * len(members)))(shared, *members)


def whole(*arrays: Array) -> list[Array]:
    """Return the arrays; if any number of any array is NaN, all numbers of all arrays are NaN.

    A state that is partly undefined thus has no derivatives.
    """
    is_defined = functools.reduce(operator.and_, (jnp.all(~jnp.isnan(x)) for x in arrays))
    return [x + jnp.where(is_defined, 0.0, jnp.nan) for x in arrays]  # cotangents pass, NaN as well


def _with_rule(function: Callable[..., list[Array]]) -> Callable[..., list[Array]]:
    """Return a function of arrays with the rule of this module for its derivatives."""
    call = jax.custom_jvp(function)

    def derivative(xs: Sequence[Array], dxs: Sequence[Any]) -> tuple[list[Array], list[Array]]:
        moves = [not isinstance(dx, SymbolicZero) and getattr(dx, "dtype", None) != jax.dtypes.float0 for dx in dxs]
        moving, changes = ([x for x, m in zip(part, moves, strict=True) if m] for part in (xs, dxs))

        def along(*moved: Array) -> list[Array]:
            following = iter(moved)
            return function(*[next(following) if m else x for x, m in zip(xs, moves, strict=True)])

        if not moving:
            values = function(*xs)
            return values, [_no_tangent(x) for x in values]
        directions, token = _enter(changes, xs)
        values, slopes = jax.jvp(along, moving, directions)
        has_tangent = [dx.dtype != jax.dtypes.float0 for dx in slopes]
        return values, [_leave(dx, token, x) if m else dx for x, dx, m in zip(values, slopes, has_tangent, strict=True)]

    call.defjvp(derivative, symbolic_zeros=True)
    return call


def _no_tangent(x: Array) -> Any:
    dtype = jax.typeof(x).to_tangent_aval().dtype
    return np.zeros(x.shape, dtype) if dtype == jax.dtypes.float0 else jnp.zeros(x.shape, dtype)


def defined_along(linear: LinearMap, directions: Sequence[Array], values: Sequence[Array]) -> list[Array]:
    """Return the results of `linear(directions)`, the tangents of values, with the rule of this module for undefined values.

    There may be more `values` than tangents: those that follow the first ones only determine the batch.
    """
    entered, token = _enter(directions, values)
    return [_leave(dx, token, x) for x, dx in zip(values, linear(entered), strict=False)]


def _enter(directions: Sequence[Array], like: Sequence[Array]) -> tuple[list[Array], Array]:
    """Return the directions, and a token that is batched over all members over which any of the arrays `like` is batched."""
    *entered, token = enter_p.bind(*map(_array, directions), *zero_p.bind(*map(_array, like), members=0))
    return entered, token


def _array(x: Any) -> Array:
    return x if isinstance(x, jax.Array) else jnp.asarray(x)


def _leave(tangent: Array, token: Array, value: Array) -> Array:
    """Return the tangent of a value: NaN where the value is."""
    return leave_p.bind(_array(tangent), token, jax.lax.stop_gradient(jnp.isnan(value)))[0]


# --- the primitives. The first axes of all inputs are those of batches, as many as the token has.


def _enter_by_jax(*xs: Array) -> list[Array]:
    return list(xs)


def _leave_by_jax(tangent: Array, token: Array, undefined: Array) -> list[Array]:
    del token
    return [jnp.where(undefined, jnp.nan, tangent).astype(jnp.result_type(tangent))]


def _enter_transposed(cotangents: Sequence[Any], *xs: Any) -> list[Any]:
    *bars, token = cotangents
    if isinstance(token, ad.Zero):  # no result is used
        return [*bars, None]
    is_lost, is_unused = (jax.lax.stop_gradient(x) for x in (jnp.isnan(token), token == 0))

    def cleared(bar: Array) -> Array:
        is_none = _of_shape(is_unused, bar) & jax.lax.stop_gradient(jnp.isnan(bar))
        bar = jnp.where(is_none, jnp.zeros_like(bar), bar)
        return leave_p.bind(bar, jnp.zeros_like(token), _of_shape(is_lost, bar))[0]

    given = zip(xs, bars, strict=False)
    return [*(cleared(ad.instantiate_zeros(bar)) if ad.is_undefined_primal(x) else None for x, bar in given), None]


def _leave_transposed(cotangents: Sequence[Any], tangent: Any, token: Any, undefined: Array) -> list[Any]:
    (bar,) = cotangents
    if isinstance(bar, ad.Zero):
        return [None] * 3
    remaining, found = jnp.where(undefined, jnp.zeros_like(bar), bar), None
    if ad.is_undefined_primal(token):
        axes = tuple(range(len(token.aval.shape), bar.ndim))
        is_lost, is_used = (jnp.any(x, axis=axes) for x in (undefined & (bar != 0), remaining != 0))
        found = jnp.where(is_lost, LOST_COTANGENT, is_used.astype(token.aval.dtype))
    return [remaining if ad.is_undefined_primal(tangent) else None, found, None]


def _of_shape(x: Array, like: Array) -> Array:
    """Return a number of each member of a batch, repeated to the shape of `like`."""
    return jax.lax.broadcast_in_dim(x, like.shape, tuple(range(jnp.ndim(x))))


def _primitive(name: str, by_jax: Callable[..., list[Array]], transposed: Callable[..., list[Any]]) -> Primitive:
    """Return a new primitive that is linear in all inputs but the last, with its rules for derivatives, batches and lowering.

    Args:
        name: the name of the primitive.
        by_jax: its definition.
        transposed: its transpose: a function of cotangents of results and of the inputs, as JAX calls it in reverse mode.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(by_jax)

    def derivative(xs: Sequence[Array], dxs: Sequence[Any]) -> tuple[list[Array], list[Any]]:
        results = primitive.bind(*xs)
        if all(isinstance(dx, ad.Zero) for dx in dxs[:-1]):
            return results, [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in results]
        return results, primitive.bind(*map(ad.instantiate_zeros, dxs[:-1]), xs[-1])

    def batch(xs: Sequence[Array], axes: Sequence[int | None]) -> tuple[list[Array], list[int]]:
        size = next(x.shape[axis] for x, axis in zip(xs, axes, strict=True) if axis is not None)
        moved = [
            jnp.broadcast_to(x, (size, *jnp.shape(x))) if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(xs, axes, strict=True)
        ]
        results = primitive.bind(*moved)
        return results, [0] * len(results)

    primitive.def_abstract_eval(lambda *xs: [result_type(x.shape, xs, x.dtype) for x in jax.eval_shape(by_jax, *xs)])
    ad.primitive_jvps[primitive] = derivative
    ad.primitive_transposes[primitive] = transposed
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(by_jax))
    expand_as(primitive, lambda: by_jax)
    return primitive


enter_p = _primitive("enter_derivative", _enter_by_jax, _enter_transposed)
leave_p = _primitive("leave_derivative", _leave_by_jax, _leave_transposed)


# --- a zero that is batched as some arrays are, without derivatives


def _zero(*xs: Array, members: int) -> list[Array]:
    return [jnp.zeros(jnp.shape(xs[0])[:members])]


def _zero_of_batch(xs: Sequence[Array], axes: Sequence[int | None], members: int) -> tuple[list[Array], list[int]]:
    batched = [jnp.moveaxis(x, axis, 0) for x, axis in zip(xs, axes, strict=True) if axis is not None]
    return zero_p.bind(*batched, members=members + 1), [0]


def _zero_derivative(xs: Sequence[Array], dxs: Sequence[Any], members: int) -> tuple[list[Array], list[Any]]:
    del dxs
    (zero,) = zero_p.bind(*xs, members=members)
    return [zero], [ad.Zero(jax.typeof(zero).to_tangent_aval())]


zero_p = Primitive("zero_of_members")
zero_p.multiple_results = True
zero_p.def_impl(_zero)
zero_p.def_abstract_eval(lambda *xs, members: [result_type(xs[0].shape[:members], xs)])
ad.primitive_jvps[zero_p] = _zero_derivative
batching.primitive_batchers[zero_p] = _zero_of_batch
mlir.register_lowering(zero_p, mlir.lower_fun(_zero))
expand_as(zero_p, lambda members: partial(_zero, members=members))
