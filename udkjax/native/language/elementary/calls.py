"""Calls of elementary functions, which add these functions to the module of the caller."""

from collections.abc import Callable
from functools import cache

from udkjax.native.language.elementary import (
    error_functions,
    exponentials,
    inverse_angles,
    logarithms,
    powers,
    remainders,
    tangent_function,
)
from udkjax.native.language.ir import DOUBLE, Function, Operand, Value, llvm_type

_BODIES: dict[str, Callable[..., Value]] = {
    **{name: getattr(exponentials, name) for name in ("exp", "exp2", "expm1", "sinh", "cosh", "tanh")},
    **{name: getattr(logarithms, name) for name in ("log", "log1p", "log2", "asinh", "acosh", "atanh")},
    **{name: getattr(inverse_angles, name) for name in ("asin", "acos", "atan", "atan2")},
    **{name: getattr(powers, name) for name in ("pow", "cbrt")},
    **{name: getattr(error_functions, name) for name in ("erf", "erfc")},
    "tan": tangent_function.tan,
    "rem": remainders.rem,
}
FUNCTION_NAMES = frozenset(_BODIES)
_TWO_ARGUMENTS = ("atan2", "pow", "rem")


def call(f: Function, name: str, *arguments: Operand) -> Value:
    """Return the elementary function `name` (of `FUNCTION_NAMES`) of numbers, lane by lane, by a call of its function."""
    width = max((x.width for x in arguments if isinstance(x, Value)), default=1)
    return f.evaluate(_function(name, width), *(f.like(x, DOUBLE, width) for x in arguments))


@cache
def _function(name: str, width: int) -> Function:
    kind = llvm_type(DOUBLE, width)
    names = ("x", "y")[: 2 if name in _TWO_ARGUMENTS else 1]
    suffix = "f64" if width == 1 else f"v{width}f64"
    f = Function(f"{name}_{suffix}", [(kind, x) for x in names], width, returns=kind)
    result = _BODIES[name](f, *(Value(f, f"%{x}", DOUBLE, width) for x in names))
    f.line(f"ret {kind} {result.name}")
    return f
