"""The C of one operation on one member, in memory that the caller provides, as a thread of a GPU runs it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

from udkjax.native.c.names import Names
from udkjax.native.c.translation import translated
from udkjax.native.language.ir import Function
from udkjax.native.language.text import text_of_module
from udkjax.native.module.layout import LANE_NUMBERS
from udkjax.native.module.memory import Memory
from udkjax.native.operations import Operation

ENTRY_FUNCTION = "run_member"  # of the text; its arguments are the call record, the memory, and the index of the member
FLOPS = {
    "fadd": 1,
    "fsub": 1,
    "fmul": 1,
    "fdiv": 1,
    "fneg": 0,
    "call double @llvm.fmuladd.f64": 2,
    "call double @llvm.sqrt.f64": 1,
}


@dataclass(frozen=True)
class CUnit:
    """The C of an operation: static functions, of which `run_member` runs one member.

    Attributes:
        text: the C.
        module: the module, which describes the call record.
        memory: the number of float64 numbers in the memory of a run.
        flops: the number of floating-point operations of each function: of both branches of each `if`, and of one pass of loops
            of unknown length.
    """

    text: str
    module: Memory
    memory: int
    flops: Mapping[str, int]

    def call_record(self, values: Mapping[str, str]) -> str:
        """Return statements of C that define the call record `call` of one member.

        `values` are expressions of C for fields, by name. Other fields are zero, except the numbers of members and directions,
        which are one, and `next`.
        """
        known = {name: k for k, name in enumerate(self.module.call_fields)}
        lines = [f"    int64_t next[2] = {{0, 0}}, call[{len(known)}] = {{0}};"]
        for name, value in ({"members": "1", "directions": "1", "next": "next"} | dict(values)).items():
            cast = "" if re.fullmatch(r"\d+|\w*times|knots|directions", value) else "(int64_t)(intptr_t)"
            lines.append(f"    call[{known[name]}] = {cast}{value}; /* {name} */")
        return "\n".join(lines)


def c_unit(operation: Operation, directions: int = 0) -> CUnit:
    """Translate an operation to C.

    Args:
        operation: an operation of `native.operations`.
        directions: the largest number of directions of its tangents.

    Returns:
        The C of the operation.

    Raises:
        UnsupportedError: machine code does not support the operation.
    """
    module = operation.module(1, 1, 1)
    ways = getattr(module, "ways", ())
    if ways:
        size = directions * len(ways) * module.tangents.size
        module.tangents_begin = module.places.add("all tangents", size)  # pyright: ignore[reportAttributeAccessIssue]
    code = module.thread_code()
    text = text_of_module([*code.functions, *code.shared], code.globals)
    places = dict(module.places.places)
    meanings = {name: words for name, words in LANE_NUMBERS.items() if name in places}
    c = translated(text, ENTRY_FUNCTION, Names(places, module.call_fields), meanings)
    return CUnit(c, module, code.size, count_operations(text))


def c_function(function: Function) -> str:
    """Return the C of one function, whose arguments are addresses of numbers, with the functions that it evaluates."""
    return translated(text_of_module([function]), function.name, Names({}, ()))


def count_operations(text: str) -> dict[str, int]:
    """Return the number of floating-point operations of each function of a module, with those of the functions that it calls."""
    bodies = {m[1]: m[2].split("\n") for m in re.finditer(r"^define [^@]*@(\w+)\([^{]*\{\n(.*?)\n\}", text, re.M | re.S)}

    @cache
    def count(name: str, length: int = 1) -> int:
        """Return the number of operations of a function whose loops over its argument `count` have this length."""
        total, factors, lines = 0, [1], bodies[name]
        for k, line in enumerate(lines):
            line = line.strip()
            operation = line.partition(" = ")[2] or line
            if re.match(r"while\d+:", line):
                ahead = "\n".join(lines[k : k + 4])
                times = re.search(r"icmp slt i64 %\S+, (%count|\d+)", ahead)
                factors.append(factors[-1] * (1 if not times else length if times[1] == "%count" else int(times[1])))
            elif line.startswith("br label %while") and len(factors) > 1 and f"{line.split('%')[1]}:" != lines[k + 1].strip():
                factors.pop()
            elif match := re.match(r"call \w+ @(\w+)\((.*)\)", operation):
                if match[1] in bodies:
                    last = match[2].split(" ")[-1]
                    total += factors[-1] * count(match[1], int(last) if last.isdigit() else 1)
            else:
                total += factors[-1] * next((n for word, n in FLOPS.items() if operation.startswith(word)), 0)
        return total

    return {name: count(name) for name in bodies}
