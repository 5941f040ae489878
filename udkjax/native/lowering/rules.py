"""The rules of JAX's primitives: views and elementwise operations are computed where they are read, all others are stored."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax

from udkjax.native.language.ir import BOOL, DOUBLE, INT, Value
from udkjax.native.language.program import UnsupportedError, apply, sincos
from udkjax.native.lowering.arrays import Array, Index, Lazy, base_of, fit
from udkjax.native.lowering.decompositions import (
    householder_qr,
    jacobi_eigh,
    jacobi_svd,
    sorted_along,
    symmetric,
    tiled,
)
from udkjax.native.lowering.lowering import Lowering, traced
from udkjax.native.lowering.module_calls import call_p, module_call
from udkjax.native.lowering.reductions import argument, cumulative, dot, extreme, reduce_axes
from udkjax.native.lowering.solving import cholesky, linear_solve, lu, triangular_solve
from udkjax.native.lowering.updates import dynamic_update_slice, scatter
from udkjax.native.lowering.varying import counts_of_scan, inlined
from udkjax.native.lowering.views import (
    broadcast,
    concatenate,
    dynamic_slice,
    gather,
    iota,
    pad,
    platform_index,
    reshape,
    reverse,
    split,
    stack,
    take_slice,
    transpose,
    unstack,
)

ELEMENTWISE = frozenset(
    """abs acos add add_any and asin atan atan2 ceil clamp convert_element_type copy cos cosh div eq exp exp2 expm1 floor ge gt
    integer_pow is_finite le log log1p logistic lt max min mul ne neg not or pow rem round rsqrt select_n sign sin sinh sqrt
    square stop_gradient sub tan tanh xor""".split()
)
LoweringRule = Callable[[Lowering, list[Array], dict[str, Any], Any], Array]


def lower(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    """Lower one equation of a jaxpr, whose operands are `inputs`; return its results.

    Raises:
        UnsupportedError: there is no rule for the equation; the message names its operation.
    """
    name, p = equation.primitive.name, equation.params
    inner = inlined(equation)
    if inner is not None:
        return to.part(inner, inputs)
    for v in equation.outvars:
        base_of(v.aval.dtype)
    if name in CONTROL_RULES:
        return CONTROL_RULES[name](to, equation, inputs)
    out = equation.outvars[0].aval
    if name in ELEMENTWISE:
        return [_elementwise(to, name, inputs, p, out)]
    if name not in RULES:
        raise UnsupportedError(f"the operation {name}")
    return [RULES[name](to, inputs, p, out)]


def _elementwise(to: Lowering, name: str, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    f, base = to.f, base_of(out.dtype)
    varies = any(x.varies for x in inputs)
    shared = name in ("sin", "cos")
    operation = "add" if name == "add_any" else name

    def read(index: Index) -> Value:
        # Axes of length one, and single numbers, stand for all elements.
        a = [x.read(f, tuple(0 if n == 1 else i for n, i in zip(x.shape, index, strict=False))) for x in inputs]
        if operation in ("add", "sub", "mul", "div") and base == DOUBLE:
            return fit(f, f.arithmetic(operation, *a), varies)
        return fit(f, apply(f, operation, p, a, partial(sincos, f)), varies)

    if name == "select_n" and (len(inputs) != 3 or inputs[0].base != BOOL):
        raise UnsupportedError("the operation select_n of several")
    return Lazy(out.shape, base, inputs, read, 8 if shared else 1)


RULES: dict[str, LoweringRule] = {
    "broadcast_in_dim": broadcast,
    "transpose": transpose,
    "reshape": reshape,
    "squeeze": reshape,
    "expand_dims": reshape,
    "slice": take_slice,
    "rev": reverse,
    "dynamic_slice": dynamic_slice,
    "gather": gather,
    "concatenate": concatenate,
    "stack": stack,
    "reduce_sum": partial(reduce_axes, {DOUBLE: 0.0, INT: 0}, lambda a, b: a + b),
    "reduce_prod": partial(reduce_axes, {DOUBLE: 1.0, INT: 1}, lambda a, b: a * b),
    "reduce_and": partial(reduce_axes, True, lambda a, b: a & b),
    "reduce_or": partial(reduce_axes, False, lambda a, b: a | b),
    "reduce_max": partial(extreme, "max"),
    "reduce_min": partial(extreme, "min"),
    "argmax": partial(argument, "max"),
    "argmin": partial(argument, "min"),
    "cumsum": partial(cumulative, lambda a, b: a + b),
    "cumprod": partial(cumulative, lambda a, b: a * b),
    "dot_general": dot,
    "pad": pad,
    "iota": iota,
    "platform_index": platform_index,
    "scatter": partial(scatter, False),
    "scatter-add": partial(scatter, True),
    "dynamic_update_slice": dynamic_update_slice,
}


# --- loops, branches, and equations with several results


def _scan(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    p, (a, b) = equation.params, counts_of_scan(equation)
    return to.scan(p["jaxpr"], inputs[:a], inputs[a : a + b], inputs[a + b :], p["length"], p["reverse"])


def _while(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    p = equation.params
    a, b = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    return to.while_(p["cond_jaxpr"], p["body_jaxpr"], inputs[:a], inputs[a:b], inputs[b:])


def _cond(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    return to.cond(inputs[0], equation.params["branches"], inputs[1:])


# --- operations that are lowered as a function in plain JAX


def _plain(function: Callable[..., Any], p: dict[str, Any], to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    avals = [v.aval for v in equation.invars]
    closed = traced(partial(function, **p), [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals])
    return to.closed(closed, [to.stored(x) for x in inputs])


def _matrix(equation: Any, **refused: Any):
    """Raise `UnsupportedError` for batches of matrices, and for options with other values than those given."""
    name, p = equation.primitive.name, equation.params
    if len(equation.invars[0].aval.shape) != 2:
        raise UnsupportedError(f"the operation {name} of batches")
    for option, value in refused.items():
        if p.get(option, value) != value:
            raise UnsupportedError(f"the operation {name} with {option}={p[option]}")


def _qr(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    p = equation.params
    _matrix(equation)
    found = _plain(householder_qr, {"is_full": p["full_matrices"], "pivots": p["pivoting"]}, to, equation, inputs)
    return found if p["pivoting"] else found[:2]


def _svd(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    _matrix(equation, subset_by_index=None)
    found = _plain(jacobi_svd, {"is_full": equation.params["full_matrices"]}, to, equation, inputs)
    return found if equation.params["compute_uv"] else found[:1]


def _eigh(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    _matrix(equation, subset_by_index=None)
    is_lower = equation.params["lower"]
    return _plain(lambda a: jacobi_eigh(symmetric(a, is_lower)), {}, to, equation, inputs)


def _sort(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    p = equation.params
    given = {"axis": p["dimension"], "keys": p["num_keys"]}
    return _plain(lambda *x, **options: sorted_along(x, **options), given, to, equation, inputs)


def _tile(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    return _plain(tiled, {"counts": equation.params["reps"]}, to, equation, inputs)


CONTROL_RULES = {
    "scan": _scan,
    "while": _while,
    "cond": _cond,
    "split": split,
    "unstack": unstack,
    "lu": lu,
    "cholesky": cholesky,
    "triangular_solve": triangular_solve,
    "custom_linear_solve": linear_solve,
    "qr": _qr,
    "svd": _svd,
    "eigh": _eigh,
    "sort": _sort,
    "tile": _tile,
    call_p.name: module_call,
}
