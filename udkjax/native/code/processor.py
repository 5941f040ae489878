"""The processor that machine code is compiled for: this one or, with `UDKJAX_LANES`, the same for all machines.

Code for this processor uses all its instructions, and the last bits of results depend on them: on whether multiplications are
fused with additions and, as sums are taken in lanes, on the number of lanes. With the setting, code uses the instructions of one
level, as makers of processors and compilers agreed on, and is the same on all processors that have them.
"""

import os
from dataclasses import dataclass
from functools import cache
from typing import Any

from udkjax.requirements import ArgumentError

LANES_VARIABLE = "UDKJAX_LANES"
ARM_BASE = "generic"  # two lanes and fused multiply-add


@dataclass(frozen=True)
class Level:
    """A level of instructions: LLVM's name of it, a description for messages, and the features that a processor must have."""

    cpu: str
    words: str
    features: tuple[str, ...]


SSE = Level("x86-64-v2", "SSE 4.2", ("sse4.2", "ssse3", "popcnt", "cx16"))  # nothing is fused
AVX2 = Level("x86-64-v3", "AVX2 and FMA", ("avx2", "fma", "bmi", "bmi2", "f16c", "lzcnt", "movbe"))
AVX512 = Level("x86-64-v4", "AVX-512", (*AVX2.features, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"))
LEVELS = {1: SSE, 2: SSE, 4: AVX2, 8: AVX512}  # by the number of lanes


@cache
def llvm() -> Any:
    """Return llvmlite's module `binding`, with the compiler for this machine initialized."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@cache
def lanes() -> int:
    """Return the number of lanes: `UDKJAX_LANES`, else the number of float64 numbers in a vector register.

    Raises:
        ArgumentError: the setting is not a number of lanes, or this processor has no registers of that length.
    """
    text = _setting()
    if not text:
        features = llvm().get_host_cpu_features()
        if _has(features, ("avx512f", "avx512dq", "avx512vl")):
            return 8
        return 4 if _has(features, ("avx2", "fma")) else 2
    if text not in map(str, LEVELS):
        raise ArgumentError(f"{LANES_VARIABLE} must be 1, 2, 4 or 8 lanes of machine code, not {text!r}")
    chosen = int(text)
    if not _suits(chosen):
        most, words = max(filter(_suits, LEVELS)), LEVELS[chosen].words
        raise ArgumentError(f"{LANES_VARIABLE}={chosen} needs {words}, which this processor lacks: it has at most {most} lanes")
    return chosen


@cache
def target() -> tuple[str, str]:
    """Return LLVM's names of the processor and of its features for which code is compiled.

    These are this processor and all its features or, if `UDKJAX_LANES` is set, a level and "".
    """
    if not _setting():
        return llvm().get_host_cpu_name(), llvm().get_host_cpu_features().flatten()
    level = LEVELS[lanes()]
    return (level.cpu if _is_x86() else ARM_BASE), ""


def _setting() -> str:
    return os.environ.get(LANES_VARIABLE, "").strip()


def _suits(count: int) -> bool:
    """Return whether this processor can run the code for a number of lanes, with the instructions of its level."""
    return _has(llvm().get_host_cpu_features(), LEVELS[count].features) if _is_x86() else count <= 2


def _has(features: Any, names: tuple[str, ...]) -> bool:
    return all(features.get(name) for name in names)


def _is_x86() -> bool:
    return llvm().get_default_triple().partition("-")[0] in ("x86_64", "amd64")
