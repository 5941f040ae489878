"""The compiler for NVIDIA's GPUs: PTX by LLVM, assembled by `ptxas` where there is one, else by the driver when it is loaded."""

import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from udkjax.native.base import code_cache, machine

TRIPLE = "nvptx64-nvidia-cuda"
PTX = "+ptx78"  # the version, of CUDA 11.8: the first for sm_90
OLDEST = (7, 0)  # compute capability: the first whose threads part and meet freely
NEWEST = (9, 0)  # the newest capability in this version of PTX, which later GPUs accept as well
LEVEL = 2  # of LLVM's code generation
# Functions are called, not inlined: an inlined copy takes room in the cache of instructions. LLVM's combination of instructions
# would remove the casts that tell pointers to a thread's own memory.
PASSES = machine.PASSES


def compile_kernel(text: str, capability: tuple[int, int], is_assembled: bool = True) -> bytes:
    """Compile a kernel for a compute capability, from disk or newly compiled.

    Args:
        text: LLVM's text.
        capability: major and minor number.
        is_assembled: whether to assemble it by `ptxas`, if there is one, to a cubin for this capability only. The result is else
            PTX for this capability and later ones, which the driver assembles in seconds each time it loads it.
    """
    assembler = ptxas() if is_assembled else None
    key = machine.digest("\0".join((TRIPLE, str(capability), PTX, *PASSES, str(LEVEL), _version(assembler), text)))
    code = code_cache.read(key)
    if code is None:
        source = ptx(text, min(capability, NEWEST))
        code = assemble(source, capability, assembler) if assembler else source.encode() + b"\0"
        code_cache.write(key, code)
    return code


def ptx(text: str, capability: tuple[int, int] = NEWEST) -> str:
    """Compile to PTX."""
    llvm = _llvm()
    compiler = llvm.Target.from_triple(TRIPLE).create_target_machine(cpu=_name(capability), features=PTX, opt=LEVEL)
    with llvm.create_context() as context, llvm.parse_assembly(text, context) as module:
        module.triple, module.data_layout = TRIPLE, str(compiler.target_data)
        module.verify()
        passes = llvm.create_new_module_pass_manager()
        for name in PASSES:
            getattr(passes, f"add_{name}_pass")()
        passes.run(module, llvm.create_pass_builder(compiler, llvm.create_pipeline_tuning_options(speed_level=LEVEL)))
        return compiler.emit_assembly(module)


def _name(capability: tuple[int, int]) -> str:
    return "sm_{}{}".format(*capability)


def assemble(code: str, capability: tuple[int, int], assembler: str) -> bytes:
    """Assemble PTX to a cubin for a compute capability."""
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder, "kernel.ptx"), Path(folder, "kernel.cubin")
        source.write_text(code)
        given = [assembler, f"-arch={_name(capability)}", "-O3", str(source), "-o", str(result)]
        done = subprocess.run(given, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{assembler} does not assemble a kernel: {done.stderr.strip()}")
        return result.read_bytes()


@cache
def ptxas() -> str | None:
    """Return the path of NVIDIA's assembler: of a wheel (JAX brings it), of an installed CUDA, or on the path; else None."""
    folders = []
    for name in ("nvidia.cu13", "nvidia.cuda_nvcc"):
        try:
            spec = find_spec(name)
        except ModuleNotFoundError:
            continue
        folders += [Path(x) / "bin" for x in (spec.submodule_search_locations or ()) if spec] if spec else []
    folders += [Path(home) / "bin" for home in (os.environ.get("CUDA_HOME"), "/usr/local/cuda") if home]
    name = "ptxas.exe" if sys.platform == "win32" else "ptxas"
    found = next((str(folder / name) for folder in folders if (folder / name).is_file()), None)
    return found or shutil.which(name)


@cache
def _version(assembler: str | None) -> str:
    if assembler is None:
        return ""
    return subprocess.run([assembler, "--version"], capture_output=True, text=True, check=True).stdout


@cache
def _llvm() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    return llvm
