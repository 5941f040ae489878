"""The compiler for WebAssembly: 32-bit addresses, registers of two float64, no fused multiply-add. Its code is stored on disk.

The same text of LLVM holds there: the record that `run` is called with has fields of 8 bytes, of which addresses take
four; a product and a sum are rounded each. Functions that are no instructions (exp, pow, atan2) and the memory of a run (malloc,
free) are imports.
"""

from functools import cache
from typing import Any, NamedTuple

from udkjax.native.base import code_cache, machine
from udkjax.native.base.memory import Memory
from udkjax.native.operations import Operation
from udkjax.native.wasm.object_code import LinkedModule, link

TRIPLE = "wasm32-unknown-unknown"
# Every browser of the last years has these: Chrome 91, Firefox 89, Safari 16.4.
FEATURES = "+simd128,+bulk-memory,+nontrapping-fptoint,+sign-ext,+mutable-globals"
LANES = 2  # float64 numbers in a register


class WasmModule(NamedTuple):
    """A module of the engine: its code, and the module of which it knows how it is called."""

    linked: LinkedModule
    module: Memory


def wasm_module(operation: Operation) -> WasmModule:
    """Compile an operation of one member at a time; the module exports `run`, which takes the address of its record.

    Args:
        operation: Any of `native.operations`.

    Returns:
        The module; `module.call_fields` are the fields of the record, 8 bytes each (memory.py).

    Raises:
        UnsupportedError: the operation takes what machine code has no instruction for.
    """
    module = operation.module(1, 1, LANES)
    module.written_text = module.text()
    return WasmModule(compile_wasm(module.written_text, ("run",)), module)


def compile_wasm(text: str, exports: tuple[str, ...]) -> LinkedModule:
    """Return a module that exports some functions of LLVM's text: from disk, or compiled and put there."""
    key = machine.digest("\0".join((TRIPLE, FEATURES, text)))
    code = code_cache.read(key)
    if code is None:
        target = _llvm().Target.from_triple(TRIPLE)
        options = {"cpu": "generic", "features": FEATURES, "opt": machine.LEVEL, "reloc": "static", "codemodel": "small"}
        code = machine.object_code(text, target.create_target_machine(**options), TRIPLE)
        code_cache.write(key, code)
    return link(code, exports)


@cache
def _llvm() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    return llvm
