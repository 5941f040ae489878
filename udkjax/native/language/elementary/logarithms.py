"""Logarithms and inverse hyperbolic functions.

x = 2^k (1 + f) with 1 + f between sqrt(1/2) and sqrt(2); log(1 + f) = f - f^2 / 2 + s (f^2 / 2 + s^2 R(s^2)) with
s = f / (2 + f) (the method of fdlibm). R interpolates at Chebyshev nodes.
"""

from collections.abc import Callable

from udkjax.native.language.elementary.exponentials import LOG2, LOG2_PARTS
from udkjax.native.language.elementary.parts import (
    INFINITY,
    NAN,
    Normal,
    any_unusual,
    copy_sign,
    polynomial,
    quotient,
    rounded,
    upper_half,
)
from udkjax.native.language.ir import Function, Value

SQRT_HALF = 0x3FE6A09E00000000  # bits of a number slightly below sqrt(1/2)
INVERSE_LOG2 = (1.4426950216293335, 1.9259629911266175e-08)  # 1 / log 2; the first has 26 digits
HUGE, TINY = 2.0**28, 2.0**-28  # up to rounding, asinh x = log(2 x) above, and asinh x = atanh x = x below
# (log((1 + s) / (1 - s)) / s - 2) / s^2 as a function of s^2, error 2^-51
LOG = (
    0.666666666666667, 0.3999999999989889, 0.28571428626253836, 0.22222211089379496, 0.1818289243253687, 0.15331611722055008,
    0.14617807153417325,
)  # fmt: skip


def _log_of_parts(k: Value, f: Value, low: Value | float = 0.0) -> Value:
    """Return k log 2 + log(1 + f) + low."""
    half_square = rounded(f * 0.5 * f)
    tail = _rest(f, half_square, k.f.fma(k, LOG2_PARTS[1], low))
    return k.f.fma(k, LOG2_PARTS[0], f - (half_square - tail))


def _rest(f: Value, half_square: Value, low: Value | float = 0.0) -> Value:
    """Return log(1 + f) - f + f^2 / 2 + low."""
    s = f / (f + 2.0)
    z = rounded(s * s)
    return f.f.fma(s, rounded(z * polynomial(z, LOG)) + half_square, low)


def _with_limits(x: Value, result: Value) -> Value:
    """Return the logarithm of any x, where `result` is the logarithm for positive finite x."""
    f = x.f
    limit = f.select(x.is_(0.0), -INFINITY, f.select(x < 0.0, NAN, x))
    return f.select((x > 0.0) & (x < INFINITY), result, limit)


def log(f: Function, x: Value) -> Value:
    """Return the natural logarithm."""
    return _of_all_numbers(x, lambda k, m: _log_of_parts(k, m - 1.0))


def log2(f: Function, x: Value) -> Value:
    """Return the logarithm to base 2."""

    def of_parts(k: Value, m: Value) -> Value:
        part = m - 1.0
        half_square = rounded(part * 0.5 * part)
        high = upper_half(part - half_square)
        low = part - high - half_square + _rest(part, half_square)
        main = rounded(high * INVERSE_LOG2[0])
        total = k + main
        return total + f.fma(low + high, INVERSE_LOG2[1], f.fma(low, INVERSE_LOG2[0], main - (total - k)))

    return _of_all_numbers(x, of_parts)


def _of_all_numbers(x: Value, of_parts: Callable[[Value, Value], Value]) -> Value:
    """Return a logarithm of x, which `of_parts(k, m)` computes from x = 2^k m.

    If a number in any lane is subnormal, not positive or not finite, all are computed again with subnormal numbers scaled.
    """
    f, result = x.f, x.f.variable(of_parts(*Normal(x).mantissa(SQRT_HALF)), width=x.width)
    with f.if_(any_unusual(x)):
        number = Normal(x)
        number.scale()
        result.value = _with_limits(x, of_parts(*number.mantissa(SQRT_HALF)))
    return result.value


def log1p(f: Function, x: Value) -> Value:
    """Return log(1 + x), accurate also for small x."""
    u = x + 1.0
    result = _log_of_sum(f, u, _error_of_sum(f, u, x), x)
    return f.select(x.is_(0.0), x, _with_limits(u, result))


def _error_of_sum(f: Function, u: Value, x: Value) -> Value:
    """Return 1 + x - u, for u = 1 + x rounded."""
    return f.select(x < 1.0, x - (u - 1.0), 1.0 - (u - x))


def _log_of_sum(f: Function, u: Value, error: Value, x: Value, low: Value | float = 0.0) -> Value:
    """Return log(u + error + low) for normal u; near u = 1, from x = u + error - 1. `low` is negligible in comparison with x."""
    k, m = Normal(u).mantissa(SQRT_HALF)
    near = k.is_(0.0)
    return _log_of_parts(k, f.select(near, x, m - 1.0), (f.select(near, 0.0, error) + low) / u)


def _log_with_double(f: Function, huge: Value, size: Value, t: Value, error: Value) -> Value:
    """Return log(2 size) in the lanes of `huge`, and log(1 + t + error) in others."""
    u = t + 1.0
    sum_error, error = f.select(huge, 0.0, _error_of_sum(f, u, t)), f.select(huge, 0.0, error)
    result = _log_of_sum(f, f.select(huge, size, u), sum_error, t, error)
    return f.select(huge, result + LOG2, result)


def asinh(f: Function, x: Value) -> Value:
    """Return log(1 + t) with t = |x| + x^2 / (1 + sqrt(1 + x^2)), and the sign of x."""
    size = f.abs(x)
    square = rounded(size * size)
    rest = square / (f.intrinsic("sqrt", square + 1.0) + 1.0)
    t = size + rest
    result = _log_with_double(f, size > HUGE, size, t, rest - (t - size))
    return f.select(size < INFINITY, copy_sign(f.select(size < TINY, size, result), x), x)


def acosh(f: Function, x: Value) -> Value:
    """Return log(1 + t) with t = (x - 1) + sqrt(2 (x - 1) + (x - 1)^2)."""
    rest = x - 1.0
    root = f.intrinsic("sqrt", f.fma(rest, rest, rest + rest))
    t = root + rest
    result = _log_with_double(f, x > HUGE, x, t, rest - (t - root))
    return f.select(x >= 1.0, f.select(x < INFINITY, result, x), NAN)


def atanh(f: Function, x: Value) -> Value:
    """Return log(1 + t) / 2 with t = 2 |x| / (1 - |x|), and the sign of x."""
    size = f.abs(x)
    bottom = 1.0 - size
    t, error = quotient(f, (size + size, 0.0), (bottom, 1.0 - bottom - size))
    u = t + 1.0
    result = _with_limits(u, _log_of_sum(f, u, _error_of_sum(f, u, t), t, error))
    return f.select(size < TINY, x, copy_sign(result * 0.5, x))
