"""Elementary functions in LLVM's text instead of calls of a C library, with equal bits wherever multiply-add is fused.

`call` adds a function to the module that uses it, once for each number of lanes. The functions need arithmetic, sqrt, floor,
comparisons and integers, but no tables in memory; they branch only for unusual numbers. Their errors are below one unit in the
last place (ulp), or below two for sinh, cosh, tanh, asinh, acosh, atanh, erf and erfc. Without fused multiply-add their errors
are larger by less than one ulp.
"""

from udkjax.native.language.elementary.calls import FUNCTION_NAMES, call

__all__ = ["FUNCTION_NAMES", "call"]
