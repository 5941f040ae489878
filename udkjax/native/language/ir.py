"""A thin layer over LLVM's text: values with operators, variables, loops and branches.

A `Function` is a function of LLVM's text, to which its methods append instructions; docstrings describe the effect of these
instructions when the function runs. The same calls write it for one state or for W states in SIMD lanes: wide values are vectors
of W lanes, or plain numbers if W is one; numbers are broadcast to wide values. All lanes take the same branch, which is taken if
`any_of` the lanes needs it; lanes differ only by `select`.
"""

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from typing import Any

from udkjax.native.language.values import BOOL, DOUBLE, INT, POINTER, Operand, Product, Value, literal, llvm_type

_COMPARE = {
    "lt": ("olt", "slt"),
    "le": ("ole", "sle"),
    "gt": ("ogt", "sgt"),
    "ge": ("oge", "sge"),
    "eq": ("oeq", "eq"),
    "ne": ("une", "ne"),
}

SHARED_SPACE, LOCAL_SPACE = 3, 5  # of the memory of a block and of one thread, in NVPTX


class Variable:
    """A variable of a function, read and assigned by `value`; LLVM keeps it in a register if it can."""

    def __init__(self, f: "Function", base: str, width: int):
        self.f, self.base, self.width = f, base, width
        self.place = f.reserve(llvm_type(base, width))

    @property
    def value(self) -> Value:
        return self.f.op(f"load {llvm_type(self.base, self.width)}, ptr {self.place}", self.base, self.width)

    @value.setter
    def value(self, new: Operand):
        new = self.f.like(new, self.base, self.width)
        self.f.line(f"store {new.type} {new.name}, ptr {self.place}")

    def where(self, mask: Value, new: Operand):
        """Assign `new` in the lanes in which `mask` is true; other lanes keep their values."""
        self.value = self.f.select(mask, self.f.like(new, self.base, self.width), self.value)


