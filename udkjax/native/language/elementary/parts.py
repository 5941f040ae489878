"""Parts of elementary functions: bits of float64 numbers, polynomials, and products that must not be fused with sums."""

from collections.abc import Sequence

from udkjax.native.language.ir import DOUBLE, INT, Function, Operand, Value, llvm_type

FRACTION_BITS, EXPONENT_BIAS = 52, 1023  # of float64
SIGN_BIT = -(2**63)
FRACTION_MASK, BITS_OF_ONE = 2**FRACTION_BITS - 1, EXPONENT_BIAS << FRACTION_BITS
UPPER_HALF = -(2**27)  # the upper 26 digits: products of two such numbers are exact
SMALLEST_NORMAL, INFINITY, NAN = 2.0**-1022, float("inf"), float("nan")
ROUNDING_SHIFT = 1.5 * 2.0**52  # added to a number, leaves the nearest integer in the last digits of the sum


def bits(x: Value) -> Value:
    """Return the 64 bits of numbers as integers."""
    return x.f.op(f"bitcast {x.type} {x.name} to {llvm_type(INT, x.width)}", INT, x.width)


def from_bits(b: Value) -> Value:
    """Return the numbers with the given bits."""
    return b.f.op(f"bitcast {b.type} {b.name} to {llvm_type(DOUBLE, b.width)}", DOUBLE, b.width)


def shift(b: Value, direction: str, count: int) -> Value:
    """Shift integers by `count` bits: `shl` to the left, `lshr` to the right; zeros move in."""
    return b.f.op(f"{direction} {b.type} {b.name}, {b.f.const(count, INT, b.width).name}", INT, b.width)


def mask(b: Value, digits: int) -> Value:
    """Return the bits of integers that are set in `digits`."""
    return b.f.logic("and", b, digits)


def upper_half(x: Value) -> Value:
    """Return the upper 26 digits of numbers.

    A single number is put into a vector of two, so that it stays in a floating-point register.
    """
    if x.width > 1:
        return from_bits(mask(bits(x), UPPER_HALF))
    f, kind = x.f, llvm_type(DOUBLE, 2)
    pair = f.op(f"insertelement {kind} poison, double {x.name}, i64 0", DOUBLE, 2)
    return f.lane(from_bits(mask(bits(pair), UPPER_HALF)), f.const(0, INT))


def copy_sign(size: Operand, x: Value) -> Value:
    """Return numbers with the signs of x."""
    return x.f.intrinsic("copysign", size, x)


def flip_sign(x: Value, sign: Value) -> Value:
    """Return x with opposite sign where the sign bit of `sign` is set."""
    return rounded(x * copy_sign(1.0, sign))


def any_unusual(x: Value) -> Value:
    """Return whether the number in any lane is subnormal, not positive or not finite."""
    f = x.f
    return f.any_of(~((x >= SMALLEST_NORMAL) & (x < INFINITY)))


def power_of_two(b: Value) -> Value:
    """Return 2^k, where k is the integer in the lowest 11 bits of b."""
    return from_bits(shift(b + EXPONENT_BIAS, "shl", FRACTION_BITS))


def rounded(x: Value) -> Value:
    """Return x marked as no product: sums do not fuse it to a multiply-add, so that the product is rounded unless it is exact."""
    x.product = None
    return x


def nearest(f: Function, x: Operand, factor: float = 1.0) -> tuple[Value, Value]:
    """Return the integer nearest to x * factor, as a number and in the lowest bits of an integer."""
    shifted = f.fma(x, factor, ROUNDING_SHIFT) if factor != 1.0 else f.arithmetic("add", x, ROUNDING_SHIFT)
    return shifted - ROUNDING_SHIFT, bits(shifted)


def polynomial(x: Value, coefficients: Sequence[float]) -> Value:
    """Return sum_k c_k x^k by Estrin's scheme: neighboring terms are joined in pairs, which do not wait for each other."""
    f, power = x.f, x
    terms: list[Operand] = list(coefficients)
    while len(terms) > 1:
        pairs = zip(terms[::2], terms[1::2], strict=False)
        terms = [*(f.fma(b, power, a) for a, b in pairs), *(terms[-1:] if len(terms) % 2 else [])]
        if len(terms) > 1:
            power = rounded(power * power)
    return f.like(terms[0], DOUBLE, x.width)


def quotient(f: Function, a: tuple[Operand, Operand], b: tuple[Value, Operand]) -> tuple[Value, Value]:
    """Return a / b as a sum of two doubles, for a and b that are sums of two doubles."""
    inverse = 1.0 / b[0]
    result = rounded(inverse * a[0])
    error = f.fma(-result, b[0], a[0]) - f.fma(result, b[1], -a[1])
    return result, rounded(error * inverse)


class Normal:
    """Positive numbers whose mantissas are to be found. If any may be subnormal, `scale` must be called first."""

    def __init__(self, x: Value):
        self._x = x
        self.number, self._bias = x.f.variable(x, DOUBLE, x.width), x.f.variable(float(EXPONENT_BIAS), DOUBLE, x.width)

    def scale(self):
        """Multiply subnormal numbers by 2^54."""
        tiny = self.number.value < SMALLEST_NORMAL
        self._bias.where(tiny, EXPONENT_BIAS + 54.0)
        self.number.where(tiny, self.number.value * 2.0**54)

    def mantissa(self, start: int) -> tuple[Value, Value]:
        """Return k and m with x = 2^k m, where m is between the number whose bits are `start` and twice this number."""
        b = bits(self.number.value) + (BITS_OF_ONE - start)
        m = from_bits(mask(b, FRACTION_MASK) + start)
        return small_integer(shift(b, "lshr", FRACTION_BITS)) - self._bias.value, m


def small_integer(k: Value) -> Value:
    """Convert nonnegative integers below 2^52 to numbers, through the digits of 2^52 + k."""
    return from_bits(k.f.logic("or", k, (EXPONENT_BIAS + 52) << FRACTION_BITS)) - 2.0**52
