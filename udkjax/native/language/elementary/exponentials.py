"""Exponential and hyperbolic functions.

x = n log 2 + r, and e^r = 1 + r + r^2 / 2 + r^3 q(r), where q interpolates at Chebyshev nodes. n log 2 is subtracted as two
doubles, of which the first is exact for all exponents n, with and without fused multiply-add (the method of fdlibm).
"""

import math
from typing import NamedTuple

from udkjax.native.language.elementary.parts import copy_sign, mask, nearest, polynomial, power_of_two, quotient, rounded, shift
from udkjax.native.language.ir import Function, Value

LOG2_PARTS = (float.fromhex("0x1.62e42fee00000p-1"), float.fromhex("0x1.a39ef35793c76p-33"))
LOG2, LOG2_TAIL = math.log(2.0), 2.3190468138462996e-17
# (e^r - 1 - r - r^2 / 2) / r^3 for |r| <= log(2) / 2, error 2^-56
EXP = (
    0.1666666666666667, 0.04166666666666667, 0.008333333333326136, 0.0013888888888883748, 0.00019841269874820627,
    2.4801587325547743e-05, 2.7557255400206422e-06, 2.75572736431103e-07, 2.5105217004720745e-08, 2.0914686968086876e-09,
)  # fmt: skip
LARGEST_ARGUMENT, SMALLEST_ARGUMENT = 710.7, -746.0  # e^x, and sinh x, overflow above; e^x vanishes below
NEGLIGIBLE = 2.0**-54  # below, expm1 x rounds to x


class Reduced(NamedTuple):
    """The parts of e^x = 2^n (1 + high + low): n is in the lowest bits of the integer `n`, and `high` has no rounding error."""

    n: Value
    high: Value
    low: Value

    @property
    def fraction(self) -> Value:
        """The number 2^(-n) e^x, from 0.7 to 1.42."""
        return self.high + self.low + 1.0


def reduce(f: Function, x: Value, low: Value | None = None) -> Reduced:
    """Return the parts of e^(x + low) = 2^n e^r, with n the integer nearest to x / log 2; |low| must be below 2^-20."""
    number, n = nearest(f, x, 1.0 / LOG2)
    high = f.fma(number, -LOG2_PARTS[0], x)
    r = f.fma(number, -LOG2_PARTS[1], high if low is None else high + low)
    low = rounded(number * -LOG2_PARTS[1]) if low is None else f.fma(number, -LOG2_PARTS[1], low)
    return Reduced(n, high, series(r, low))


def series(r: Value, low: Value) -> Value:
    """Return e^r - 1 - r + low."""
    square = rounded(r * r)
    return r.f.fma(rounded(square * r), polynomial(r, EXP), r.f.fma(square, 0.5, low))


def scale(x: Value, n: Value) -> Value:
    """Return x 2^n for |n| <= 1100, rounded once also where the result is subnormal."""
    half = shift(mask(n + 2048, 4095), "lshr", 1)
    return rounded(x * power_of_two(half - 1024)) * power_of_two(n - half + 1024)


def clamp(x: Value, smallest: float, largest: float) -> Value:
    """Return x, or the bound that it exceeds; NaN stays."""
    f = x.f
    x = f.select(x > largest, largest, x)
    return f.select(x < smallest, smallest, x)


def exp(f: Function, x: Value) -> Value:
    """Return e^x."""
    e = reduce(f, clamp(x, SMALLEST_ARGUMENT, LARGEST_ARGUMENT))
    return scale(e.fraction, e.n)


def exp2(f: Function, x: Value) -> Value:
    """Return 2^x."""
    x = clamp(x, -1080.0, 1030.0)
    number, n = nearest(f, x)
    rest = x - number
    high = rounded(rest * LOG2)
    low = f.fma(rest, LOG2, -high)  # zero where multiply-add is not fused
    return scale(high + series(high, f.fma(rest, LOG2_TAIL, low)) + 1.0, n)


def _quarter_expm1(f: Function, x: Value) -> tuple[Value, Value]:
    """Return (e^x - 1) / 4, which does not overflow, as a sum of two doubles, for -40 < x < 710.7."""
    e = reduce(f, x)
    size = power_of_two(e.n - 2)
    whole, part = size - 0.25, rounded(size * e.high)
    total = whole + part
    rest = f.fma(size, e.low, part - (total - whole) + (size - whole - 0.25))
    result = total + rest
    return result, rest - (result - total)


def expm1(f: Function, x: Value) -> Value:
    """Return e^x - 1, accurate also for small x."""
    result = rounded(_quarter_expm1(f, clamp(x, -40.0, LARGEST_ARGUMENT))[0] * 4.0)
    return f.select(f.abs(x) < NEGLIGIBLE, x, result)


def sinh(f: Function, x: Value) -> Value:
    """Return sinh x, with t = e^|x| - 1: t - t^2 / (2 t + 2) for small |x|, (t + t / (t + 1)) / 2 for large."""
    size = f.abs(x)
    quarter, _ = _quarter_expm1(f, f.select(size > LARGEST_ARGUMENT, LARGEST_ARGUMENT, size))
    t = rounded(quarter * 4.0)
    small = size < 1.0
    ratio = rounded(f.select(small, t, 1.0) * quarter) / (t + 1.0)
    result = f.select(small, rounded(quarter * 2.0) - ratio, quarter + ratio) * 2.0
    return f.select(size < NEGLIGIBLE, x, copy_sign(result, x))


def cosh(f: Function, x: Value) -> Value:
    """Return cosh x = E / 2 + 1 / (2 E), with E = e^|x|; E / 4 does not overflow."""
    size = f.abs(x)
    e = reduce(f, f.select(size > LARGEST_ARGUMENT, LARGEST_ARGUMENT, size))
    quarter = rounded(e.fraction * power_of_two(e.n - 2))
    return rounded((quarter + 0.0625 / quarter) * 2.0)


def tanh(f: Function, x: Value) -> Value:
    """Return tanh x, with t = e^(2 |x|) - 1: t / (t + 2) for small |x|, 1 - 2 / (t + 2) for large."""
    size = f.abs(x)
    quarter, quarter_error = _quarter_expm1(f, f.select(size > 30.0, 60.0, size + size))
    t, error = rounded(quarter * 4.0), rounded(quarter_error * 4.0)
    large = size > 0.55
    top, bottom = f.select(large, 2.0, t), t + 2.0
    bottom_error = t - (bottom - 2.0) + error
    ratio, ratio_error = quotient(f, (top, f.select(large, 0.0, error)), (bottom, bottom_error))
    result = f.select(large, 1.0 - ratio - ratio_error, ratio + ratio_error)
    return f.select(size < NEGLIGIBLE, x, copy_sign(result, x))
