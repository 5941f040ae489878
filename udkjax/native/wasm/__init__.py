"""Modules of the engine as WebAssembly, for pages that simulate: the same text, compiled by the same LLVM for another target.

`wasm_module` compiles an operation, `evaluation_module` the evaluation of single states, and `hosted_module` functions of JAX
that call functions of a page (hosted.py). `compile_wasm` compiles a text (target.py), and `link` converts LLVM's object code to a
loadable module (object_code.py); no linker is needed, as modules consist of a single object.
"""

from udkjax.native.wasm.hosted import HostedModule, hosted_module
from udkjax.native.wasm.target import WasmModule, compile_wasm, evaluation_module, wasm_module

__all__ = ["HostedModule", "WasmModule", "compile_wasm", "evaluation_module", "hosted_module", "wasm_module"]
