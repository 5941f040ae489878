"""The syntax of C for numbers, addresses and functions of LLVM's text."""

import re
import struct
from dataclasses import dataclass, field

C_TYPES = {"double": "double", "i64": "int64_t", "i1": "int", "i32": "int32_t", "i8": "char"}


@dataclass
class FunctionText:
    """A function of LLVM's text."""

    name: str
    returns: str
    arguments: list[tuple[str, str]]  # types and names
    lines: list[str]
    elements: dict[str, str] = field(default_factory=dict)  # the types of numbers to which arguments point

    @property
    def called(self) -> set[str]:
        return {x for line in self.lines for x in re.findall(r"call \w+ @(\w+)\(", line)}


@dataclass
class CExpression:
    """An expression of C.

    Attributes:
        text: The expression.
        kind: The type of its value in LLVM's text.
        reads: The variables on which it depends, and "memory" if it loads a number.
        element: For an address, the type of the numbers there; "table" for a table of constants.
    """

    text: str
    kind: str
    reads: set[str]
    element: str = "double"


def pointer_type(element: str) -> str:
    """Return the type in C of addresses of numbers of the type `element`; tables (i32) and the call record (i64) are const."""
    return f"{'const ' if element in ('i32', 'i64') else ''}{C_TYPES[element]} *"


def function_head(f: FunctionText) -> str:
    """Return the head of a function's definition in C: the type of its result, its name and its arguments."""
    arguments = [f"{pointer_type(f.elements[n])}{n}" if kind == "ptr" else f"{C_TYPES[kind]} {n}" for kind, n in f.arguments]
    return f"{'void' if f.returns == 'void' else C_TYPES[f.returns]} {f.name}({', '.join(arguments)})"


def literal(text: str, kind: str) -> str:
    """Return a constant of LLVM's text, of the type `kind`, in C."""
    if text in ("poison", "undef", "zeroinitializer"):
        return "0"
    if text in ("true", "false"):
        return "1" if text == "true" else "0"
    if text == "null":
        return "0"
    if kind != "double":
        if int(text) == -(2**63):
            return "INT64_MIN"
        return f"INT64_C({text})" if abs(int(text)) >= 2**31 else text
    number = struct.unpack("<d", struct.pack("<Q", int(text, 16)))[0] if text.startswith("0x") else float(text)
    return number_text(number)


def number_text(number: float) -> str:
    """Return a number as a constant of C that has exactly the same value."""
    if number != number:
        return "NAN"
    if abs(number) == float("inf"):
        return "-INFINITY" if number < 0 else "INFINITY"
    return repr(float(number))


def operand(text: str) -> str:
    """Return an expression of C in parentheses, unless it needs none as an operand."""
    if re.fullmatch(r"[\w.]+|\w+\([^()]*\)|\w+\[[^\[\]]*\]", text) or _is_call(text):
        return text
    return f"({text})"


def array_and_index(address: str) -> tuple[str, str]:
    """Return the array and the index of an address `&array[index]`."""
    depth = 0
    for k in range(len(address) - 1, 0, -1):
        depth += (address[k] == "]") - (address[k] == "[")
        if depth == 0:
            return address[1:k], address[k + 1 : -1]
    raise ValueError(f"no address: {address}")


def _is_call(text: str) -> bool:
    """Return True if a text is one call or one entry of an array: its first bracket closes at the end."""
    match = re.match(r"\w+[(\[]", text)
    if not match:
        return False
    depth = 0
    for k, letter in enumerate(text):
        depth += (letter in "([") - (letter in ")]")
        if depth == 0 and letter in ")]":
            return k == len(text) - 1
    return False


def number_at(e: CExpression) -> str:
    """Return the expression of C for the number at an address."""
    return e.text[1:] if e.text.startswith("&") else f"*{operand(e.text)}" if not re.fullmatch(r"\w+", e.text) else f"{e.text}[0]"
