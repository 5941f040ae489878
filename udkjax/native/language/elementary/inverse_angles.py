"""Inverse trigonometric functions.

atan a = atan b + atan((a - b) / (1 + a b)) for the nearest b of 0, 1/2, 1; asin x = pi / 2 - 2 asin(sqrt((1 - x) / 2)) above
1/2 (the methods of fdlibm). The polynomials interpolate at Chebyshev nodes; constants are sums of two doubles.
"""

from udkjax.native.language.elementary.parts import INFINITY, bits, copy_sign, polynomial, rounded, upper_half
from udkjax.native.language.ir import Function, Value

# (x - atan x) / x^3 as a function of x^2 for |x| <= 7/16, error 2^-53
ATAN = (
    0.33333333333333326, -0.19999999999987655, 0.14285714283127662, -0.11111110899049664, 0.0909090014058555,
    -0.07692086204975024, 0.06663224869084483, -0.05847612444521365, 0.050334165154982353, -0.0378116004846169,
    0.017532295994972764,
)  # fmt: skip
# (asin x - x) / x^3 as a function of x^2 for |x| <= 1/2, error 2^-55
ASIN = (
    0.16666666666666669, 0.07499999999998433, 0.04464285714635543, 0.030381944138531247, 0.02237217294214989,
    0.017352392720869973, 0.013971212973552933, 0.011479177415184906, 0.01032281435018578, 0.005457506718640358,
    0.01740087944269402, -0.014851887071247204, 0.028757851367421566,
)  # fmt: skip
ATAN_HALF = (0.4636476090008061, 2.2698777452961687e-17)
PI = (3.141592653589793, 1.2246467991473532e-16)
HALF_PI = (PI[0] / 2, PI[1] / 2)
QUARTER_PI = (PI[0] / 4, PI[1] / 4)
FIRST_EDGE, SECOND_EDGE = 7.0 / 16.0, 11.0 / 16.0
LARGE_ARGUMENT = 2.0**70  # the arctangent of larger numbers rounds to pi / 2


def _arc(f: Function, numerator: Value, denominator: Value) -> tuple[Value, Value]:
    """Return atan(numerator / denominator) as a sum of two doubles, for 0 <= numerator <= denominator."""
    middle, above = numerator >= rounded(denominator * FIRST_EDGE), numerator >= rounded(denominator * SECOND_EDGE)
    factor = f.select(above, 1.0, f.select(middle, 0.5, 0.0))
    top = f.fma(factor, -denominator, numerator)
    bottom = f.fma(factor, numerator, denominator)
    inverse = 1.0 / bottom
    t = rounded(top * inverse)
    error = rounded(f.fma(-t, bottom, top) * inverse)
    z = rounded(t * t)
    low = f.fma(rounded(z * t), -polynomial(z, ATAN), error)
    start = [f.select(above, QUARTER_PI[k], f.select(middle, ATAN_HALF[k], 0.0)) for k in range(2)]
    high = start[0] + t
    return high, t - (high - start[0]) + (low + start[1])


def _less(f: Function, mask: Value, constant: tuple[float, float], high: Value, low: Value) -> tuple[Value, Value]:
    """Return constant - (high + low) where `mask` holds, and high + low elsewhere, as a sum of two doubles."""
    new = constant[0] - high
    rest = constant[0] - new - high + (constant[1] - low)
    return f.select(mask, new, high), f.select(mask, rest, low)


def atan(f: Function, x: Value) -> Value:
    """Return the arctangent."""
    size = f.abs(x)
    steep = size > 1.0
    bounded = f.select(size > LARGE_ARGUMENT, LARGE_ARGUMENT, size)
    parts = _arc(f, f.select(steep, 1.0, bounded), f.select(steep, bounded, 1.0))
    high, low = _less(f, steep, HALF_PI, *parts)
    return copy_sign(high + low, x)


def atan2(f: Function, y: Value, x: Value) -> Value:
    """Return the angle of (x, y), also for zeros and infinities of either sign."""
    width, height = f.abs(x), f.abs(y)
    steep = height > width
    small, large = f.select(steep, width, height), f.select(steep, height, width)
    infinite = large.is_(INFINITY)
    unit = f.select(large > 2.0**900, 2.0**-60, f.select(small < 2.0**-900, 2.0**100, 1.0))
    numerator = f.select(infinite, f.select(small.is_(INFINITY), 1.0, 0.0), rounded(small * unit))
    denominator = f.select(infinite | large.is_(0.0), 1.0, rounded(large * unit))
    high, low = _less(f, steep, HALF_PI, *_arc(f, numerator, denominator))
    high, low = _less(f, bits(x) < 0, PI, high, low)
    result = copy_sign(high + low, y)
    return f.select(x.is_not(x) | y.is_not(y), x + y, result)


class _Arcsine:
    """The common parts of arcsine and arccosine.

    With s^2 = (1 - |x|) / 2 for |x| >= 1/2 (`is_large`), else s = |x|, `ratio` is (asin s - s) / s. For large |x|, high + low is
    asin s as a sum of two doubles, where `high` has 26 digits.
    """

    def __init__(self, f: Function, x: Value):
        size = f.abs(x)
        self.is_large = size >= 0.5
        z = f.select(self.is_large, rounded((1.0 - size) * 0.5), rounded(size * size))
        self.ratio = rounded(z * polynomial(z, ASIN))
        s = f.intrinsic("sqrt", z)
        self.high = upper_half(s)
        low = f.fma(-self.high, self.high, z) / (s + self.high + 2.0**-1000)  # not zero
        self.low = f.fma(s, self.ratio, low)


def asin(f: Function, x: Value) -> Value:
    """Return the arcsine; NaN for |x| > 1."""
    a = _Arcsine(f, x)
    large = QUARTER_PI[0] - (rounded(a.low * 2.0) - HALF_PI[1] - (QUARTER_PI[0] - rounded(a.high * 2.0)))
    return f.select(a.is_large, copy_sign(large, x), f.fma(x, a.ratio, x))


def acos(f: Function, x: Value) -> Value:
    """Return the arccosine; NaN for |x| > 1."""
    a = _Arcsine(f, x)
    half = a.high + a.low
    small = HALF_PI[0] - (x - (HALF_PI[1] - rounded(x * a.ratio)))
    near_minus_one = HALF_PI[0] - a.high - (a.low - HALF_PI[1])
    return f.select(a.is_large, f.select(x < 0.0, near_minus_one, half) * 2.0, small)
