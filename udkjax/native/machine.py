"""Machine code for this processor from LLVM's text, and its cache on disk.

The cache holds object code as the compiler leaves it, under a digest of the text, the processor and the compiler: plain bytes. A
file that is not whole is made again; the oldest go when there are too many.
"""

import ctypes
import hashlib
import itertools
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import platformdirs

LEVEL = 1  # of code generation: 2 takes a fifth longer, and runs take as long
# Optimizations of the text before that. Programs come without common subexpressions and dead code: all that LLVM's own selection
# of level 1 adds is two percent of a run's time, for half of the time of compiling.
PASSES = ("sroa", "simplify_cfg")
MAX_FILES = 2_000  # object files: some 100 MB
_MAGIC = b"udkjax object 1\n"


@cache
def _llvm() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@cache
def target_machine() -> Any:
    """The compiler for the processor that runs this."""
    llvm = _llvm()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=_features(), opt=LEVEL, reloc="pic", codemodel="small", jit=True
    )


@cache
def _features() -> str:
    return _llvm().get_host_cpu_features().flatten()


@cache
def lanes() -> int:
    """How many float64 numbers a vector register holds."""
    features = _llvm().get_host_cpu_features()
    if features.get("avx512f") and features.get("avx512dq") and features.get("avx512vl"):
        return 8
    return 4 if features.get("avx2") and features.get("fma") else 2


def digest(text: str) -> str:
    """What tells one program from another, on this processor, with this compiler."""
    import llvmlite

    llvm = _llvm()
    parts = [text, llvm.get_host_cpu_name(), _features(), llvm.get_default_triple(), llvmlite.__version__, str(LEVEL), *PASSES]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


@cache
def _linker() -> Any:
    """What loads object code: JITLink lays code and constants side by side, wherever in a process there is room for both."""
    llvm = _llvm()
    machine = llvm.Target.from_default_triple().create_target_machine(opt=LEVEL, reloc="pic", codemodel="small", jit=True)
    return llvm.create_lljit_compiler(machine, use_jit_link=sys.platform != "win32")


class Library:
    """The machine code of one module, in memory for as long as this object lives: addresses of some of its functions by name."""

    _numbers = itertools.count()

    def __init__(self, code: bytes, names: Sequence[str]):
        builder = _llvm().JITLibraryBuilder().add_object_img(code).add_current_process()
        for name in names:
            builder.export_symbol(name)
        self._tracker = builder.link(_linker(), f"library {next(self._numbers)}")

    def __getitem__(self, name: str) -> int:
        return self._tracker[name]


def library(text: str, names: Sequence[str]) -> Library:
    """The code of a module, with the functions of these names: from disk, or compiled and put there."""
    name = digest(text)
    folder = cache_folder()
    code = _read(folder / name) if folder else None
    if code is None:
        code = compile_module(text)
        if folder:
            _write(folder / name, code)
    return Library(code, names)


def compile_module(text: str) -> bytes:
    """Object code of a module."""
    llvm, machine = _llvm(), target_machine()
    module = llvm.parse_assembly(text)
    module.triple = llvm.get_default_triple()
    module.data_layout = str(machine.target_data)
    passes = llvm.create_new_module_pass_manager()
    for name in PASSES:
        getattr(passes, f"add_{name}_pass")()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return machine.emit_object(module)


def cache_folder() -> Path | None:
    """Where code is stored: in the user's cache folder, or where `UDKJAX_CACHE` says; None where that is 0."""
    choice = os.environ.get("UDKJAX_CACHE", "").strip()
    if choice == "0":
        return None
    return Path(choice).expanduser() if choice else platformdirs.user_cache_path("udkjax")


def cached_files() -> list[tuple[float, int, Path]]:
    """When each file of code was last used or made, its size in bytes, and where it is."""
    folder, found = cache_folder(), []
    try:
        for file in folder.iterdir() if folder else ():
            status = file.stat()
            found.append((max(status.st_atime, status.st_mtime), status.st_size, file))
    except OSError:  # not there yet, or another process has just removed a file
        pass
    return found


def _read(path: Path) -> bytes | None:
    try:
        data = path.read_bytes()
    except OSError:
        return None
    head, code = data[: len(_MAGIC) + 32], data[len(_MAGIC) + 32 :]
    if not head.startswith(_MAGIC) or hashlib.sha256(code).digest() != head[len(_MAGIC) :]:
        return None
    return code


def _write(path: Path, code: bytes):
    """As a whole, or not at all: other processes may read it meanwhile."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(_MAGIC + hashlib.sha256(code).digest() + code)
        os.replace(temporary, path)
        files = [p for p in path.parent.iterdir() if p.is_file()]
        if len(files) > MAX_FILES:
            for old in sorted(files, key=lambda p: p.stat().st_mtime)[: len(files) - MAX_FILES]:
                old.unlink(missing_ok=True)
    except OSError:  # nowhere to write: it runs all the same
        return


def function(address: int, *arguments: Any) -> Any:
    """A function at an address, to be called without Python's lock."""
    return ctypes.CFUNCTYPE(None, *arguments)(address)
