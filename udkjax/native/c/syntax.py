"""The syntax of C for numbers, addresses and functions of LLVM's text."""

import re
import struct
from dataclasses import dataclass, field

TYPES = {"double": "double", "i64": "int64_t", "i1": "int", "i32": "int32_t", "i8": "char"}


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
    """An expression that is written where it is used, and the variables on which it depends."""

    text: str
    kind: str
    reads: set[str]
    element: str = "double"


def pointer_type(element: str) -> str:
    """Return the type of addresses of numbers; tables and the call record are constant."""
    return f"{'const ' if element in ('i32', 'i64') else ''}{TYPES[element]} *"


def function_head(f: FunctionText) -> str:
    """Return the head of a function's definition."""
    arguments = [f"{pointer_type(f.elements[n])}{n}" if kind == "ptr" else f"{TYPES[kind]} {n}" for kind, n in f.arguments]
    return f"{'void' if f.returns == 'void' else TYPES[f.returns]} {f.name}({', '.join(arguments)})"


def literal(text: str, kind: str) -> str:
    """Return a constant of LLVM's text in C."""
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
    """Return a number in C, exactly."""
    if number != number:
        return "NAN"
    if abs(number) == float("inf"):
        return "-INFINITY" if number < 0 else "INFINITY"
    return repr(float(number))


def operand(text: str) -> str:
    """Return an expression as an operand."""
    if re.fullmatch(r"[\w.]+|\w+\([^()]*\)|\w+\[[^\[\]]*\]", text) or _is_call(text):
        return text
    return f"({text})"


def array_and_index(address: str) -> tuple[str, str]:
    """Return the parts of `&array[index]`."""
    depth = 0
    for k in range(len(address) - 1, 0, -1):
        depth += (address[k] == "]") - (address[k] == "[")
        if depth == 0:
            return address[1:k], address[k + 1 : -1]
    raise ValueError(f"no address: {address}")


def _is_call(text: str) -> bool:
    """Return True for a call or an entry as a whole: its brackets close at the end."""
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
    """Return the number at an address."""
    return e.text[1:] if e.text.startswith("&") else f"*{operand(e.text)}" if not re.fullmatch(r"\w+", e.text) else f"{e.text}[0]"
