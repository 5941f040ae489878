"""The error function and its complement.

erf x = x (1 + P(x^2)) up to one; erfc x = e^(-x^2) Q(t) / (1 + 2 x) from 1/2, with t = (x - 3) / (x + 3): both polynomials
interpolate at Chebyshev nodes.
"""

from udkjax.native.language.elementary.exponentials import reduce, scale
from udkjax.native.language.elementary.parts import copy_sign, polynomial, quotient, rounded, upper_half
from udkjax.native.language.ir import Function, Value

# erf(x) / x - 1 as a function of x^2 up to one, error 2^-55
ERF = (
    0.12837916709551256, -0.37612638903183543, 0.11283791670945006, -0.02686617064323777, 0.0052239776071164225,
    -0.0008548325975389692, 0.00012055294904839707, -1.492473690741966e-05, 1.6447424703317362e-06, -1.6208483801871705e-07,
    1.3720064546777686e-08, -7.795898827002142e-10,
)  # fmt: skip
# (1 + 2 x) e^(x^2) erfc x for 1/2 <= x <= 28, error 2^-54
ERFC = (
    1.2530080582697296, -0.13562110612458084, -0.04756229435343384, 0.12964515870271817, -0.11927366341637591,
    0.06830802734557402, -0.023770514892453878, 0.002529391787416037, 0.0018886900308933137, -0.0007798319787670749,
    -0.00010515741491655, 0.00012509749095168397, 4.9387975342434404e-06, -2.00929833045886e-05, -7.012462973163499e-07,
    3.4525197016153044e-06, 3.0307407103093377e-07, -5.840747551910045e-07, -8.42551957399924e-08, 7.124245030572795e-08,
    8.635681414307825e-09,
)  # fmt: skip
VANISHING_ARGUMENT = 27.3  # erfc x vanishes above


def _small_part(f: Function, size: Value) -> Value:
    """Return erf x - x, for 0 <= x <= 1."""
    z = rounded(size * size)
    return rounded(size * polynomial(z, ERF))


def _complement(f: Function, x: Value) -> Value:
    """Return erfc x for x >= 1/2."""
    x = f.select(x > VANISHING_ARGUMENT, VANISHING_ARGUMENT, x)
    upper = upper_half(x)
    low = rounded((upper - x) * (upper + x))
    e = reduce(f, -rounded(upper * upper), low)
    t = (x - 3.0) / (x + 3.0)
    # sums and the quotient are sums of two doubles, the second of which is the rounding error
    part = rounded(t * polynomial(t, ERFC[1:]))
    top, bottom, fraction = part + ERFC[0], x + x + 1.0, e.high + 1.0
    ratio, ratio_error = quotient(f, (top, part - (top - ERFC[0])), (bottom, x + x - (bottom - 1.0)))
    fraction_error = e.high - (fraction - 1.0) + e.low
    return scale(f.fma(fraction, ratio, f.fma(fraction, ratio_error, rounded(fraction_error * ratio))), e.n)


def erf(f: Function, x: Value) -> Value:
    """Return the error function."""
    size = f.abs(x)
    result = f.select(size < 1.0, size + _small_part(f, size), 1.0 - _complement(f, size))
    return copy_sign(result, x)


def erfc(f: Function, x: Value) -> Value:
    """Return 1 - erf x, accurate also for large x, where it is small."""
    size = f.abs(x)
    part = _small_part(f, size)
    small = f.select(x < 0.25, 1.0 - (x + copy_sign(f.abs(part), x)), 0.5 - (part + (x - 0.5)))
    tail = _complement(f, size)
    return f.select(size < 0.5, small, f.select(x < 0.0, 2.0 - tail, tail))
