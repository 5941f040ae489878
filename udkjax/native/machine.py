"""Machine code for this processor from LLVM's text, compiled on all cores and stored on disk.

A module is compiled in parts: each large function by itself, so that modules which share functions share their code, too.
"""

import ctypes
import hashlib
import itertools
import os
import re
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

from udkjax.native import code_cache

LEVEL = 1  # of code generation: 2 takes a fifth longer, and runs take as long
# Optimizations of the text before that. Programs come without common subexpressions and dead code: all that LLVM's own selection
# of level 1 adds is two percent of a run's time, for half of the time of compiling.
PASSES = ("sroa", "simplify_cfg")
PART_LINES = 1_000  # of a function that is compiled by itself: 20 to 30 ms
GROUP_LINES = 2_000  # of smaller ones that go together: 50 ms, so that all cores have something to do; each part costs 2 ms


@cache
def _llvm() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


def _target_machine() -> Any:
    """A compiler for the processor that runs this."""
    llvm = _llvm()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=_features(), opt=LEVEL, reloc="pic", codemodel="small", jit=True
    )


@cache
def _features() -> str:
    return _llvm().get_host_cpu_features().flatten()


@cache
def lanes() -> int:
    """Return the number of float64 that a vector register holds."""
    features = _llvm().get_host_cpu_features()
    if features.get("avx512f") and features.get("avx512dq") and features.get("avx512vl"):
        return 8
    return 4 if features.get("avx2") and features.get("fma") else 2


def digest(text: str) -> str:
    """Return the key of a program, on this processor, with this compiler."""
    import llvmlite

    llvm = _llvm()
    parts = [text, llvm.get_host_cpu_name(), _features(), llvm.get_default_triple(), llvmlite.__version__, str(LEVEL), *PASSES]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


@cache
def _linker() -> Any:
    """The loader of object code: JITLink lays code and constants side by side, wherever in a process there is room for both."""
    llvm = _llvm()
    machine = llvm.Target.from_default_triple().create_target_machine(opt=LEVEL, reloc="pic", codemodel="small", jit=True)
    return llvm.create_lljit_compiler(machine, use_jit_link=sys.platform != "win32")


class Library:
    """The machine code of one module, in memory for as long as this object lives: addresses of some of its functions by name."""

    _numbers = itertools.count()

    def __init__(self, parts: Sequence[bytes], names: Sequence[str]):
        builder = _llvm().JITLibraryBuilder().add_current_process()
        for code in parts:
            builder.add_object_img(code)
        for name in names:
            builder.export_symbol(name)
        self._tracker = builder.link(_linker(), f"library {next(self._numbers)}")

    def __getitem__(self, name: str) -> int:
        return self._tracker[name]


def library(text: str, names: Sequence[str]) -> Library:
    """The code of a module, with the functions of these names: from disk, or compiled and put there."""
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return Library(list(pool.map(_stored_code, split_module(text))), names)


def _stored_code(text: str) -> bytes:
    name = digest(text)
    code = code_cache.read(name)
    if code is None:
        code = compile_module(text)
        code_cache.write(name, code)
    return code


def split_module(text: str) -> list[str]:
    """Split a module into modules that can be compiled at once, the largest first, each with the declarations that it needs."""
    bodies = {match[1]: match[0] for match in re.finditer(r"^define [^@\n]*@(\w+)\(.*?^}\n", text, re.DOTALL | re.MULTILINE)}
    heads = {match[1]: match[0] for match in re.finditer(r"^(?:declare [^@\n]*)?@([\w.]+)[ (].*\n?", text, re.MULTILINE)}
    lines = {name: body.count("\n") for name, body in bodies.items()}
    groups, size = [[name] for name in bodies if lines[name] >= PART_LINES], GROUP_LINES
    for name in bodies:
        if lines[name] < PART_LINES:
            if size + lines[name] > GROUP_LINES:
                groups.append([])
                size = 0
            groups[-1].append(name)
            size += lines[name]
    groups.sort(key=lambda names: -sum(lines[name] for name in names))
    heads |= {name: f"declare{body[len('define') : body.index(')') + 1]}\n" for name, body in bodies.items()}
    parts = []
    for members in groups:
        part = "".join(bodies[name] for name in members)
        used = sorted(set(re.findall(r"@([\w.]+)", part)) - {*members})
        parts.append("".join(heads[name] if heads[name].endswith("\n") else heads[name] + "\n" for name in used) + part)
    return parts


def compile_module(text: str) -> bytes:
    """Object code of a module."""
    return object_code(text, _target_machine(), _llvm().get_default_triple())


def object_code(text: str, machine: Any, triple: str) -> bytes:
    """Object code of a module by a compiler of its own, as is the context: several threads compile at once."""
    llvm = _llvm()
    with llvm.create_context() as context, llvm.parse_assembly(text, context) as module:
        module.triple = triple
        module.data_layout = str(machine.target_data)
        passes = llvm.create_new_module_pass_manager()
        for name in PASSES:
            getattr(passes, f"add_{name}_pass")()
        passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
        return _emit(machine, module)


def _emit(machine: Any, module: Any) -> bytes:
    """Object code of a module, without the lock that llvmlite holds during each call: LLVM's contexts share nothing."""
    from llvmlite.binding import ffi

    with ffi.OutputString() as error:
        buffer = _emission()(machine, module, 1, error)
        if not buffer:
            raise RuntimeError(str(error))
    try:
        return ctypes.string_at(ffi.lib.LLVMPY_GetBufferStart(buffer), ffi.lib.LLVMPY_GetBufferSize(buffer))
    finally:
        ffi.lib.LLVMPY_DisposeMemoryBuffer(buffer)


@cache
def _emission() -> Callable:
    from llvmlite.binding import ffi

    locked = ffi.lib.LLVMPY_TargetMachineEmitToMemory
    free = ctypes.CDLL(ffi.lib._name).LLVMPY_TargetMachineEmitToMemory
    free.argtypes, free.restype = locked.argtypes, locked.restype
    return free


def function(address: int, *arguments: Any) -> Any:
    """A function at an address, to be called without Python's lock."""
    return ctypes.CFUNCTYPE(None, *arguments)(address)
