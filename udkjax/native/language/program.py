"""A straight-line program as an LLVM function for one state, or for W states in lanes.

Inputs and outputs are in memory, with the W lanes of each number contiguous.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from udkjax.expressions import ScalarProgram
from udkjax.expressions.scalars.program_pieces import LONGEST, ProgramPiece, pieces_of
from udkjax.native.language import elementary
from udkjax.native.language.ir import BOOL, DOUBLE, INT, POINTER, Function, Value, llvm_type

SIN_COEFFICIENTS = [(-1) ** k / math.factorial(2 * k + 1) for k in range(9)]
COS_COEFFICIENTS = [(-1) ** k / math.factorial(2 * k) for k in range(10)]
# pi / 2: the first three parts have 23 digits; their multiples up to 2^30 are exact, whether or not multiplications are fused.
HALF_PI = tuple(
    map(float.fromhex, ("0x1.921fb40000000p+0", "0x1.4442d00000000p-24", "0x1.8469880000000p-48", "0x1.8cc51701b839ap-72"))
)
ROUNDING_SHIFT = 1.5 * 2.0**52  # added to a number, leaves the nearest integer in the last digits of the sum
PASSED_POINTER = "passed"  # the pointer to what the pieces of a long program pass on
_ARITHMETIC = ("add", "sub", "mul", "div")
_COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")
_INTRINSIC_NAMES = {"abs": "fabs", "floor": "floor", "ceil": "ceil", "max": "maximum", "min": "minimum"}


class UnsupportedError(ValueError):
    """An operation of a scene that machine code does not support."""


PointerPlace = tuple[str, int]  # the name of a pointer, and an index relative to it


def consecutive(pointer: str, count: int) -> list[PointerPlace]:
    """Return the places of the first `count` numbers at a pointer."""
    return [(pointer, k) for k in range(count)]


def write(
    program: ScalarProgram,
    name: str,
    width: int,
    pointers: Sequence[str],
    inputs: Sequence[PointerPlace],
    outputs: Sequence[PointerPlace],
    cold: bool = False,
    lanes: Mapping[str, int] | None = None,
    longest: int = LONGEST,
) -> Function:
    """Return a function of some pointers that computes a program; conditions are stored as one or zero.

    A long program is cut into pieces, functions of their own, which the returned function calls one after another.

    Args:
        program: The program.
        name: The name of the function.
        width: The number of lanes.
        pointers: The names of the function's arguments.
        inputs: The place of each input of the program.
        outputs: The place of each output. The index of a place is in units of the lanes of its pointer.
        cold: Whether the function is not optimized.
        lanes: By pointer, the number of lanes of the numbers there, if it is not `width`. Operations whose operands have one lane
            are computed in one lane.
        longest: The maximum number of operations of a function.
    """
    lanes = dict.fromkeys(pointers, width) | dict(lanes or {})
    places = {s.index: place for s, place in zip(program.inputs, inputs, strict=True) if program.uses(s)}
    read = {*places.values()}
    pieces, shared = pieces_of(program, [k for k, place in enumerate(outputs) if place in read], longest)
    widest = max(lanes.values(), default=width)
    kinds: dict[int, tuple[str, int]] = {}  # the type and the lanes of values that pieces pass
    read_again = nodes_read_again(program)  # once for all pieces

    def fill(f: Function, piece: ProgramPiece, passed: Value):
        writer = Writer(f, program, read_again)
        for s in program.inputs:
            if s.index in piece.inputs:
                pointer, place = places[s.index]
                x = f.load(f.given[pointer], place * lanes[pointer], lanes[pointer])
                writer.values[s.index] = from_memory(f, x, s.node.dtype)
        for index, place in piece.received.items():
            base, own = kinds[index]
            x = f.load(passed, place * widest, own, DOUBLE if base == BOOL else base)
            writer.values[index] = x.is_not(0.0) if base == BOOL else x
        writer.compute(piece.order)
        for index, place in piece.passed.items():
            x = writer.values[index]
            kinds[index] = x.base, x.width
            f.store(x, passed, place * widest, x.width, DOUBLE if x.base == BOOL else x.base)
        for value, k in zip(writer.outputs(piece.outputs), piece.outputs, strict=True):
            pointer, place = outputs[k]
            f.store(value, f.given[pointer], place * lanes[pointer], lanes[pointer])

    arguments = [(POINTER, x) for x in pointers]
    f = Function(name, arguments, width, cold=cold)
    if len(pieces) == 1:
        fill(f, pieces[0], f.const(0, INT))  # passes nothing on
        return f
    passed = Value(f, f.reserve(llvm_type(DOUBLE, widest), shared), POINTER)
    for k, piece in enumerate(pieces):
        part = Function(f"{name}_piece{k}", [*arguments, (POINTER, PASSED_POINTER)], width, cold=cold)
        part.noinline = True
        fill(part, piece, part.given[PASSED_POINTER])
        f.evaluated |= part.evaluated | {part.name: part}
        f.call(part.name, *(f.given[x] for x in pointers), passed)
    return f


def vector_function(program: ScalarProgram, name: str, given: str, found: str, places: Sequence[int] | None = None) -> Function:
    """Return a function of one lane that computes a program, with two pointers as its arguments.

    The argument named `given` points to the inputs, which are contiguous, and that named `found` to the outputs. `places` has the
    indices of the outputs there; by default they are contiguous, too.
    """
    outputs = consecutive(found, len(program.outputs)) if places is None else [(found, k) for k in places]
    return write(program, name, 1, (given, found), consecutive(given, len(program.inputs)), outputs)


def from_memory(f: Function, x: Value, dtype: Any) -> Value:
    """Return a float64 number from memory as a value of a type of the program: a condition, an integer, or the same number."""
    if dtype.kind == "b":
        return x.is_not(0.0)
    return f.op(f"fptosi {x.type} {x.name} to {llvm_type(INT, x.width)}", INT, x.width) if dtype.kind in "iu" else x


def nodes_read_again(program: ScalarProgram) -> set[int]:
    """Return the indices of the nodes of a program that are read more than once, by operations or as outputs."""
    nodes = program.graph.nodes
    read, again = set[int](), set[int]()
    for s in chain(chain.from_iterable(nodes[index].arguments for index in program.order), program.outputs):
        (again if s.index in read else read).add(s.index)
    return again


class Writer:
    """The writer of a program's operations into a function.

    `values` has the value of each node that is known, by index. The caller must enter those of the inputs first.

    Args:
        f: The function.
        program: The program.
        read_again: The result of `nodes_read_again`, if it is known: several writers may write parts of one program.
    """

    def __init__(self, f: Function, program: ScalarProgram, read_again: Collection[int] | None = None):
        self.f, self.program, self.values = f, program, {}
        self._given = read_again
        self._negative: dict[int, Value] = {}
        self._pairs: dict[str, tuple[Value, Value]] = {}

    def run(self) -> list[Value]:
        """Write all operations of the program; return the values of its outputs."""
        self.compute(self.program.order)
        return self.outputs(range(len(self.program.outputs)))

    @cached_property
    def _read_again(self) -> Collection[int]:
        return nodes_read_again(self.program) if self._given is None else self._given

    def compute(self, order: Sequence[int]) -> None:
        """Write the operations of the nodes `order`."""
        nodes = self.program.graph.nodes
        for index in order:
            self.values[index] = result = self._operation(nodes[index])
            if index in self._read_again:  # fused with several sums, a product would occupy two registers instead of one
                result.product = None

    def outputs(self, chosen: Iterable[int]) -> list[Value]:
        """Return the values of the `chosen` outputs (indices), whose nodes have been written."""
        return [self._with_sign(self.program.outputs[k]) for k in chosen]

    def check(self):
        """Write every operation that is not arithmetic, to raise `UnsupportedError` if one is not supported."""
        nodes = self.program.graph.nodes
        for index in self.program.order:
            node = nodes[index]
            if node.kind in _ARITHMETIC:
                continue
            for s in node.arguments:
                base = {"b": BOOL, "f": DOUBLE}.get(s.node.dtype.kind, INT)
                self.values[s.index] = Value(self.f, "undef", base, self.f.width)
            self._negative.clear()
            self._operation(node)

    def _with_sign(self, s: Any) -> Value:
        if s.sign > 0:
            return self.values[s.index]
        if s.index not in self._negative:
            self._negative[s.index] = -self.values[s.index]
        return self._negative[s.index]

    def _operation(self, node: Any) -> Value:
        f = self.f
        if node.kind == "constant":
            base = BOOL if node.dtype == bool else INT if node.dtype.kind in "iu" else DOUBLE
            return f.const(node.detail, base, f.width)
        if node.kind in ("call", "pick"):
            raise UnsupportedError(f"{node.detail} of arrays")
        a = [self._with_sign(s) for s in node.arguments]
        if node.kind in _ARITHMETIC:
            return f.arithmetic(node.kind, *a)
        name = node.kind if node.kind != "apply" else node.detail.primitive.name
        parameters: Mapping[str, Any] = node.detail.parameters if node.kind == "apply" else {}
        return apply(f, name, parameters, a, self._sincos)

    def _sincos(self, angle: Value) -> tuple[Value, Value]:
        if angle.name not in self._pairs:
            self._pairs[angle.name] = sincos(self.f, angle)
        return self._pairs[angle.name]


def apply(f: Function, name: str, parameters: Mapping[str, Any], a: list[Value], pair: Any) -> Value:
    """Return the result of a primitive of JAX, applied lane by lane.

    Args:
        f: The function to write to.
        name: The name of the primitive.
        parameters: Its parameters.
        a: Its operands.
        pair: A function that returns the sine and the cosine of an angle.

    Raises:
        UnsupportedError: machine code does not support the primitive.
    """
    match name:
        case "sin" | "cos":
            return pair(a[0])[name == "cos"]
        case "sqrt":
            return f.intrinsic("sqrt", a[0])
        case "rsqrt":
            return 1.0 / f.intrinsic("sqrt", a[0])
        case "neg":
            return -a[0]
        case "square":
            return a[0] * a[0]
        case "one_minus_square":
            return (1.0 - a[0]) * (a[0] + 1.0)
        case "integer_pow":
            return integer_power(a[0], parameters["y"])
        case "logistic":
            return 1.0 / (elementary.call(f, "exp", -a[0]) + 1.0)
        case "round":
            return _round(f, a[0], parameters["rounding_method"])
        case "add" | "sub" | "mul" if a[0].base == INT:
            return f.arithmetic(name, *a)
        case "div" | "rem" if a[0].base == INT:
            return _divide_whole(f, name, *a)
        case "abs" if a[0].base == INT:
            return f.select(f.compare("lt", a[0], f.const(0, INT, f.width)), -a[0], a[0])
        case "sign" if a[0].base == INT:
            signs = (
                f.select(f.compare(order, a[0], f.const(0, INT, f.width)), f.const(1, INT, f.width), 0) for order in ("gt", "lt")
            )
            return f.arithmetic("sub", *signs)
        case "clamp" if a[0].base == INT:
            low = f.select(f.compare("lt", a[1], a[0]), a[0], a[1])
            return f.select(f.compare("gt", low, a[2]), a[2], low)
        case "max" | "min" if a[0].base == BOOL:
            return f.logic("or" if name == "max" else "and", *a)
        case "max" | "min" if a[0].base == INT:
            return f.select(f.compare("gt" if name == "max" else "lt", a[0], a[1]), a[0], a[1])
        case "shift_right_arithmetic" | "shift_right_logical" | "shift_left" if a[0].base == INT:
            return f.logic({"shift_right_arithmetic": "ashr", "shift_right_logical": "lshr", "shift_left": "shl"}[name], *a)
        case "bitcast_convert_type" if np.dtype(parameters["new_dtype"]).itemsize == 8:
            base = DOUBLE if np.dtype(parameters["new_dtype"]).kind == "f" else INT
            return f.op(f"bitcast {a[0].type} {a[0].name} to {llvm_type(base, f.width)}", base, f.width)
        case "sign" if a[0].base == DOUBLE:
            zero = f.const(0.0, DOUBLE, f.width)
            unit = f.select(a[0] > zero, f.const(1.0, DOUBLE, f.width), f.const(-1.0, DOUBLE, f.width))
            return f.select(a[0].is_(zero) | a[0].is_not(a[0]), a[0], unit)
        case "select_n" if len(a) == 3 and a[0].base == BOOL:
            return f.select(a[0], a[2], a[1])
        case "clamp":
            return f.intrinsic("minimum", f.intrinsic("maximum", a[1], a[0]), a[2])
        case "and" | "or" | "xor" if a[0].base in (BOOL, INT):
            return f.logic(name, *a)
        case "not" if a[0].base == BOOL:
            return ~a[0]
        case "is_finite":
            return f.is_finite(a[0])
        case "convert_element_type":
            return _convert(f, a[0], parameters["new_dtype"])
        case "copy" | "copy_p" | "stop_gradient":
            return a[0]
        case _ if name in _COMPARISONS:
            return f.compare(name, *a)
        case _ if name in _INTRINSIC_NAMES and all(x.base == DOUBLE for x in a):
            return f.intrinsic(_INTRINSIC_NAMES[name], *a)
        case _ if name in elementary.FUNCTION_NAMES and all(x.base == DOUBLE for x in a):
            return elementary.call(f, name, *a)
        case _:
            raise UnsupportedError(name)


def _convert(f: Function, a: Value, dtype: Any) -> Value:
    kind = np.dtype(dtype).kind
    if kind == "f":
        return f.like(a, DOUBLE, a.width)
    if kind in "iu" and a.base == BOOL:
        return f.like(a, INT, a.width)
    if kind in "iu" and a.base == INT:
        return a
    if kind in "iu" and a.base == DOUBLE:
        return _truncate(f, a, np.dtype(dtype))
    if kind == "b":
        return a if a.base == BOOL else a.is_not(0)
    raise UnsupportedError(f"{a.base} as {dtype}")


def _truncate(f: Function, a: Value, dtype: np.dtype) -> Value:
    """Return the integer part of numbers, clipped to the range of an integer type `dtype`; zero for NaN."""
    bounds = np.iinfo(dtype)
    kind, of_double = llvm_type(INT, a.width), f"{'v' + str(a.width) if a.width > 1 else ''}f64"
    full = f"llvm.fpto{'u' if dtype.kind == 'u' else 's'}i.sat.{of_double.replace('f', 'i')}.{of_double}"
    f.declared.add(f"declare {kind} @{full}({a.type})")
    whole = f.op(f"call {kind} @{full}({a.type} {a.name})", INT, a.width)
    if bounds.bits == 64:
        return whole
    whole = f.select(whole > bounds.max, int(bounds.max), whole)
    return f.select(whole < bounds.min, int(bounds.min), whole)


def _divide_whole(f: Function, name: str, x: Value, y: Value) -> Value:
    """Return the quotient of integers, rounded towards zero, if `name` is "div", else the remainder.

    Division by zero does not trap, and has the result that it has in JAX.
    """
    is_zero, is_minus = y.is_(0), y.is_(-1)
    ratio = f.select(is_minus, 0 - x, f.arithmetic("div", x, f.select(is_zero | is_minus, 1, y)))
    return f.select(is_zero, -1, ratio) if name == "div" else f.select(is_zero, x, x - ratio * y)


def _round(f: Function, a: Value, method: Any) -> Value:
    """Round to an integer: halves to the even one if JAX's rounding `method` is 1, else away from zero."""
    if int(method) == 1:
        return f.intrinsic("roundeven", a)
    below_half = f.intrinsic("copysign", math.nextafter(0.5, 0.0), a)  # half itself would round up the number below one half
    return f.intrinsic("trunc", a + below_half)


