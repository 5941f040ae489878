"""The remainder of a division, without error."""

from udkjax.native.language.elementary.parts import INFINITY, NAN, copy_sign, upper_half
from udkjax.native.language.ir import Function, Value

# The quotient x / y may have more than 53 digits. The remainder of x / (2^k y) is smaller, and has the same remainder as x.
QUOTIENT_DIGITS = 50


def rem(f: Function, x: Value, y: Value) -> Value:
    """Return x - n y, where n is x / y rounded towards zero; the result has the sign of x."""
    size, width = f.abs(y), x.width
    rest = f.variable(f.select(f.is_finite(x), f.abs(x), NAN), width=width)
    divisor = f.variable(f.select(size.is_(0.0), NAN, size), width=width)

    def is_far() -> Value:
        return divisor.value * 2.0 ** (QUOTIENT_DIGITS + 2) <= rest.value

    with f.while_(lambda: f.any_of(is_far())):
        divisor.where(is_far(), divisor.value * 2.0**QUOTIENT_DIGITS)
    with f.while_(lambda: f.any_of(divisor.value >= size)):
        rest.where(divisor.value >= size, _remainder(f, rest.value, divisor.value))
        divisor.value = f.select(divisor.value > size, divisor.value * 2.0**-QUOTIENT_DIGITS, -1.0)
    result = f.select(size.is_(INFINITY) & f.is_finite(x), x, f.select(size > 0.0, rest.value, NAN))
    return copy_sign(result, x)


def _remainder(f: Function, a: Value, b: Value) -> Value:
    """Return the remainder of a / b < 2^53, for positive numbers: products of upper and lower halves are exact."""
    n = f.intrinsic("trunc", a / b)
    n_high, b_high = upper_half(n), upper_half(b)
    n_low, b_low = n - n_high, b - b_high
    rest = f.fma(-n_high, b_high, a)
    for x, y in ((n_high, b_low), (n_low, b_high), (n_low, b_low)):
        rest = f.fma(-x, y, rest)
    return f.select(rest < 0.0, rest + b, rest)  # the rounded quotient was one too large
