"""Arrays of one member as functions of indices: in memory, constant, or computed where they are read.

An index is an integer, a value in one lane (the counter of a loop), or a value in all lanes, each with its own.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from udkjax.native.language.ir import BOOL, DOUBLE, INT, Function, Operand, Value
from udkjax.native.language.program import UnsupportedError

Index = tuple[Operand, ...]


def base_of(dtype: Any) -> str:
    """Return the base type of machine code (`DOUBLE`, `INT` or `BOOL`) for numbers of a dtype.

    Raises:
        UnsupportedError: machine code has no such numbers.
    """
    if not isinstance(dtype, np.dtype | type):  # the types of random keys
        raise UnsupportedError(f"the type {dtype}")
    dtype = np.dtype(dtype)
    if dtype == np.float64:
        return DOUBLE
    if dtype.kind == "b":
        return BOOL
    if dtype.kind == "i":
        return INT
    raise UnsupportedError(f"the type {dtype}")


class Array:
    """An array of a lowered function, without an axis of lanes: each lane has a member, with an array of its own.

    Args:
        shape: The shape of the array.
        base: The base type of its elements.
        varies: Whether the arrays of lanes may differ.
        cost: The number of operations that reading an element takes.
    """

    def __init__(self, shape: Sequence[int], base: str, varies: bool, cost: int = 0):
        self.shape, self.base, self.varies, self.cost = tuple(shape), base, varies, cost

    def read(self, f: Function, index: Index) -> Value:
        """Return the element at an index: in all lanes if the array varies, else in one lane."""
        raise NotImplementedError

    @property
    def size(self) -> int:
        return int(np.prod(self.shape))


class SingleNumber(Array):
    """An array of shape (), held as a value in registers."""

    def __init__(self, value: Value, varies: bool):
        super().__init__((), value.base, varies)
        self.value = value

    def read(self, f: Function, index: Index) -> Value:
        return self.value


class Constant(Array):
    """An array of known numbers. `memory` stores them as a table, for reads at unknown indices, unless all are equal."""

    def __init__(self, numbers: Any, memory: Callable[[np.ndarray], "Stored"]):
        self.numbers, self._memory = np.asarray(numbers), memory
        super().__init__(self.numbers.shape, base_of(self.numbers.dtype), False)

    def read(self, f: Function, index: Index) -> Value:
        numbers = self.numbers
        if numbers.size and np.array_equal(numbers, np.broadcast_to(numbers.flat[0], numbers.shape)):
            return f.const(numbers.flat[0], self.base)
        known = tuple(i for i in index if isinstance(i, int))
        if len(known) == len(index):
            return f.const(numbers[known], self.base)
        return self._memory(numbers).read(f, index)


class Stored(Array):
    """An array in memory, with the lanes of each element together.

    Args:
        pointer: Its address.
        start: The index of its first element.
        strides: By how many elements the indices differ along each axis; by default it is contiguous.
    """

    def __init__(
        self, pointer: Value, shape: Sequence[int], base: str, varies: bool, start: int = 0, strides: Sequence[int] | None = None
    ):
        super().__init__(shape, base, varies)
        self.pointer, self.start = pointer, start
        contiguous = tuple(int(np.prod(self.shape[k + 1 :])) for k in range(len(self.shape)))
        self.strides = contiguous if strides is None else tuple(strides)
        self.is_contiguous = self.strides == contiguous

    def at(self, pointer: Value) -> "Stored":
        """Return the same array with another pointer to its memory, for a function in which this has another name."""
        return Stored(pointer, self.shape, self.base, self.varies, self.start, self.strides)

    def _place(self, index: Index) -> Operand:
        place: Any = self.start
        for i, stride in zip(index, self.strides, strict=True):
            place = place + i * stride if isinstance(i, int) else i * stride + place
        return place

    def read(self, f: Function, index: Index) -> Value:
        lanes, base = f.width if self.varies else 1, INT if self.base == BOOL else self.base
        place = self._place(index)
        if isinstance(place, Value) and place.width > 1:
            x = Value(f, "poison", base, f.width)
            for k in range(f.width):
                one = f.load(self.pointer, self._of_lane(f, place, k, lanes), base=base)
                x = f.op(f"insertelement {x.type} {x.name}, {one.type} {one.name}, i64 {k}", base, f.width)
        else:
            x = f.load(self.pointer, place * lanes, lanes, base)
        return x.is_not(0) if self.base == BOOL else x

    def write(self, f: Function, index: Index, x: Value):
        """Store x as the element at an index."""
        lanes, base = f.width if self.varies else 1, INT if self.base == BOOL else self.base
        place, x = self._place(index), fit(f, x, self.varies)
        x = f.like(x, base, lanes)
        if isinstance(place, Value) and place.width > 1:
            for k in range(f.width):
                f.store(f.lane(x, f.const(k, INT)), self.pointer, self._of_lane(f, place, k, lanes), base=base)
        else:
            f.store(x, self.pointer, place * lanes, lanes, base)

    @staticmethod
    def _of_lane(f: Function, place: Value, k: int, lanes: int) -> Value:
        return f.lane(place, f.const(k, INT)) * lanes + (k if lanes > 1 else 0)


class Lazy(Array):
    """An array whose elements a function of the index computes when they are read."""

    def __init__(self, shape: Sequence[int], base: str, operands: Sequence[Array], read: Callable[[Index], Value], cost: int = 0):
        super().__init__(shape, base, any(x.varies for x in operands), cost + sum(x.cost for x in operands))
        self._read = read

    def read(self, f: Function, index: Index) -> Value:
        return self._read(index)


def fit(f: Function, x: Value, varies: bool) -> Value:
    """Return x in all lanes if it `varies`, else in one lane."""
    if varies:
        return f.like(x, x.base, f.width)
    return x if x.width == 1 else f.lane(x, f.const(0, INT))


def plus(a: Operand, b: Operand) -> Operand:
    """Return the sum of two indices."""
    if isinstance(a, int) and a == 0:
        return b
    return a if isinstance(b, int) and b == 0 else a + b
