"""Modules of the engine as C99, translated from the same text as machine code, for processors without Python.

`c_unit` returns the C of an operation on one member, in memory that its caller provides; `c_function` translates one function.
"""

from udkjax.native.c.syntax import number_text
from udkjax.native.c.unit import CUnit, c_function, c_unit

__all__ = ["CUnit", "c_function", "c_unit", "number_text"]
