"""Modules of the engine as WebAssembly, for pages that simulate: the same text, compiled for another processor by the same LLVM.

`wasm_module` makes the module of an operation, `compile_wasm` compiles a text (target.py), and `link` makes a module that a page
can load out of LLVM's object code (object_code.py): no linker is needed, since one object needs nothing of another one.
"""

from udkjax.native.wasm.target import WasmModule, compile_wasm, wasm_module

__all__ = ["WasmModule", "compile_wasm", "wasm_module"]
