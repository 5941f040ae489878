"""Modules of the engine as WebAssembly, for pages that simulate: the same text, compiled by the same LLVM for another target.

`wasm_module` makes the module of an operation, `compile_wasm` compiles a text (target.py), and `link` converts LLVM's object code
to a loadable module (object_code.py); no linker is needed, as modules consist of a single object.
"""

from udkjax.native.wasm.target import WasmModule, compile_wasm, wasm_module

__all__ = ["WasmModule", "compile_wasm", "wasm_module"]
