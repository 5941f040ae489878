"""Functions without an LLVM intrinsic, written with those that have one: inverse hyperbolic ones, cube root, error function.

They are accurate to a few units in the last place, and take no library calls beyond `exp` and `log`.
"""

import math
from collections.abc import Callable

from udkjax.native.base.ir import DOUBLE, INT, Function, Value, llvm_type

TERMS = 18  # of the series of erf below one: the next is less than 1e-17
# exp(z^2) erfc(z) / t with t = c / (c + z) is smooth in t over the whole range, 0 to 1: its Chebyshev series in 2 t - 1.
CENTRE = 3.75
SCALED_ERFC = (
    0.4214058601090404, 0.37747444362832, 0.14160448337558904, 0.04472136419492391, 0.0117959706715608, 0.0025349704447309527,
    0.0004185659812464711, 4.4764300324499895e-05, 5.257805411800891e-07, -8.231924321753128e-07, -1.316512185167472e-07,
    2.5425950577591977e-09, 3.6155375955980613e-09, 2.8881129031517165e-10, -7.744049094712806e-11, -1.4154099941115766e-11,
    1.541532080291853e-12, 5.316760838441818e-13, -3.1266208417670866e-14, -1.931405980218627e-14, 7.681944620990154e-16,
    7.212640982187403e-16, -2.9234747015733566e-17,
)  # fmt: skip
LARGEST = 28.0  # erfc is zero beyond
HUGE = 2.0**500  # the square of a larger number may overflow, and adding one does not change it
MOST_WHOLE = 2.0**53  # numbers beyond are all whole
SIGN = -(2**63)  # the sign bit


def with_sign(f: Function, size: Value, sign: Value) -> Value:
    """Return |size| with the sign of another number, also of a zero."""
    integers = llvm_type(INT, size.width)
    bits, of_sign = (f.op(f"bitcast {x.type} {x.name} to {integers}", INT, x.width) for x in (size, sign))
    both = f.logic("or", f.logic("and", bits, ~SIGN), f.logic("and", of_sign, SIGN))
    return f.op(f"bitcast {integers} {both.name} to {size.type}", DOUBLE, size.width)


def remainder(f: Function, x: Value, y: Value) -> Value:
    """Return x - n y with the whole number n = x / y rounded towards zero; of the sign of x, and smaller than y.

    It is exact if the processor has fused multiply-adds, while n is below 2^53; beyond it is zero.
    """
    ratio = x / y
    n = f.intrinsic("trunc", ratio)
    rest = f.fma(-n, y, x)
    size, turned = f.abs(y), (rest < 0.0) & (x > 0.0) | (rest > 0.0) & (x < 0.0)
    rest = f.abs(rest)
    rest = f.select(turned, size - rest, rest)  # n was one too large, by rounding
    rest = f.select(~turned & (rest >= size), rest - size, rest)
    rest = f.select(f.abs(ratio) < MOST_WHOLE, rest, ratio * 0.0)  # NaN for a ratio that is not finite
    return with_sign(f, f.select(size.is_(math.inf) & f.is_finite(x), x, rest), x)


def asinh(f: Function, x: Value, log1p: Callable[[Function, Value], Value]) -> Value:
    """Return arsinh x = log(|x| + sqrt(x^2 + 1)) with the sign of x, accurate also for small x."""
    a = f.abs(x)
    b = f.select(a > HUGE, 1.0, a)
    square = b * b
    near = log1p(f, b + square / (f.intrinsic("sqrt", square + 1.0) + 1.0))
    return with_sign(f, f.select(a > HUGE, f.intrinsic("log", a) + math.log(2), near), x)


def acosh(f: Function, x: Value, log1p: Callable[[Function, Value], Value]) -> Value:
    """Return arcosh x = log(x + sqrt(x^2 - 1)); NaN below one."""
    is_huge = x > HUGE
    rest = f.select(is_huge, 1.0, x) - 1.0
    near = log1p(f, rest + f.intrinsic("sqrt", rest * (rest + 2.0)))
    return f.select(x < 1.0, math.nan, f.select(is_huge, f.intrinsic("log", x) + math.log(2), near))


def atanh(f: Function, x: Value, log1p: Callable[[Function, Value], Value]) -> Value:
    """Return artanh x = log((1 + x) / (1 - x)) / 2; NaN beyond one."""
    a = f.abs(x)
    size = log1p(f, (a + a) / (1.0 - a)) * 0.5
    return with_sign(f, f.select(a > 1.0, math.nan, f.select(a.is_(1.0), math.inf, size)), x)


def cbrt(f: Function, x: Value) -> Value:
    """Return the real cube root: exp(log|x| / 3) and a step of Newton's method, which removes its rounding error."""
    a = f.abs(x)
    is_plain = (a > 0.0) & f.is_finite(a)
    b = f.select(is_plain, a, 1.0)
    y = f.intrinsic("exp", f.intrinsic("log", b) * (1 / 3))
    y = y - (y - b / (y * y)) * (1 / 3)
    return with_sign(f, f.select(is_plain, y, a), x)


def erf(f: Function, x: Value) -> Value:
    """Return the error function: by its series below one, by `erfc` beyond."""
    square = x * x
    series = f.const(_term(TERMS - 1), DOUBLE, x.width)
    for k in reversed(range(TERMS - 1)):
        series = f.fma(series, square, _term(k))
    a = f.abs(x)
    return f.select(a < 1.0, series * x, with_sign(f, 1.0 - _erfc_of_size(f, a), x))


def erfc(f: Function, x: Value) -> Value:
    """Return 1 - erf x, accurate also where it is small."""
    size = _erfc_of_size(f, f.abs(x))
    return f.select(f.abs(x) < 0.5, 1.0 - erf(f, x), f.select(x < 0.0, 2.0 - size, size))


def _term(k: int) -> float:
    return (-1) ** k * 2 / math.sqrt(math.pi) / (math.factorial(k) * (2 * k + 1))


def _erfc_of_size(f: Function, a: Value) -> Value:
    """Return erfc of a number that is not negative."""
    z = f.select(a > LARGEST, LARGEST, a)  # NaN stays
    square = z * z
    rounded = f.fma(z, z, -square)  # the rounding error of the square, whose exponential would magnify it
    inverse = 1.0 / (z + CENTRE)
    double = (CENTRE - z) * inverse * 2.0
    before, last = f.const(0.0, DOUBLE, z.width), f.const(0.0, DOUBLE, z.width)
    for c in reversed(SCALED_ERFC[1:]):  # Clenshaw
        before, last = last, f.fma(double, last, c - before)
    scaled = f.fma(double * 0.5, last, SCALED_ERFC[0] - before)
    return f.intrinsic("exp", -square) * (1.0 - rounded) * (inverse * CENTRE) * scaled