class Function:
    """A function of LLVM's text, to which methods append instructions.

    Methods that compute something return a `Value`: the name of the result in the text.

    Args:
        name: The name of the function.
        arguments: The base type (`DOUBLE`, `POINTER`, ...) and the name of each argument. The argument x is the value `given[x]`.
        width: The number of lanes W.
        returns: The type of the result in LLVM's text.
        cold: Whether the function is so rarely called that it is not optimized: LLVM's optimizations would take longer than
            they save.
    """

    def __init__(
        self, name: str, arguments: Sequence[tuple[str, str]], width: int = 1, returns: str = "void", cold: bool = False
    ):
        self.name, self.width, self.returns, self.cold = name, width, returns, cold
        self.noinline = False  # whether inlining is forbidden
        self._arguments, self._lines, self._reserved = list(arguments), [], []
        self._count, self.declared = 0, set()
        self.evaluated: dict[str, Function] = {}  # functions called by `evaluate`; the same module has to define them
        self.given = {n: Value(self, f"%{n}", base) for base, n in arguments}
        self.given["block_memory"] = Value(self, "%block_memory", POINTER)  # memory of the block, in a thread of a GPU

    # --- text

    def line(self, text: str):
        self._lines.append(text)

    def op(self, text: str, base: str, width: int = 1) -> Value:
        self._count += 1
        name = f"%t{self._count}"
        self._lines.append(f"{name} = {text}")
        return Value(self, name, base, width)

    def reserve(self, type_: str, count: int = 1) -> str:
        """Reserve memory on the stack of the function; return its address."""
        self._count += 1
        name = f"%m{self._count}"
        self._reserved.append(f"{name} = alloca {type_}, i64 {count}, align 64")
        return name

    def text(self, local: Collection[str] | None = None) -> str:
        """Return the definition of this function in LLVM's text; `declared` has the declarations of the intrinsics that it calls.

        Args:
            local: None for a function of the CPU. For a function that each thread of a GPU runs, the names of the arguments that
                point to the thread's own memory; empty if there are none, or to run such a function on this processor. Each of
                these pointers is cast once to its address space, which LLVM then infers for the addresses computed from it. The
                function is not inlined, as each copy would take room in the instruction cache.
        """
        casts, names = [], {n: n for _, n in self._arguments}
        for base, n in self._arguments:
            if base == POINTER and n in (local or ()):
                names[n] = f"{n}.given"
                casts.append(f"%{n}.local = addrspacecast ptr %{n}.given to ptr addrspace({LOCAL_SPACE})")
                casts.append(f"%{n} = addrspacecast ptr addrspace({LOCAL_SPACE}) %{n}.local to ptr")
        if any("ptr %block_memory" in line for line in self._lines):
            casts.append(
                f"%block_memory = addrspacecast ptr addrspace({SHARED_SPACE}) @block_memory to ptr"
                if local
                else "%block_memory = getelementptr i8, ptr @block_memory, i64 0"
            )
        arguments = ", ".join(f"{base}{' noalias' if base == POINTER else ''} %{names[n]}" for base, n in self._arguments)
        end = "ret void" if self.returns == "void" else None
        body = "\n  ".join([*casts, *self._reserved, *self._lines, *([end] if end else [])])
        attributes = " cold noinline optnone" if self.cold else " noinline" if self.noinline else ""
        if local is not None:  # arrays of vectors are aligned (`Layout`), and aligned ones are read by fewer instructions
            attributes, body = " noinline", re.sub(r"((?:load|store) <.*), align 8", r"\1, align 16", body)
        return f"define {self.returns} @{self.name}({arguments}){attributes} {{\n  {body}\n}}\n"

    # --- values

    def const(self, number: Any, base: str = DOUBLE, width: int = 1) -> Value:
        digits = literal(number, base)
        return Value(self, digits if width == 1 else f"<{', '.join([f'{base} {digits}'] * width)}>", base, width)

    def like(self, x: Operand, base: str, width: int) -> Value:
        """Return `x` with the base type `base` in `width` lanes: numbers become constants, single values are repeated."""
        if not isinstance(x, Value):
            return self.const(x, base, width)
        if x.base == INT and base == DOUBLE:
            x = self.op(f"sitofp {x.type} {x.name} to {llvm_type(DOUBLE, x.width)}", DOUBLE, x.width)
        if x.base == BOOL and base != BOOL:
            cast = "uitofp" if base == DOUBLE else "zext"
            x = self.op(f"{cast} {x.type} {x.name} to {llvm_type(base, x.width)}", base, x.width)
        if x.base != base:
            raise TypeError(f"{x.base} for {base}")
        return x if x.width == width else self.repeat(x, width)

    def repeat(self, x: Value, width: int) -> Value:
        """Return a value of one lane repeated in `width` lanes."""
        if x.width != 1:
            raise TypeError(f"{x.width} lanes for {width}")
        if width == 1:
            return x
        kind = llvm_type(x.base, width)
        first_lane = self.op(f"insertelement {kind} poison, {x.base} {x.name}, i64 0", x.base, width)
        return self.op(f"shufflevector {kind} {first_lane.name}, {kind} poison, <{width} x i32> zeroinitializer", x.base, width)

    def both(self, a: Operand, b: Operand) -> tuple[Value, Value]:
        """Convert two operands to one type with the same number of lanes."""
        if isinstance(a, Value) and isinstance(b, Value) and a.base == b.base and a.width == b.width:
            return a, b
        width = max(x.width for x in (a, b) if isinstance(x, Value))
        bases = [x.base for x in (a, b) if isinstance(x, Value)]
        base = DOUBLE if DOUBLE in bases else bases[0]
        return self.like(a, base, width), self.like(b, base, width)

    def arithmetic(self, kind: str, a: Operand, b: Operand) -> Value:
        """Return the sum, difference, product or quotient of two operands, as `kind` is "add", "sub", "mul" or "div".

        A product in a sum is fused to a multiply-add here and not by LLVM, whose optimization levels would round differently.
        """
        x, y = self.both(a, b)
        if x.base != DOUBLE:
            return self.op(f"{'sdiv' if kind == 'div' else kind} {x.type} {x.name}, {y.name}", x.base, x.width)
        if kind == "sub" and (x.product or y.product):
            kind, y = "add", -y
        if kind == "add":
            for product, other in ((x.product, y), (y.product, x)):
                if product:
                    return self.fma(-product.a if product.is_negative else product.a, product.b, other)
        result = self.op(f"f{kind} {x.type} {x.name}, {y.name}", DOUBLE, x.width)
        if kind == "mul":
            result.product = Product(x, y)
        return result

    def compare(self, kind: str, a: Operand, b: Operand) -> Value:
        x, y = self.both(a, b)
        of_doubles, of_integers = _COMPARE[kind]
        if x.base == BOOL:  # one bit: as a signed number, true would be -1
            of_integers = of_integers.replace("s", "u")
        name = f"fcmp {of_doubles}" if x.base == DOUBLE else f"icmp {of_integers}"
        return self.op(f"{name} {x.type} {x.name}, {y.name}", BOOL, x.width)

    def logic(self, kind: str, a: Operand, b: Operand) -> Value:
        x, y = self.both(a, b)
        return self.op(f"{kind} {x.type} {x.name}, {y.name}", x.base, x.width)

    def select(self, mask: Value, yes: Operand, no: Operand) -> Value:
        values = [x for x in (yes, no) if isinstance(x, Value)]
        base = values[0].base if values else DOUBLE
        width = max(mask.width, *(x.width for x in values)) if values else mask.width
        a, b = self.like(yes, base, width), self.like(no, base, width)
        mask = mask if mask.width in (width, 1) else self.repeat(mask, width)
        return self.op(f"select {mask.type} {mask.name}, {a.type} {a.name}, {b.type} {b.name}", base, width)

    def intrinsic(self, name: str, *arguments: Operand) -> Value:
        """Call an intrinsic function of LLVM on numbers, lane by lane: fmuladd, sqrt, fabs, maximum, floor, ..."""
        width = max((x.width for x in arguments if isinstance(x, Value)), default=1)
        values = [self.like(x, DOUBLE, width) for x in arguments]
        kind = llvm_type(DOUBLE, width)
        full = f"llvm.{name}.{'f64' if width == 1 else f'v{width}f64'}"
        self.declared.add(f"declare {kind} @{full}({', '.join([kind] * len(values))})")
        return self.op(f"call {kind} @{full}({', '.join(f'{kind} {v.name}' for v in values)})", DOUBLE, width)

    def fma(self, a: Operand, b: Operand, c: Operand) -> Value:
        """Return a b + c, rounded once if the processor has fused multiply-add, else twice; never by a library call."""
        return self.intrinsic("fmuladd", a, b, c)

    def abs(self, a: Value) -> Value:
        return self.intrinsic("fabs", a)

    def max(self, a: Operand, b: Operand) -> Value:
        """Return the larger of two numbers, or b if either is NaN; a single instruction."""
        x, y = self.both(a, b)
        return self.select(x > y, x, y)

    def min(self, a: Operand, b: Operand) -> Value:
        """Return the smaller of two numbers, or b if either is NaN."""
        x, y = self.both(a, b)
        return self.select(x < y, x, y)

    def is_finite(self, a: Value) -> Value:
        return self.abs(a) < float("inf")

    def largest_of(self, x: Value) -> Value:
        """Return the maximum over lanes; NaN is not allowed."""
        return self._halved(x, self.max)

    def total(self, x: Value) -> Value:
        """Return the sum over lanes: both halves of the lanes are added until one lane is left."""
        return self._halved(x, lambda a, b: a + b)

    def _halved(self, x: Value, join: Callable[[Value, Value], Value]) -> Value:
        if x.width & (x.width - 1):
            return reduce(join, (self.op(f"extractelement {x.type} {x.name}, i64 {k}", x.base) for k in range(x.width)))
        while x.width > 1:
            half, lanes = x.width // 2, range(x.width)
            shuffle = f"shufflevector {x.type} {x.name}, {x.type} poison, <{half} x i32>"
            parts = [", ".join(f"i32 {k}" for k in half_of_lanes) for half_of_lanes in (lanes[:half], lanes[half:])]
            halves = [f"{shuffle} <{part}>" for part in parts]
            if half == 1:
                halves = [f"extractelement {x.type} {x.name}, i64 {k}" for k in lanes]
            x = join(*(self.op(text, x.base, half) for text in halves))
        return x

    def reduce(self, name: str, x: Value) -> Value:
        """Return all lanes joined to one value by the reduction `name` of LLVM, for example "or" of conditions."""
        if x.width == 1:
            return x
        full = f"llvm.vector.reduce.{name}.v{x.width}{'f64' if x.base == DOUBLE else x.base}"
        self.declared.add(f"declare {x.base} @{full}({x.type})")
        return self.op(f"call {x.base} @{full}({x.type} {x.name})", x.base)

    def any_of(self, mask: Value) -> Value:
        return self.reduce("or", mask)

    def all_of(self, mask: Value) -> Value:
        return self.reduce("and", mask)

    def lane(self, x: Value, k: Value) -> Value:
        """Return the number in lane k."""
        if x.width == 1:
            return x
        return self.op(f"extractelement {x.type} {x.name}, i64 {k.name}", x.base)

    def only(self, k: Value) -> Value:
        """Return the mask that selects only lane k."""
        if self.width == 1:
            return self.const(True, BOOL)
        lanes = Value(self, f"<{', '.join(f'i64 {j}' for j in range(self.width))}>", INT, self.width)
        return lanes.is_(k)

    # --- memory

    def at(self, pointer: Value | str, k: Operand, base: str = DOUBLE) -> Value:
        """Return the address of the k-th number from a pointer; stored pointers occupy 8 bytes on all targets."""
        name = pointer.name if isinstance(pointer, Value) else pointer
        index, stored = self.like(k, INT, 1), INT if base == POINTER else base
        return self.op(f"getelementptr {stored}, ptr {name}, i64 {index.name}", POINTER)

    def distance(self, pointer: Value, other: Value) -> Value:
        """Return the number of 8-byte words from the address `pointer` to the address `other`."""
        first, last = (self.op(f"ptrtoint ptr {x.name} to i64", INT) for x in (pointer, other))
        return self.op(f"ashr exact i64 {(last - first).name}, 3", INT)

    def load(self, pointer: Value | str, k: Operand = 0, width: int = 1, base: str = DOUBLE) -> Value:
        place = self.at(pointer, k, base)
        return self.op(f"load {llvm_type(base, width)}, ptr {place.name}, align 8", base, width)

    def store(self, x: Operand, pointer: Value, k: Operand = 0, width: int = 1, base: str = DOUBLE):
        x = self.like(x, base, width)
        place = self.at(pointer, k, base)
        self.line(f"store {x.type} {x.name}, ptr {place.name}, align 8")

    def variable(self, start: Operand, base: str = DOUBLE, width: int | None = None) -> Variable:
        variable = Variable(self, base, self.width if width is None else width)
        variable.value = start
        return variable

    def evaluate(self, function: "Function", *arguments: Value) -> Value:
        """Return the result of a function: float64 numbers, in as many lanes as its arguments have.

        The module that contains this function has to define the called one, too (`with_evaluated`).
        """
        self.evaluated[function.name] = function
        given = ", ".join(f"{a.type} {a.name}" for a in arguments)
        return self.op(f"call {function.returns} @{function.name}({given})", DOUBLE, arguments[0].width)

    def call(self, name: str, *arguments: Value):
        self.line(f"call void @{name}({', '.join(f'{a.type} {a.name}' for a in arguments)})")

    # --- control

    def _label(self, name: str) -> str:
        self._count += 1
        return f"{name}{self._count}"

    def is_null(self, pointer: Value) -> Value:
        return self.op(f"ptrtoint ptr {pointer.name} to i64", INT).is_(0)

    def leave(self, result: str = "void"):
        """Return from the function. Instructions that follow in the same block are never reached."""
        self.line(f"ret {result}")
        self.line(f"{self._label('after')}:")

    @contextmanager
    def if_(self, condition: Value) -> Iterator[None]:
        """Run the code written in the `with` block if a condition (in one lane) holds."""
        then, end = self._label("then"), self._label("end")
        self.line(f"br i1 {condition.name}, label %{then}, label %{end}")
        self.line(f"{then}:")
        yield
        self.line(f"br label %{end}")
        self.line(f"{end}:")

    def choose(self, condition: Value, then: Callable[[], None], otherwise: Callable[[], None]):
        """Run the code that `then()` writes if a condition holds, otherwise the code that `otherwise()` writes."""
        yes, no, end = self._label("then"), self._label("else"), self._label("end")
        self.line(f"br i1 {condition.name}, label %{yes}, label %{no}")
        for label, do in ((yes, then), (no, otherwise)):
            self.line(f"{label}:")
            do()
            self.line(f"br label %{end}")
        self.line(f"{end}:")

    @contextmanager
    def while_(self, condition: Callable[[], Value]) -> Iterator[None]:
        """Run the code written in the `with` block while `condition()` holds, which is evaluated before each iteration."""
        head, body, end = self._label("while"), self._label("do"), self._label("end")
        self.line(f"br label %{head}")
        self.line(f"{head}:")
        self.line(f"br i1 {condition().name}, label %{body}, label %{end}")
        self.line(f"{body}:")
        yield
        self.line(f"br label %{head}")
        self.line(f"{end}:")

    @contextmanager
    def each(self, end: Operand, start: Operand = 0) -> Iterator[Value]:
        """Run the code written in the `with` block for every integer from `start` to `end` - 1; yield this integer."""
        k = self.variable(start, INT, 1)
        last = self.like(end, INT, 1)
        with self.while_(lambda: k.value < last):
            yield k.value
            k.value = k.value + 1
