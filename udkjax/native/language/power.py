"""Powers of numbers in lanes, without library calls and to some nine digits, which suffice for the choice of step sizes."""

import math

from udkjax.native.language.elementary.parts import (
    BITS_OF_ONE,
    EXPONENT_BIAS,
    FRACTION_BITS,
    FRACTION_MASK,
    ROUNDING_SHIFT,
    bits,
    from_bits,
    mask,
    power_of_two,
    shift,
    small_integer,
)
from udkjax.native.language.ir import DOUBLE, Function, Value

SERIES_TERMS = 10  # terms of both series, for a relative error below 1e-9


def power(f: Function, x: Value, exponent: float, whole: bool = False) -> Value:
    """Return x^exponent for positive x; `whole` is true if the exponent is an integer."""
    if whole:
        return _whole(f, x, int(exponent))
    return _exp2(f, _log2(f, x) * exponent)


def _whole(f: Function, x: Value, n: int) -> Value:
    result = None
    while n:
        if n % 2:
            result = x if result is None else result * x
        x, n = x * x, n // 2
    return f.const(1.0, DOUBLE, x.width) if result is None else result


def _log2(f: Function, x: Value) -> Value:
    """Return log2 x: with m in [1, 2) the fraction of x, log m = log sqrt(2) + 2 artanh((m - sqrt 2) / (m + sqrt 2))."""
    b = bits(x)
    exponent = shift(b, "lshr", FRACTION_BITS)
    m = from_bits(f.logic("or", mask(b, FRACTION_MASK), BITS_OF_ONE))
    z = (m - math.sqrt(2)) / (m + math.sqrt(2))
    y, total = z * z, f.const(1.0 / (2 * SERIES_TERMS - 1), DOUBLE, x.width)
    for k in reversed(range(SERIES_TERMS - 1)):
        total = f.fma(total, y, 1.0 / (2 * k + 1))
    return small_integer(exponent) - EXPONENT_BIAS + f.fma(z * (2 / math.log(2)), total, 0.5)


def _exp2(f: Function, x: Value) -> Value:
    """Return 2^x by the integer part of x and a series for the rest; |x| must be far below the largest exponent."""
    shifted = Value(f, x.name, DOUBLE, x.width) + ROUNDING_SHIFT  # a product is rounded here, but not in the difference
    z = (x - (shifted - ROUNDING_SHIFT)) * math.log(2)
    total = f.const(1.0 / math.factorial(SERIES_TERMS), DOUBLE, x.width)
    for k in reversed(range(SERIES_TERMS)):
        total = f.fma(total, z, 1.0 / math.factorial(k))
    return total * power_of_two(bits(shifted))
