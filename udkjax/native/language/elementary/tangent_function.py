"""The tangent.

x = n pi / 2 + r with |r| <= pi / 4 as a sum of two doubles; tan r = r + r^3 / 3 + r^5 P(r^2) up to 0.67, and beyond from
pi / 4 - |r| (the method of fdlibm); -1 / tan r for odd n. P interpolates at Chebyshev nodes. The remainder of a huge number needs
those digits of 2 / pi that its exponent selects (Payne and Hanek); integers compute it.
"""

import math
from itertools import pairwise
from typing import NamedTuple

from udkjax.native.language.elementary.parts import (
    EXPONENT_BIAS,
    FRACTION_BITS,
    FRACTION_MASK,
    INFINITY,
    bits,
    flip_sign,
    mask,
    nearest,
    polynomial,
    rounded,
    shift,
    small_integer,
    upper_half,
)
from udkjax.native.language.ir import BOOL, INT, Function, Value

# (tan x - x - x^3 / 3) / x^5 as a function of x^2 up to 0.675, error 2^-56
TAN = (
    0.13333333333333333, 0.053968253968250855, 0.021869488536536807, 0.008863235511570838, 0.0035921284928138206,
    0.001455827652166713, 0.0005900909812582525, 0.0002387297273808411, 9.861961520829385e-05, 3.4347715640588505e-05,
    2.534862386702702e-05, -4.710062975941994e-06, 9.529056816186938e-06,
)  # fmt: skip
LARGE_ANGLE = 0.67434
QUARTER_PI = (math.pi / 4, 3.061616997868383e-17)
# pi / 2: the first three have 33 digits; their multiples up to 2^20 are exact
HALF_PI = tuple(
    map(float.fromhex, ("0x1.921fb54400000p+0", "0x1.0b4611a600000p-34", "0x1.3198a2e000000p-69", "0x1.b839a252049c1p-104"))
)
FAR_ANGLE = 2.0**20
HALF_PI_HALVES = (1.5707963109016418, 1.5893254773528196e-08)  # pi / 2; the first has 26 digits
# 64 zeros and 1,216 binary digits of 2 / pi
DIGITS_OF_TWO_OVER_PI = (
    0x0000000000000000, 0xA2F9836E4E441529, 0xFC2757D1F534DDC0, 0xDB6295993C439041, 0xFE5163ABDEBBC561, 0xB7246E3A424DD2E0,
    0x06492EEA09D1921C, 0xFE1DEB1CB129A73E, 0xE88235F52EBB4484, 0xE99C7026B45F7E41, 0x3991D639835339F4, 0x9C845F8BBDF9283B,
    0x1FF897FFDE05980F, 0xEF2F118B5A0A6D1F, 0x6D367ECF27CB09B7, 0x4F463F669E5FEA2D, 0x7527BAC7EBE5F17B, 0x3D0739F78A5292EA,
    0x6BFB5FB11F8D5D08, 0x56033046FC7B6BAB,
)  # fmt: skip
WORD_RANGE = 2**64
LOW_HALF = 2**32 - 1


class _Remainder(NamedTuple):
    """The parts of x = n pi / 2 + high + low; only the lowest bit of `n` is correct, and only this bit is used."""

    high: Value
    low: Value
    n: Value


def tan(f: Function, x: Value) -> Value:
    """Return the tangent."""
    size = f.abs(x)
    near = _near_remainder(f, x)
    high, low, n = f.variable(near.high, width=x.width), f.variable(near.low, width=x.width), f.variable(near.n, INT, x.width)
    far = size >= FAR_ANGLE
    with f.if_(f.any_of(far)):
        remainder = _far_remainder(f, f.select(far, x, FAR_ANGLE))
        for variable, part in zip((high, low, n), remainder, strict=True):
            variable.where(far, part)
    result = _tan_of_remainder(f, _Remainder(high.value, low.value, n.value))
    return f.select(size < 2.0**-27, x, f.select(size < INFINITY, result, x - x))


def _tan_of_remainder(f: Function, remainder: _Remainder) -> Value:
    odd = mask(remainder.n, 1).is_not(0)
    sign = remainder.high
    size = f.abs(remainder.high)
    large = size >= LARGE_ANGLE
    rest = QUARTER_PI[0] - size + (QUARTER_PI[1] - flip_sign(remainder.low, sign))
    x, low = f.select(large, rest, remainder.high), f.select(large, 0.0, remainder.low)
    z = rounded(x * x)
    cube = rounded(z * x)
    r = f.fma(cube, 1.0 / 3.0, f.fma(z, f.fma(cube, polynomial(z, TAN), low), low))
    w = x + r
    unit = f.select(odd, -1.0, 1.0)
    quotient = f.select(large, rounded(w * w), -1.0) / f.select(large, w + unit, w)
    of_large = flip_sign(unit - rounded((x - (quotient - r)) * 2.0), sign)
    # -1 / (x + r), with w as a sum of two doubles
    upper, w_upper = upper_half(quotient), upper_half(w)
    error = f.fma(upper, r - (w_upper - x), f.fma(upper, w_upper, 1.0))
    return f.select(large, of_large, f.select(odd, f.fma(quotient, error, upper), w))


