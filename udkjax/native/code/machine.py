"""Machine code for this processor from LLVM's text, compiled in parallel and stored on disk.

A module is compiled in parts; each large function is a separate part, so that modules can share the code of equal functions.
"""

import ctypes
import hashlib
import itertools
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

from udkjax.native.code import code_cache
from udkjax.native.code.processor import llvm, target
from udkjax.native.language.text import named_apart
from udkjax.threads import thread_count

OPTIMIZATION_LEVEL = 1  # level of code generation; level 2 takes a fifth longer to compile, with equal run time
# Level for first calls: a quarter of the compile time; runs take twice as long, five times in lanes; equal rounding.
QUICK_LEVEL = 0
# Optimization passes before code generation. Programs have no common subexpressions and no dead code: LLVM's own selection for
# level 1 would shorten runs by 2 % and double the compile time.
PASSES = ("sroa", "simplify_cfg")
PART_LINES = 1_000  # a function of at least this many lines is compiled separately, in 20 to 30 ms
GROUP_LINES = 2_000  # maximum lines of a group of smaller functions, compiled in 50 ms; each part has an overhead of 2 ms


STACK_PROBE = "__chkstk"  # its name on Windows; a C compiler would link it


def _target_machine(level: int) -> Any:
    """Return a compiler with a level of code generation for the processor that `processor.target` names."""
    cpu, features = target()
    machine = llvm().Target.from_default_triple()
    return machine.create_target_machine(cpu=cpu, features=features, opt=level, reloc="pic", codemodel="small", jit=True)


def digest(text: str, level: int = OPTIMIZATION_LEVEL) -> str:
    """Return the name under which the code of a text is stored, for this processor and compiler and a level of optimization."""
    return hashlib.sha256("\0".join((text, _compiler(), str(level), *PASSES)).encode()).hexdigest()[:32]


@cache
def _compiler() -> str:
    """Return a text that changes with the processor and the version of the compiler, for digests."""
    import llvmlite

    return "\0".join((*target(), llvm().get_default_triple(), llvmlite.__version__))


@cache
def _linker() -> Any:
    """Return the loader of object code; JITLink places code and constants within reach of relative addresses."""
    machine = (
        llvm()
        .Target.from_default_triple()
        .create_target_machine(opt=OPTIMIZATION_LEVEL, reloc="pic", codemodel="small", jit=True)
    )
    return llvm().create_lljit_compiler(machine, use_jit_link=sys.platform != "win32")


def _address_of_stack_probe() -> int:
    """Return the address of the function that each function with a stack frame longer than a page must call on Windows."""
    probe = getattr(ctypes.WinDLL("ntdll"), STACK_PROBE)  # pyright: ignore[reportAttributeAccessIssue]
    address = ctypes.cast(probe, ctypes.c_void_p).value
    assert address is not None
    return address


class Library:
    """The machine code of one module, loaded while this object exists.

    `library[name]` is the address of a function or of a global variable.

    Args:
        parts: The object code of the parts of the module.
        names: The names whose addresses are needed.
        is_optimized: Whether all parts are compiled with the level `OPTIMIZATION_LEVEL`.
    """

    _numbers = itertools.count()

    def __init__(self, parts: Sequence[bytes], names: Sequence[str], is_optimized: bool = True):
        self.is_optimized = is_optimized
        builder = llvm().JITLibraryBuilder().add_current_process()
        if sys.platform == "win32":
            builder.import_symbol(STACK_PROBE, _address_of_stack_probe())
        for code in parts:
            builder.add_object_img(code)
        for name in names:
            builder.export_symbol(name)
        self._tracker = builder.link(_linker(), f"library {next(self._numbers)}")

    def __getitem__(self, name: str) -> int:
        return self._tracker[name]


