"""The text of a module, made of its functions, and the external functions that it calls."""

import re
from collections.abc import Collection, Iterable, Sequence

from udkjax.native.language.ir import Function

ALLOCATION_DECLARATIONS = ("declare ptr @malloc(i64)", "declare void @free(ptr)")
# Intrinsics that LLVM writes as instructions for each target
INSTRUCTIONS = frozenset(
    (
        "fmuladd",
        "sqrt",
        "fabs",
        "copysign",
        "floor",
        "ceil",
        "trunc",
        "roundeven",
        "fptosi",
        "fptoui",
        "maximum",
        "minimum",
        "vector",
    )
)


def with_evaluated(functions: Iterable[Function]) -> list[Function]:
    """Return functions, followed by all functions in their `evaluated`, which they call and which their module has to define."""
    functions, evaluated = list(functions), {}
    for f in functions:
        evaluated |= f.evaluated
    return [*functions, *(evaluated[name] for name in sorted(evaluated))]


def text_of_module(
    functions: Iterable[Function],
    globals: Sequence[str] = (),
    declared: Sequence[str] = (),
    local: Collection[str] | None = None,
    shared: Sequence[Function] = (),
) -> str:
    """Return the text of a module that defines functions and all functions in their `evaluated`.

    Args:
        functions: The functions.
        globals: Definitions of constants, one line each.
        declared: Declarations in addition to those of the functions.
        local: For the thread of a GPU, the names of the arguments that point to its own memory (`Function.text`).
        shared: For the thread of a GPU, further functions, whose arguments may point to any memory.
    """
    functions = list(functions)
    others = with_evaluated([*functions, *shared])[len(functions) :]
    heads = sorted({*declared}.union(*(f.declared for f in (*functions, *others))))
    texts = [*(f.text(local) for f in functions), *(f.text(None if local is None else ()) for f in others)]
    return "\n".join([*heads, *globals, *texts])


def apart(names: Iterable[str]) -> str:
    """Return a comment for the text of a module that names the functions to compile apart from all others (machine.py)."""
    return f"; apart {' '.join(sorted(names))}"


def named_apart(text: str) -> frozenset[str]:
    """Return the names of the functions that the text of a module names by `apart`; empty if it has no such comment."""
    found = re.search(r"^; apart (.*)$", text, re.MULTILINE)
    return frozenset(found[1].split()) if found else frozenset()


def external_functions(declarations: str) -> frozenset[str]:
    """Return the names of the functions that a module calls but does not define, from its text or its declarations.

    Intrinsics that LLVM writes as instructions are not among them.

    In the engine's modules only functions of memory management are external (malloc, free, realloc). Whoever compiles a
    module for a target without a C library must supply them, or refuse the module.
    """
    declared = re.findall(r"^declare [^@\n]*@([\w.]+)", declarations, re.MULTILINE)
    return frozenset(name for name in declared if not _is_instruction(name))


def _is_instruction(name: str) -> bool:
    library, _, rest = name.partition(".")
    return library == "llvm" and rest.split(".")[0] in INSTRUCTIONS