def integer_power(a: Value, n: int) -> Value:
    """Return a^n by repeated squaring."""
    f = a.f
    if n < 0:
        return 1.0 / integer_power(a, -n)
    if n == 0:
        return f.const(1.0, DOUBLE, a.width)
    half = integer_power(a, n // 2) if n > 1 else None
    square = None if half is None else half * half
    return a if square is None else square * a if n % 2 else square


def sincos(f: Function, a: Value) -> tuple[Value, Value]:
    """Return sine and cosine, exact up to rounding, by one reduction to within pi / 4 and two polynomials; no library calls."""
    width, T, integers = a.width, a.type, llvm_type(INT, a.width)
    shifted = f.fma(a, 2 / math.pi, ROUNDING_SHIFT)
    turns = f.op(f"fsub {T} {shifted.name}, {f.const(ROUNDING_SHIFT, DOUBLE, width).name}", DOUBLE, width)
    x = a
    for part in HALF_PI:
        x = f.fma(turns, -part, x)
    y = x * x
    s, c = f.const(SIN_COEFFICIENTS[8], DOUBLE, width), f.const(COS_COEFFICIENTS[9], DOUBLE, width)
    for k in range(7, 0, -1):
        s = f.fma(s, y, SIN_COEFFICIENTS[k])
    s = f.fma(s, y * x, x)
    for k in range(8, -1, -1):
        c = f.fma(c, y, COS_COEFFICIENTS[k])
    quarter = f.op(f"bitcast {T} {shifted.name} to {integers}", INT, width)

    def bit(j: Value, mask: int) -> Value:
        return f.logic("and", j, mask).is_not(0)

    odd, minus_s, minus_c = bit(quarter, 1), bit(quarter, 2), bit(quarter + 1, 2)
    sine, cosine = f.select(odd, c, s), f.select(odd, s, c)
    return f.select(minus_s, -sine, sine), f.select(minus_c, -cosine, cosine)
