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

from udkjax.native.base import code_cache

LEVEL = 1  # of code generation: 2 takes a fifth longer, and runs take as long
QUICK = 0  # for first calls: a quarter of the time of level 1; a run takes twice as long, five times in lanes, and rounds alike
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


def _target_machine(level: int) -> Any:
    """Return a compiler for the processor that runs this."""
    llvm = _llvm()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=_features(), opt=level, reloc="pic", codemodel="small", jit=True
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


def digest(text: str, level: int = LEVEL) -> str:
    """Return the key of a program, on this processor, with this compiler."""
    return hashlib.sha256("\0".join((text, _compiler(), str(level), *PASSES)).encode()).hexdigest()[:32]


@cache
def _compiler() -> str:
    """The processor and the compiler."""
    import llvmlite

    llvm = _llvm()
    return "\0".join((llvm.get_host_cpu_name(), _features(), llvm.get_default_triple(), llvmlite.__version__))


@cache
def _linker() -> Any:
    """Return the loader of object code: JITLink lays code and constants side by side, wherever there is room for both."""
    llvm = _llvm()
    machine = llvm.Target.from_default_triple().create_target_machine(opt=LEVEL, reloc="pic", codemodel="small", jit=True)
    return llvm.create_lljit_compiler(machine, use_jit_link=sys.platform != "win32")


class Library:
    """The machine code of one module, in memory for as long as this object lives: addresses of some of its functions by name."""

    _numbers = itertools.count()

    def __init__(self, parts: Sequence[bytes], names: Sequence[str], is_optimized: bool = True):
        self.is_optimized = is_optimized
        builder = _llvm().JITLibraryBuilder().add_current_process()
        for code in parts:
            builder.add_object_img(code)
        for name in names:
            builder.export_symbol(name)
        self._tracker = builder.link(_linker(), f"library {next(self._numbers)}")

    def __getitem__(self, name: str) -> int:
        return self._tracker[name]


def library(text: str, names: Sequence[str], level: int = LEVEL) -> Library:
    """Return the code of a module, with the functions of these names: from disk, or compiled and put there."""
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        codes, levels = zip(*pool.map(lambda part: _stored_code(part, level), split_module(text)), strict=True)
    return Library(codes, names, is_optimized=min(levels) == LEVEL)


def _stored_code(text: str, level: int) -> tuple[bytes, int]:
    """Return the code of a level, or better code that is on disk, and its level."""
    for some in range(LEVEL, level - 1, -1):
        code = code_cache.read(digest(text, some))
        if code is not None:
            return code, some
    code = compile_module(text, level)
    code_cache.write(digest(text, level), code)
    return code, level


def split_module(text: str) -> list[str]:
    """Split a module into modules that can be compiled at once, the largest first, each with the declarations that it needs."""
    text = f"\n{text}"  # by which lines are found several times as fast as by the anchor of a line
    found = (text[match.end() : text.index("\n}\n", match.end()) + 3] for match in re.finditer(r"\n(?=define )", text))
    bodies = {body[body.index("@") + 1 : body.index("(", body.index("@"))]: body for body in found}
    heads = {match[2]: f"{match[1]}\n" for match in re.finditer(r"\n((?:declare [^@\n]*)?@([\w.]+)[ (].*)", text)}
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
        parts.append("".join(heads[name] for name in used) + part)
    return parts


def compile_module(text: str, level: int = LEVEL) -> bytes:
    """Object code of a module."""
    return object_code(text, _target_machine(level), _llvm().get_default_triple(), () if level == QUICK else PASSES)


def object_code(text: str, machine: Any, triple: str, optimizations: Sequence[str] = PASSES) -> bytes:
    """Object code of a module by a compiler of its own, as is the context: several threads compile at once."""
    llvm = _llvm()
    with llvm.create_context() as context, llvm.parse_assembly(text, context) as module:
        module.triple = triple
        module.data_layout = str(machine.target_data)
        passes = llvm.create_new_module_pass_manager()
        for name in optimizations:
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
    """Return a function at an address, to be called without Python's lock."""
    return ctypes.CFUNCTYPE(None, *arguments)(address)
