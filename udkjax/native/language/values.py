"""Values in functions of LLVM's text (ir.py): numbers and vectors of W lanes, with operators that write instructions."""

import struct
from typing import Any, NamedTuple, Union

DOUBLE, INT, BOOL, POINTER = "double", "i64", "i1", "ptr"
Operand = Union["Value", float, int, bool]


def literal(number: Any, base: str) -> str:
    """Return a number as a constant of a base type in LLVM's syntax."""
    if base == DOUBLE:
        return f"0x{struct.unpack('<Q', struct.pack('<d', float(number)))[0]:016X}"
    return str(int(number)) if base != BOOL else str(bool(number)).lower()


class Product(NamedTuple):
    """A product of two values, or its negative."""

    a: "Value"
    b: "Value"
    is_negative: bool = False


class Value:
    """A value in the text of a function `f`: its name, base type and number of lanes."""

    __slots__ = ("base", "f", "name", "product", "width")

    def __init__(self, f: Any, name: str, base: str, width: int = 1):
        self.f, self.name, self.base, self.width = f, name, base, width
        self.product: Product | None = None  # set for a product of two values

    @property
    def type(self) -> str:
        return llvm_type(self.base, self.width)

    def __add__(self, other):
        return self.f.arithmetic("add", self, other)

    def __radd__(self, other):
        return self.f.arithmetic("add", other, self)

    def __sub__(self, other):
        return self.f.arithmetic("sub", self, other)

    def __rsub__(self, other):
        return self.f.arithmetic("sub", other, self)

    def __mul__(self, other):
        return self.f.arithmetic("mul", self, other)

    def __rmul__(self, other):
        return self.f.arithmetic("mul", other, self)

    def __truediv__(self, other):
        return self.f.arithmetic("div", self, other)

    def __rtruediv__(self, other):
        return self.f.arithmetic("div", other, self)

    def __neg__(self):
        if self.base == INT:
            return self.f.arithmetic("sub", self.f.const(0, INT, self.width), self)
        negative = self.f.op(f"fneg {self.type} {self.name}", self.base, self.width)
        if self.product:
            negative.product = self.product._replace(is_negative=not self.product.is_negative)
        return negative

    def __lt__(self, other):
        return self.f.compare("lt", self, other)

    def __le__(self, other):
        return self.f.compare("le", self, other)

    def __gt__(self, other):
        return self.f.compare("gt", self, other)

    def __ge__(self, other):
        return self.f.compare("ge", self, other)

    def is_(self, other: Operand) -> "Value":
        """Compare for equality; `==` is Python's own."""
        return self.f.compare("eq", self, other)

    def is_not(self, other: Operand) -> "Value":
        """Compare for inequality; true for NaN."""
        return self.f.compare("ne", self, other)

    def __and__(self, other):
        return self.f.logic("and", self, other)

    __rand__ = __and__

    def __or__(self, other):
        return self.f.logic("or", self, other)

    __ror__ = __or__

    def __invert__(self):
        return self.f.logic("xor", self, True)


def llvm_type(base: str, width: int) -> str:
    """Return LLVM's name of the type of `width` lanes of a base type."""
    return base if width == 1 else f"<{width} x {base}>"
