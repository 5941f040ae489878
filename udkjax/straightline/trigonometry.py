"""Sine and cosine of one angle together, by arithmetic alone.

On the CPU, XLA asks the C library for each double-precision sine and cosine, one element after the other. Here x is reduced by
n = round(2 x / pi) to r = x - n pi/2, with pi/2 in four parts of which the products with n are exact (Cody and Waite), and the
sine and cosine of r are the polynomials of fdlibm (Sun Microsystems 1993, k_sin.c and k_cos.c): compiled, it takes the width that
the processor has. No step relies on a multiplication and an addition being rounded apart or together, so that it does no harm
where a compiler contracts them.

Accurate to 2 ulp for |x| < 1e6. Beyond, to the ulps of x, which is as well as the angle itself is known: the pair stays one of
sine and cosine for angles of any size. Single precision, and devices other than the CPU, take what XLA has.
"""

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from udkjax.straightline.barrier import cut

# pi/2 in three parts of 33 bits, whose products with integers below 2^20 are exact, and a rest: fdlibm, e_rem_pio2.c.
_PARTS = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624871116645580e-21, 8.47842766036889956997e-32)
_SHIFT = 1.5 * 2.0**52  # the last bits of its sum with an integer are those of the integer
# (sin r - r) / r^3 and (cos r - 1 + r^2 / 2) / r^4 in powers of r^2, highest first, for |r| <= pi/4.
_SINE = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
_COSINE = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)


def sincos(x: Any) -> tuple[Any, Any]:
    """Return sin x and cos x, elementwise; x in rad. Differentiable to any order: the derivatives are the pair itself."""
    s, c = sincos_p.bind(jnp.asarray(x, jnp.result_type(x, float)))
    return s, c


def sincos_of_each(xs: Sequence[Any]) -> list[tuple[Any, Any]]:
    """As `sincos` of several angles of one shape and type: they are taken side by side, as one vector."""
    found = sincos_p.bind(*xs) if xs else []
    return list(zip(found[::2], found[1::2], strict=True))


def sincos_of_one(x: Any) -> tuple[Any, Any]:
    """As `sincos` on the CPU, of a number, where XLA repeats nothing."""
    if x.dtype != jnp.float64:
        return jax.lax.sin(x), jax.lax.cos(x)
    k, r = _reduced(x)
    return _turned(k, *_near_zero(r))


def _by_polynomials(x: Any) -> tuple[Any, Any]:
    # Without the barriers XLA would compute what both results share once for each of them, and both for each of their uses.
    k, r = cut(_reduced(x))
    s, c = cut(_near_zero(r))
    s, c = cut(_turned(k, s, c))
    return s, c


def _reduced(x: Any) -> tuple[Any, Any]:
    """An integer with the last bits of n, and x - n pi/2."""
    a, b, c, d = _PARTS
    n = jax.lax.round(x * (2 / math.pi), jax.lax.RoundingMethod.TO_NEAREST_EVEN)
    rest = x - n * a
    high = rest - n * b
    low = (rest - high) - n * b  # what rounding took from it
    r = (high + (low - n * c)) - n * d
    r = jnp.minimum(jnp.maximum(r, -1.0), 1.0)  # from 1e16 on n is not exact: where r means nothing, keep a cosine a cosine
    return jax.lax.bitcast_convert_type(n + _SHIFT, jnp.int64), r


def _near_zero(r: Any) -> tuple[Any, Any]:
    z = r * r
    s, c = (reduce(lambda value, k: value * z + k, p[1:], jnp.full_like(z, p[0])) for p in (_SINE, _COSINE))
    return r + r * (z * s), (1.0 - 0.5 * z) + z * z * c


def _turned(k: Any, s: Any, c: Any) -> tuple[Any, Any]:
    """Turn by k right angles."""
    odd = (k & 1) != 0
    s, c = jax.lax.select(odd, c, s), jax.lax.select(odd, s, c)
    return _negative_where(k, s), _negative_where(k + 1, c)


def _negative_where(k: Any, x: Any) -> Any:
    """-x where the last bit but one of k is set."""
    return jax.lax.bitcast_convert_type(jax.lax.bitcast_convert_type(x, jnp.int64) ^ ((k & 2) << 62), x.dtype)


# A primitive, of angles to their sines and cosines in turn, so that each platform gets its own form of it.
sincos_p = Primitive("sincos")
sincos_p.multiple_results = True
sincos_p.def_impl(jax.jit(sincos_p.bind))
sincos_p.def_abstract_eval(lambda *xs: [x for x in xs for _ in range(2)])


def _batched(xs: Sequence[Any], axes: Sequence[int | None]) -> tuple[list[Any], list[int | None]]:
    """Angles that differ from member to member together, and those that do not."""
    found: list[Any] = [None] * (2 * len(xs))
    xs = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(xs, axes, strict=True)]
    for batched in (True, False):
        some = [k for k, axis in enumerate(axes) if (axis is not None) == batched]
        for k, pair in zip(some, sincos_of_each([xs[k] for k in some]), strict=True):
            found[2 * k : 2 * k + 2] = pair
    return found, [None if axis is None else 0 for axis in axes for _ in range(2)]


def _derivative(primals: Sequence[Any], tangents: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    found = sincos_of_each(primals)
    slopes = [(dx, dx) if isinstance(dx, ad.Zero) else (c * dx, -(s * dx)) for (s, c), dx in zip(found, tangents, strict=True)]
    return [x for pair in found for x in pair], [x for pair in slopes for x in pair]


batching.primitive_batchers[sincos_p] = _batched
ad.primitive_jvps[sincos_p] = _derivative


# jitted: all pairs of one shape are calls of one function
@jax.jit
def _sincos_of_the_library(x: Any) -> tuple[Any, Any]:
    return jnp.sin(x), jnp.cos(x)


@jax.jit
def _sincos_on_cpu(x: Any) -> tuple[Any, Any]:
    return _by_polynomials(x) if x.dtype == jnp.float64 else _sincos_of_the_library(x)


def _one_by_one(*xs: Any) -> list[Any]:
    return [value for x in xs for value in _sincos_of_the_library(x)]


def _side_by_side(*xs: Any) -> list[Any]:
    if len(xs) == 1:
        return list(_sincos_on_cpu(xs[0]))
    s, c = _sincos_on_cpu(jax.lax.concatenate([jax.lax.expand_dims(x, (0,)) for x in xs], 0))
    return [jax.lax.index_in_dim(values, k, keepdims=False) for k in range(len(xs)) for values in (s, c)]


mlir.register_lowering(sincos_p, mlir.lower_fun(_one_by_one, multiple_results=True))
mlir.register_lowering(sincos_p, mlir.lower_fun(_side_by_side, multiple_results=True), platform="cpu")
