"""C99 from the text of a module of machine code for one lane: each function of the module is a function of C.

The module's text is a small part of LLVM's language (language/ir.py): numbers, addresses, and branches that `Function` writes in
pairs. Instructions whose result is used once are joined to expressions; variables stay variables, and branches become `if`
and `while`. C computes the same operations in the same order, and rounds as machine code does if products are fused (`FMA`).
"""

import re
import struct
from collections.abc import Iterable, Mapping

from udkjax.native.c.body import FunctionBody
from udkjax.native.c.names import Names
from udkjax.native.c.syntax import C_TYPES, FunctionText, function_head, literal

VECTOR_TYPE = re.compile(r"<2 x (\w+)>")  # of two numbers, the second of which no one uses (language/elementary/parts.py)
PREAMBLE = """#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#endif

/* a b + c, rounded once where the processor has such an instruction (-march=native, -mfma), as in udkjax on such a processor. */
#ifdef FP_FAST_FMA
#define FMA(a, b, c) fma(a, b, c)
#else
#define FMA(a, b, c) ((a) * (b) + (c))
#endif
"""
HELPERS = {
    "maximum": "double maximum(double a, double b) { return a > b || a != a ? a : b; }",
    "minimum": "double minimum(double a, double b) { return a < b || a != a ? a : b; }",
    "bits_of": "int64_t bits_of(double x) { int64_t k; memcpy(&k, &x, sizeof k); return k; }",
    "from_bits": "double from_bits(int64_t k) { double x; memcpy(&x, &k, sizeof x); return x; }",
    "load_integer": "int64_t load_integer(const void *p) { int64_t k; memcpy(&k, p, sizeof k); return k; }",
    "store_integer": "void store_integer(void *p, int64_t k) { memcpy(p, &k, sizeof k); }",
    "load_address": "double *load_address(const void *p) { return (double *)(intptr_t)load_integer(p); }",
    "store_address": "void store_address(void *p, const void *x) { store_integer(p, (int64_t)(intptr_t)x); }",
}
NEEDED_HELPERS = {"load_address": "load_integer", "store_address": "store_integer"}


def translated(text: str, entry: str, names: Names, meanings: Mapping[str, str] | None = None) -> str:
    """Return C99 of the function `entry` of a module, and of all functions that it calls; all are static.

    Args:
        text: LLVM's text of the module, of one lane.
        entry: the name of the function.
        names: the names of places in memory and of fields of the call record.
        meanings: comments on places, by the names of arrays.
    """
    functions = {f.name: f for f in _functions(text)}
    order = _reachable(functions, entry)
    known = {name: functions[name] for name in order}
    _find_elements(known)
    bodies = {name: FunctionBody(known[name], known, names).text() for name in order}
    tables = [_table(line) for line in text.splitlines() if line.startswith("@") and " constant " in line]
    everything = "\n".join(bodies.values())
    tables = [(name, definition) for name, definition in tables if re.search(rf"\b{name}\b", everything)]
    prototypes = [f"static {function_head(known[name])};" for name in order]
    parts = [PREAMBLE, helpers(everything), names.text(meanings or {}, everything), "\n".join(x for _, x in tables)]
    own = [f"static {body}" for body in bodies.values()]
    return "\n".join([*parts, "\n".join(prototypes), "", "\n".join(own)])


def helpers(text: str) -> str:
    """Return the definitions of the `HELPERS` that a text in C calls, and of those that they need."""
    used = {name for name in HELPERS if re.search(rf"\b{name}\(", text)}
    used |= {NEEDED_HELPERS[name] for name in used if name in NEEDED_HELPERS}
    return "\n".join(f"static {definition}" for name, definition in HELPERS.items() if name in used)


def _functions(text: str) -> Iterable[FunctionText]:
    for match in re.finditer(
        r"^define (\w+) @(\w+)\(([^)]*)\)[^{]*\{\n(.*?)\n\}", VECTOR_TYPE.sub(r"\1", text), re.MULTILINE | re.DOTALL
    ):
        arguments = [(x.split()[0], x.split("%")[1]) for x in match[3].split(", ") if x]
        yield FunctionText(match[2], match[1], arguments, [line.strip() for line in match[4].split("\n")])


def _reachable(functions: Mapping[str, FunctionText], entry: str) -> list[str]:
    """Return the names of `entry` and of all functions that it calls, also indirectly, in the order of the text."""
    found, waiting = {entry}, [entry]
    while waiting:
        new = {x for x in functions[waiting.pop()].called if x in functions} - found
        found |= new
        waiting += new
    return [name for name in functions if name in found]


def _find_elements(functions: Mapping[str, FunctionText]):
    """Set `elements` of all functions: the types of the numbers to which arguments point, which their addresses tell."""
    for f in functions.values():
        for kind, name in f.arguments:
            if kind == "ptr":
                uses = [m[1] for line in f.lines if (m := re.search(rf"getelementptr (\w+), ptr %{re.escape(name)},", line))]
                f.elements[name] = "i32" if "i32" in uses else "i64" if uses and {*uses} == {"i64"} else "double"
        if "call" in f.elements:
            f.elements["call"] = "i64"


def _table(line: str) -> tuple[str, str]:
    """Return the name and the definition in C of a table of constants, from its line of LLVM's text."""
    name = re.match(r"@(\w+)", line)
    assert name
    if data := re.search(r'x i8\] c"(.*)"', line):
        values = bytes(int(x, 16) for x in data[1].split("\\")[1:])
        numbers, kind = [str(x) for x in struct.unpack(f"<{len(values) // 4}i", values)], "int32_t"
    else:
        match = re.search(r"\[\d+ x (\w+)\] \[(.*)\]", line)
        assert match, line
        numbers, kind = [literal(x.split()[1], match[1]) for x in match[2].split(", ")], C_TYPES[match[1]]
    rows = [", ".join(numbers[k : k + 12]) for k in range(0, len(numbers), 12)]
    return name[1], f"static const {kind} {name[1]}[] = {{{(',' + chr(10) + '    ').join(rows)}}};"
