"""Powers of numbers in lanes without library calls, for step sizes, which need not be exact to the last digit."""

import math

from udkjax.native.base.ir import DOUBLE, INT, Function, Value, llvm_type

TERMS = 10  # terms of both series, for a relative error below 1e-9
BIAS, FRACTION = 1023, 52  # of float64


def power(f: Function, x: Value, exponent: float, whole: bool = False) -> Value:
    """Return x^exponent for positive x; `whole` tells that the exponent is an integer."""
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
    integers, T = llvm_type(INT, x.width), x.type
    bits = f.op(f"bitcast {T} {x.name} to {integers}", INT, x.width)
    shift = f.const(FRACTION, INT, x.width)
    exponent = f.op(f"lshr {integers} {bits.name}, {shift.name}", INT, x.width)
    fraction = f.logic("or", f.logic("and", bits, 2**FRACTION - 1), BIAS << FRACTION)
    m = f.op(f"bitcast {integers} {fraction.name} to {T}", DOUBLE, x.width)
    z = (m - math.sqrt(2)) / (m + math.sqrt(2))
    y, total = z * z, f.const(1.0 / (2 * TERMS - 1), DOUBLE, x.width)
    for k in reversed(range(TERMS - 1)):
        total = f.fma(total, y, 1.0 / (2 * k + 1))
    return _as_double(f, exponent) - BIAS + f.fma(z * (2 / math.log(2)), total, 0.5)


def _exp2(f: Function, x: Value) -> Value:
    """Return 2^x by the integer part of x and a series for the rest; |x| must be far below the largest exponent."""
    integers, T = llvm_type(INT, x.width), x.type
    large = 1.5 * 2.0**52
    shifted = f.op(f"fadd {T} {x.name}, {f.const(large, DOUBLE, x.width).name}", DOUBLE, x.width)
    nearest = f.op(f"fsub {T} {shifted.name}, {f.const(large, DOUBLE, x.width).name}", DOUBLE, x.width)
    z = (x - nearest) * math.log(2)
    total = f.const(1.0 / math.factorial(TERMS), DOUBLE, x.width)
    for k in reversed(range(TERMS)):
        total = f.fma(total, z, 1.0 / math.factorial(k))
    bits = f.op(f"bitcast {T} {shifted.name} to {integers}", INT, x.width)
    shift = f.const(FRACTION, INT, x.width)
    scale = f.op(f"shl {integers} {(bits + BIAS).name}, {shift.name}", INT, x.width)
    return total * f.op(f"bitcast {integers} {scale.name} to {T}", DOUBLE, x.width)


def _as_double(f: Function, k: Value) -> Value:
    """Convert a small nonnegative integer to double by setting bits of the fraction."""
    integers, T = llvm_type(INT, k.width), llvm_type(DOUBLE, k.width)
    magic = 2.0**52
    import struct

    bits_of_magic = struct.unpack("<q", struct.pack("<d", magic))[0]
    pattern = f.logic("or", k, bits_of_magic)
    number = f.op(f"bitcast {integers} {pattern.name} to {T}", DOUBLE, k.width)
    return f.op(f"fsub {T} {number.name}, {f.const(magic, DOUBLE, k.width).name}", DOUBLE, k.width)
