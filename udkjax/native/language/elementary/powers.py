"""Powers with any exponent, and cube roots.

|x|^y = 2^(y log2 |x|), with log2 |x| as a sum of two doubles, of which the first has 26 digits: its products with the upper half
of y are exact, with and without fused multiply-add (the method of fdlibm).
"""

from udkjax.native.language.elementary.exponentials import LOG2, scale, series
from udkjax.native.language.elementary.parts import (
    BITS_OF_ONE,
    INFINITY,
    NAN,
    SMALLEST_NORMAL,
    Normal,
    any_unusual,
    bits,
    copy_sign,
    from_bits,
    nearest,
    polynomial,
    rounded,
    shift,
    upper_half,
)
from udkjax.native.language.ir import Function, Value

# log((1 + s) / (1 - s)) = 2 s + 2 s^3 (1 + s^2 L(s^2)) / 3 up to sqrt(3 / 2); error of L 2^-52
LOG = (0.5999999999999999, 0.42857142857213787, 0.33333333252377917, 0.27272761039607346, 0.23070564718152986, 0.2055021192151487)
# Constants as sums of two doubles, of which the first has 26 digits
CP, CP_PARTS = 0.9617966939259756, (0.9617966860532761, 7.872699542894897e-09)  # 2 / (3 log 2)
LOG2_OF_THREE_HALVES = (0.5849624872207642, 1.350039202129749e-08)
LOG2_PARTS = (0.6931471675634384, 1.2996506893889889e-08)
SQRT3, SQRT_THREE_HALVES = 3.0**0.5, 1.5**0.5
EXACT_ONLY = 2.0**70  # powers of numbers other than one overflow or vanish for larger |y|
LARGEST_EXPONENT = 1090.0  # 2^z overflows above, and vanishes below the negative
# r^(-1/3) from 0.905 to 1.105, error 2^-23
INVERSE_CBRT = (1.8722473136290594, -1.8701493538677543, 1.5991946511446264, -0.7436009935745231, 0.1423083635925344)
CBRT_BITS = int(
    (1023 - 1023 / 3 - 0.03306235651) * 2**20
)  # a third of the bits of x plus these are those of its cube root to 5 %


def pow(f: Function, x: Value, y: Value) -> Value:
    """Return x^y."""
    unusual = any_unusual(x) | f.any_of(~(f.abs(y) < EXACT_ONLY))
    size, exponent = Normal(f.abs(x)), f.variable(y, width=y.width)
    with f.if_(unusual):
        size.scale()
        exponent.where(f.abs(y) > EXACT_ONLY, copy_sign(EXACT_ONLY, y))
    result = f.variable(_exp2_of_product(f, exponent.value, *_log2(f, size)), width=x.width)
    with f.if_(unusual):
        result.value = _unusual_power(f, x, y, result.value)
    return result.value


def _unusual_power(f: Function, x: Value, y: Value, result: Value) -> Value:
    """Return x^y for any numbers, where `result` is |x|^y for finite |x| other than zero."""
    size = f.abs(x)
    grows = f.logic("xor", size < 1.0, y > 0.0)
    result = f.select(size.is_(0.0) | size.is_(INFINITY), f.select(grows, INFINITY, 0.0), result)
    half = rounded(y * 0.5)
    is_whole, is_even = f.intrinsic("floor", y).is_(y), f.intrinsic("floor", half).is_(half)
    result = f.select(is_whole & ~is_even, copy_sign(result, x), result)
    result = f.select((x < 0.0) & ~is_whole & (size < INFINITY), NAN, result)
    result = f.select(x.is_not(x) | y.is_not(y), x + y, result)
    return f.select(x.is_(1.0) | y.is_(0.0), 1.0, result)


def _log2(f: Function, size: Normal) -> tuple[Value, Value]:
    """Return log2 of positive numbers as a sum of two doubles."""
    exponent, m = size.mantissa(BITS_OF_ONE)
    above, middle = m >= SQRT3, m >= SQRT_THREE_HALVES
    is_shifted = middle & ~above  # compared with 3/2, otherwise with one
    exponent = exponent + f.select(above, 1.0, 0.0)
    m = f.select(above, rounded(m * 0.5), m)
    base = f.select(is_shifted, 1.5, 1.0)
    numerator, denominator = m - base, m + base
    inverse = 1.0 / denominator
    s = rounded(numerator * inverse)
    s_high, upper = upper_half(s), upper_half(denominator)
    s_low = inverse * (f.fma(s_high, -(m - (upper - base)), f.fma(s_high, -upper, numerator)))
    # log m / (2 s) * 3 = 3 + s^2 + s^4 L(s^2)
    z = rounded(s * s)
    rest = f.fma(s_low, s_high + s, rounded(rounded(z * z) * polynomial(z, LOG)))
    square = rounded(s_high * s_high)
    sum_high = upper_half(square + 3.0 + rest)
    sum_low = rest - (sum_high - 3.0 - square)
    product = rounded(s_high * sum_high)
    correction = f.fma(s_low, sum_high, rounded(sum_low * s))
    log_high = upper_half(product + correction)
    log_low = correction - (log_high - product)
    high = rounded(log_high * CP_PARTS[0])
    low = f.fma(log_high, CP_PARTS[1], f.fma(log_low, CP, f.select(is_shifted, LOG2_OF_THREE_HALVES[1], 0.0)))
    offset = f.select(is_shifted, LOG2_OF_THREE_HALVES[0], 0.0)
    total = upper_half(high + low + offset + exponent)
    return total, low - (total - exponent - offset - high)


def _exp2_of_product(f: Function, y: Value, log_high: Value, log_low: Value) -> Value:
    """Return 2^(y (log_high + log_low))."""
    y_high = upper_half(y)
    low = f.fma(y - y_high, log_high, rounded(y * log_low))
    high = rounded(y_high * log_high)
    total = high + low
    high = f.select(total > LARGEST_EXPONENT, LARGEST_EXPONENT, f.select(total < -LARGEST_EXPONENT, -LARGEST_EXPONENT, high))
    low = f.select(f.abs(total) > LARGEST_EXPONENT, 0.0, low)
    number, n = nearest(f, high + low)
    rest = high - number
    upper = upper_half(rest + low)
    first = rounded(upper * LOG2_PARTS[0])
    second = f.fma(low - (upper - rest), LOG2, rounded(upper * LOG2_PARTS[1]))
    return scale(first + series(first + second, second) + 1.0, n)


def cbrt(f: Function, x: Value) -> Value:
    """Return the cube root: an estimate from the bits of x, a polynomial, and a step of Halley's method."""
    size = f.abs(x)
    tiny = size < SMALLEST_NORMAL
    scaled = f.select(tiny, rounded(size * 2.0**54), size)
    # floor(n / 3) for n < 2^31
    third = shift(shift(bits(scaled), "lshr", 32) * 0xAAAAAAAB, "lshr", 33)
    t = from_bits(shift(third + CBRT_BITS, "shl", 32))
    ratio = rounded(t * t) * rounded(t / scaled)
    t = upper_half(rounded(t * polynomial(rounded(ratio), INVERSE_CBRT)))
    quotient = scaled / rounded(t * t)
    t = f.fma(t, (quotient - t) / (t + t + quotient), t)
    t = f.select(tiny, rounded(t * 2.0**-18), t)
    return f.select(size.is_(0.0) | ~(size < INFINITY), x, copy_sign(t, x))
