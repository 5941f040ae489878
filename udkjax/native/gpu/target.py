"""The compiler for NVIDIA's GPUs: PTX by LLVM, assembled by `ptxas` where there is one, else by the driver when it is loaded."""

import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from udkjax.native.code import code_cache, machine

TRIPLE = "nvptx64-nvidia-cuda"
PTX_VERSION = "+ptx78"  # the version, of CUDA 11.8: the first for sm_90
OLDEST_CAPABILITY = (7, 0)  # compute capability: the first whose threads part and meet freely
NEWEST_CAPABILITY = (9, 0)  # the newest capability in this version of PTX, which later GPUs accept as well
OPTIMIZATION_LEVEL = 2  # of LLVM's code generation
# Functions are called, not inlined: an inlined copy takes room in the instruction cache. LLVM's combination of instructions
# would remove the casts that mark pointers to a thread's own memory.
PASSES = machine.PASSES


def compile_kernel(text: str, capability: tuple[int, int], is_assembled: bool = True) -> bytes:
    """Return the code of a kernel for a compute capability, from the cache on disk or newly compiled.

    Args:
        text: LLVM's text.
        capability: major and minor number.
        is_assembled: whether to assemble the kernel by `ptxas`, if there is one, to a cubin for this capability only. Otherwise
            the result is PTX for this capability and later ones, which the driver assembles in seconds whenever it loads it.
    """
    assembler = ptxas() if is_assembled else None
    key = machine.digest(
        "\0".join((TRIPLE, str(capability), PTX_VERSION, *PASSES, str(OPTIMIZATION_LEVEL), _version(assembler), text))
    )
    code = code_cache.read(key)
    if code is None:
        source = ptx(text, min(capability, NEWEST_CAPABILITY))
        code = assemble(source, capability, assembler) if assembler else source.encode() + b"\0"
        code_cache.write(key, code)
    return code


def ptx(text: str, capability: tuple[int, int] = NEWEST_CAPABILITY) -> str:
    """Return the PTX of LLVM's text of a kernel, for a compute capability and later ones."""
    llvm = machine.llvm_for_all_targets()
    compiler = llvm.Target.from_triple(TRIPLE).create_target_machine(
        cpu=_name(capability), features=PTX_VERSION, opt=OPTIMIZATION_LEVEL
    )
    with machine.optimized(text, compiler, TRIPLE, PASSES) as module:
        return compiler.emit_assembly(module)


def _name(capability: tuple[int, int]) -> str:
    return "sm_{}{}".format(*capability)


def assemble(code: str, capability: tuple[int, int], assembler: str) -> bytes:
    """Return the cubin of PTX for a compute capability, assembled by the program at the path `assembler`."""
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
    """Return the path of NVIDIA's assembler, of a wheel that JAX installs, of an installed CUDA, or on PATH; None without one."""
    spec, homes = find_spec("nvidia"), [os.environ.get("CUDA_HOME"), "/usr/local/cuda"]
    for wheels in spec.submodule_search_locations or () if spec else ():
        homes = [f"{wheels}/cu13", f"{wheels}/cuda_nvcc", *homes]
    name = "ptxas.exe" if sys.platform == "win32" else "ptxas"
    found = next((str(Path(home, "bin", name)) for home in homes if home and Path(home, "bin", name).is_file()), None)
    return found or shutil.which(name)


@cache
def _version(assembler: str | None) -> str:
    if assembler is None:
        return ""
    return subprocess.run([assembler, "--version"], capture_output=True, text=True, check=True).stdout
