"""The compiler for WebAssembly: 32-bit addresses, registers of two float64, no fused multiply-add. Its code is stored on disk.

LLVM's text is the same: the call record of `run` has fields of 8 bytes, of which addresses use four; products and sums are
rounded separately. The functions of memory management (malloc, free) are imports.
"""

from collections.abc import Sequence
from typing import NamedTuple

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.native.code import code_cache, machine
from udkjax.native.language.ir import Function
from udkjax.native.module.memory import Memory
from udkjax.native.operations import Operation
from udkjax.native.run.state_functions import Evaluation
from udkjax.native.wasm.object_code import LinkedModule, link

TRIPLE = "wasm32-unknown-unknown"
# Features of browsers since Chrome 91, Firefox 89 and Safari 16.4.
FEATURES = "+simd128,+bulk-memory,+nontrapping-fptoint,+sign-ext,+mutable-globals"
LANES = 2  # float64 numbers in a register


class WasmModule(NamedTuple):
    """The WebAssembly code of a module, and the module, which describes its call record."""

    linked: LinkedModule
    module: Memory


def wasm_module(operation: Operation) -> WasmModule:
    """Compile an operation for one member at a time; the module exports `run`, which takes the address of its call record.

    Args:
        operation: An operation of `native.operations`.

    Returns:
        The module; `module.call_fields` are the fields of the record, 8 bytes each (memory.py).

    Raises:
        UnsupportedError: machine code does not support the operation.
    """
    module = operation.module(1, 1, LANES)
    module.is_interruptible = False  # pyright: ignore[reportAttributeAccessIssue]
    module.written_text = module.text()
    return WasmModule(compile_wasm(module.written_text, ("run",)), module)


def evaluation_module(code: RunPrograms, further: Sequence[Function]) -> tuple[LinkedModule, Evaluation]:
    """Compile the functions that evaluate a scene at single states, and further ones, among which is a function `numbers`.

    Returns:
        The module, and the evaluation, which describes its functions and its memory.
    """
    evaluation = Evaluation(code, further)
    return compile_wasm(evaluation.text(), ("numbers", *evaluation.exports)), evaluation


def compile_wasm(text: str, exports: tuple[str, ...]) -> LinkedModule:
    """Return the WebAssembly module of LLVM's text, which exports some functions, from the cache on disk or newly compiled."""
    key = machine.digest("\0".join((TRIPLE, FEATURES, text)))
    code = code_cache.read(key)
    if code is None:
        target = machine.llvm_for_all_targets().Target.from_triple(TRIPLE)
        options = {
            "cpu": "generic",
            "features": FEATURES,
            "opt": machine.OPTIMIZATION_LEVEL,
            "reloc": "static",
            "codemodel": "small",
        }
        code = machine.object_code(text, target.create_target_machine(**options), TRIPLE)
        code_cache.write(key, code)
    return link(code, exports)
