"""Conversion of WebAssembly object code by LLVM to a loadable module, with exports and without sections for linkers.

In an object all functions have their final indices, and data begin at address 0, so nothing has to be relocated; the memory and
the stack pointer are imports. An object has no export section: the indices of its functions are in the symbol table, in the
section "linking" (Linking.md of the tool conventions).
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

MAGIC = b"\0asm\1\0\0\0"
CUSTOM, IMPORTS, EXPORTS, DATA = 0, 2, 7, 11  # section ids; sections are in this order, except the data count before the code
SYMBOL_TABLE = 8  # subsection of "linking"
FUNCTION_SYMBOL, DATA_SYMBOL, SECTION_SYMBOL = 0, 1, 3  # kinds of symbols; all others have an index like functions
UNDEFINED_FLAG, EXPLICIT_NAME = 0x10, 0x40  # flags of symbols
I32_CONST = 0x41  # the opcode


class LinkedModule(NamedTuple):
    """A loadable module and its imports.

    Attributes:
        code: its bytes.
        imports: the names of the functions that it imports from "env".
        data_end: the end (bytes) of its constants in memory, which begin at 0.
    """

    code: bytes
    imports: tuple[str, ...]
    data_end: int


class Reader:
    """A reader of numbers and names from bytes, one after another; it is true as long as bytes are left."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def __bool__(self) -> bool:
        return self.at < len(self.data)

    def byte(self) -> int:
        """Read one byte as an integer."""
        return self.take(1)[0]

    def take(self, count: int) -> bytes:
        """Read `count` bytes."""
        self.at += count
        return self.data[self.at - count : self.at]

    def number(self) -> int:
        """Read an unsigned integer in LEB128."""
        value = shift = 0
        while True:
            byte = self.byte()
            value, shift = value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value

    def block(self) -> bytes:
        """Read bytes that follow their count."""
        return self.take(self.number())

    def name(self) -> str:
        """Read a string that follows its length."""
        return self.block().decode()


def leb128(value: int) -> bytes:
    """Return the bytes of a nonnegative integer in LEB128."""
    digits = bytearray()
    while value > 127:
        digits.append(value & 127 | 128)
        value >>= 7
    return bytes([*digits, value])


def link(code: bytes, exports: Sequence[str]) -> LinkedModule:
    """Convert an object to a loadable module that exports the functions of some names.

    Raises:
        ValueError: a function is missing, or the bytes are not object code by LLVM.
    """
    sections = list(_sections(code))
    numbers = _function_numbers(sections)
    missing = [name for name in exports if name not in numbers]
    if missing:
        raise ValueError(f"the module has no function {missing[0]!r}")
    entries = (leb128(len(name)) + name.encode() + b"\0" + leb128(numbers[name]) for name in exports)
    exported = leb128(len(exports)) + b"".join(entries)
    linked = [(kind, body) for kind, body in sections if kind != CUSTOM]
    place = next(k for k, (kind, _) in enumerate([*linked, (EXPORTS + 1, b"")]) if kind > EXPORTS)
    linked.insert(place, (EXPORTS, exported))
    module = MAGIC + b"".join(bytes([kind]) + leb128(len(body)) + body for kind, body in linked)
    bodies = dict(linked)
    return LinkedModule(module, tuple(_imported_functions(bodies[IMPORTS])), _data_end(bodies.get(DATA, b"\0")))


def _sections(code: bytes) -> Iterator[tuple[int, bytes]]:
    reader = Reader(code)
    if reader.take(len(MAGIC)) != MAGIC:
        raise ValueError("not a WebAssembly module: wrong magic bytes or version")
    while reader:
        yield reader.byte(), reader.block()


def _function_numbers(sections: Sequence[tuple[int, bytes]]) -> dict[str, int]:
    """Return the index of each defined function, from the symbol table."""
    numbers = {}
    for kind, body in sections:
        reader = Reader(body)
        if kind != CUSTOM or reader.name() != "linking":
            continue
        reader.number()  # the version
        while reader:
            part, table = reader.byte(), Reader(reader.block())
            if part != SYMBOL_TABLE:
                continue
            for _ in range(table.number()):
                symbol, name, number = _symbol(table)
                if symbol == FUNCTION_SYMBOL and name:
                    numbers[name] = number
    return numbers


def _symbol(table: Reader) -> tuple[int, str, int]:
    """Read a symbol; return its kind, its name ("" unless it is defined in this object), and its index."""
    kind, flags = table.byte(), table.number()
    defined = not flags & UNDEFINED_FLAG
    if kind == DATA_SYMBOL:
        table.block()
        for _ in range(3 if defined else 0):  # segment, offset, size
            table.number()
        return kind, "", 0
    number = table.number()
    if kind == SECTION_SYMBOL:
        return kind, "", number
    name = table.name() if defined or flags & EXPLICIT_NAME else ""
    return kind, name if defined else "", number


def _imported_functions(body: bytes) -> Iterator[str]:
    reader = Reader(body)
    for _ in range(reader.number()):
        reader.name()
        name, kind = reader.name(), reader.byte()
        if kind == FUNCTION_SYMBOL:
            yield name
        _skip_type(reader, kind)


def _skip_type(reader: Reader, kind: int):
    """Skip the type of an import: a function, a table, a memory or a global."""
    if kind in (1, 2):
        if kind == 1:
            reader.byte()
        flags = reader.number()
        reader.number()
        if flags & 1:
            reader.number()
        return
    reader.number()
    if kind == 3:
        reader.byte()


def _data_end(body: bytes) -> int:
    """Return the end (bytes) of the last data segment in memory; 0 without data."""
    reader, end = Reader(body), 0
    for _ in range(reader.number()):
        if reader.number() or reader.byte() != I32_CONST:
            raise ValueError("the offset of a data segment is not constant")
        start = reader.number()
        reader.byte()  # the end of the expression
        end = max(end, start + len(reader.block()))
    return end