def _difference(a: Value, b: Value) -> tuple[Value, Value]:
    """Return a - b, and its rounding error for |a| >= |b|, or for a near b."""
    result = a - b
    return result, a - result - b


def _near_remainder(f: Function, x: Value) -> _Remainder:
    number, n = nearest(f, x, 2.0 / math.pi)
    high, error = _difference(f.fma(number, -HALF_PI[0], x), rounded(number * HALF_PI[1]))
    high, second_error = _difference(high, rounded(number * HALF_PI[2]))
    low = f.fma(number, -HALF_PI[3], error + second_error)
    total = high + low
    return _Remainder(total, high - total + low, n)


def _far_remainder(f: Function, x: Value) -> _Remainder:
    """Return the remainder of x = m 2^e from m times 192 digits of 2 / pi, beginning with the digit of weight 2^(1 - e)."""
    b = bits(x)
    m = f.logic("or", mask(b, FRACTION_MASK), 2**FRACTION_BITS)
    start = mask(shift(b, "lshr", FRACTION_BITS), 2047) - (EXPONENT_BIAS + FRACTION_BITS - 62)
    w = _digits(f, start)
    p2, p1 = m * w[2], m * w[1] + _high_product(m, w[2])
    p0 = m * w[0] + _high_product(m, w[1]) + f.like(_is_below(p1, _high_product(m, w[2])), INT, x.width)
    # the fraction of a quarter turn, high + low / 2^64, from -1/2 to 1/2, as 128 binary digits
    high, low = (
        f.logic("or", shift(p0, "shl", 2), shift(p1, "lshr", 62)),
        f.logic("or", shift(p1, "shl", 2), shift(p2, "lshr", 62)),
    )
    negative = high < 0
    n = shift(p0, "lshr", 62) + f.like(negative, INT, x.width)
    borrow = f.like(low.is_(0), INT, x.width)
    high, low = f.select(negative, f.logic("xor", high, -1) + borrow, high), f.select(negative, 0 - low, low)
    first = small_integer(shift(high, "lshr", 12)) * 2.0**-52
    second_digits = f.logic("or", shift(mask(high, 4095), "shl", 40), shift(low, "lshr", 24))
    second = rounded(small_integer(second_digits) * 2.0**-104)
    first = rounded(first)
    fraction = first + second
    rest = f.fma(small_integer(mask(low, 2**24 - 1)), 2.0**-128, second - (fraction - first))
    upper = upper_half(fraction)
    main = rounded(upper * HALF_PI_HALVES[0])
    tail = f.fma(upper, HALF_PI_HALVES[1], rounded((fraction - upper + rest) * (math.pi / 2)))
    total = main + tail
    sign = f.select(negative, -x, x)
    return _Remainder(flip_sign(total, sign), flip_sign(main - total + tail, sign), n)


def _digits(f: Function, start: Value) -> list[Value]:
    """Return three words of 64 bits from DIGITS_OF_TWO_OVER_PI, beginning at bit `start`."""
    index, offset = shift(start, "lshr", 6), mask(start, 63)
    words = [f.const(0, INT, start.width)] * 4
    for k in range(len(DIGITS_OF_TWO_OVER_PI) - 3):
        words = [f.select(index.is_(k), _signed(DIGITS_OF_TWO_OVER_PI[k + j]), words[j]) for j in range(4)]

    def shifted(a: Value, b: Value) -> Value:
        left = f.op(f"shl {a.type} {a.name}, {offset.name}", INT, a.width)
        half = shift(b, "lshr", 1)
        return f.logic("or", left, f.op(f"lshr {b.type} {half.name}, {(63 - offset).name}", INT, b.width))

    return [shifted(a, b) for a, b in pairwise(words)]


def _signed(word: int) -> int:
    return word - WORD_RANGE if word >= WORD_RANGE // 2 else word


def _high_product(a: Value, b: Value) -> Value:
    """Return the upper 64 bits of a b, for a < 2^63."""
    low_a, high_a, low_b, high_b = mask(a, LOW_HALF), shift(a, "lshr", 32), mask(b, LOW_HALF), shift(b, "lshr", 32)
    middle = high_a * low_b + shift(low_a * low_b, "lshr", 32)
    second = low_a * high_b + mask(middle, LOW_HALF)
    return high_a * high_b + shift(middle, "lshr", 32) + shift(second, "lshr", 32)


def _is_below(a: Value, b: Value) -> Value:
    """Return whether a < b as unsigned integers."""
    return a.f.op(f"icmp ult {a.type} {a.name}, {b.name}", BOOL, a.width)