def library(text: str, names: Sequence[str], level: int = OPTIMIZATION_LEVEL) -> Library:
    """Load the code of a module, which is on disk or compiled here.

    Args:
        text: LLVM's text of the module.
        names: The names of the functions and global variables whose addresses are needed.
        level: The level of code generation. Parts whose code of a higher level is on disk have this code.

    Returns:
        The loaded code.
    """
    with ThreadPoolExecutor(thread_count()) as pool:
        codes, levels = zip(*pool.map(lambda part: _stored_code(part, level), split_module(text)), strict=True)
    return Library(codes, names, is_optimized=min(levels) == OPTIMIZATION_LEVEL)


def _stored_code(text: str, level: int) -> tuple[bytes, int]:
    """Return the object code of a text, and its level: a higher one than `level` if that code is on disk."""
    for stored_level in range(OPTIMIZATION_LEVEL, level - 1, -1):
        code = code_cache.read(digest(text, stored_level))
        if code is not None:
            return code, stored_level
    code = compile_module(text, level)
    code_cache.write(digest(text, level), code)
    return code, level


def split_module(text: str) -> list[str]:
    """Return the texts of modules into which a module is split for parallel compilation, the largest first.

    Functions that the module names by `text.apart` share no part with others, which another module may have as well.
    """
    text = f"\n{text}"  # searching for newlines is several times as fast as multiline anchors
    definitions = (text[match.end() : text.index("\n}\n", match.end()) + 3] for match in re.finditer(r"\n(?=define )", text))
    bodies = {body[body.index("@") + 1 : body.index("(", body.index("@"))]: body for body in definitions}
    heads = {match[2]: f"{match[1]}\n" for match in re.finditer(r"\n((?:declare [^@\n]*)?@([\w.]+)[ (].*)", text)}
    lines = {name: body.count("\n") for name, body in bodies.items()}
    groups, named = [[name] for name in bodies if lines[name] >= PART_LINES], named_apart(text)
    for is_apart in (False, True):
        size = GROUP_LINES
        for name in bodies:
            if lines[name] < PART_LINES and (name in named) == is_apart:
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


def compile_module(text: str, level: int = OPTIMIZATION_LEVEL) -> bytes:
    """Return the object code of a module for this processor, compiled at a level of code generation."""
    return object_code(text, _target_machine(level), llvm().get_default_triple(), () if level == QUICK_LEVEL else PASSES)


@cache
def llvm_for_all_targets() -> Any:
    """Return LLVM with the compilers of all its targets, not only of this processor."""
    binding = llvm()
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    return binding


def object_code(text: str, machine: Any, triple: str, optimizations: Sequence[str] = PASSES) -> bytes:
    """Return the object code of a module for any target, compiled in a separate context, so that threads can work in parallel.

    Args:
        text: LLVM's text of the module.
        machine: llvmlite's target machine.
        triple: LLVM's name of the target.
        optimizations: The names of the passes before code generation.
    """
    with optimized(text, machine, triple, optimizations) as module:
        return _emit(machine, module)


@contextmanager
def optimized(text: str, machine: Any, triple: str, optimizations: Sequence[str]) -> Iterator[Any]:
    """Yield llvmlite's module of a text for a target, after passes of optimization; it exists within the `with` block only."""
    binding = llvm()
    with binding.create_context() as context, binding.parse_assembly(text, context) as module:
        module.triple = triple
        module.data_layout = str(machine.target_data)
        passes = binding.create_new_module_pass_manager()
        for name in optimizations:
            getattr(passes, f"add_{name}_pass")()
        passes.run(module, binding.create_pass_builder(machine, binding.create_pipeline_tuning_options()))
        yield module


def _emit(machine: Any, module: Any) -> bytes:
    """Return a module's object code, without the lock that llvmlite holds during each call: LLVM's contexts share nothing."""
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
    """Return the function at an address as a ctypes function without a result, which runs without the global interpreter lock.

    `arguments` are the ctypes types of its arguments.
    """
    return ctypes.CFUNCTYPE(None, *arguments)(address)
