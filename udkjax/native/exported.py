"""Compiled JAX functions as bytes for other processes: JAX's own export, with the texts of the machine code that they call."""

import json
import re
import zlib
from collections.abc import Callable
from typing import Any

import jax
import jax.export

from udkjax.extras import EXPORT_PACKAGES, require
from udkjax.native.host.host_function import needed_by
from udkjax.native.module import loading
from udkjax.requirements import ArgumentError

CUSTOM_CALL = re.compile(r"custom_call @([\w.]+)")
OWN_PREFIX = "udkjax_"  # prefix of the names of machine code
FORMAT_HEADER = b"udkjax exported 1\n"


def export_compiled(function: Callable[..., Any], *arguments: Any) -> bytes:
    """Compile a JAX function of arrays, such as a run, its gradient or a batch of runs, to bytes for other processes.

    JAX's own export contains no machine code of udkjax, and refuses functions that call such code. The bytes from this function
    also contain the LLVM text of the machine code, which `load_exported` compiles for the processor that it runs on.

    Args:
        function: a function that JAX can trace, for the CPU.
        arguments: example arguments of the function: their shapes and types matter, their values do not.

    Returns:
        The bytes, for `load_exported`.

    Raises:
        MissingExtraError: the extra `export` is not installed.
        ArgumentError: the function calls Python, as do runs by diffrax, runs with events, and forces that JAX cannot trace.
    """
    require(*EXPORT_PACKAGES)
    jitted: Any = function if hasattr(function, "lower") else jax.jit(function)
    names = sorted({*CUSTOM_CALL.findall(jitted.lower(*arguments).as_text())})
    own = {name: loading.registered(name) for name in names if name.startswith(OWN_PREFIX)}
    lost = [name for name, code in own.items() if code is None]
    foreign = [name for name in names if "callback" in name or "host" in name]
    if lost or foreign:
        known = sorted({needed_by(name) for name in lost} - {""})
        why = "; ".join(known) or 'it calls Python: export runs by machine code (engine="native") without events, or use export_c'
        raise ArgumentError(f"the function cannot be exported: {why}")
    checks = [jax.export.DisabledSafetyCheck.custom_call(name) for name in own]
    artifact = jax.export.export(jitted, platforms=("cpu",), disabled_checks=checks)(*arguments)
    texts = json.dumps({name: code.texts() for name, code in own.items() if code is not None})
    packed = zlib.compress(texts.encode())
    return FORMAT_HEADER + len(packed).to_bytes(8, "little") + packed + bytes(artifact.serialize())


def load_exported(data: bytes) -> Callable[..., Any]:
    """Load a function that `export_compiled` has written.

    Its machine code is compiled for this processor, or read from the cache on disk. Load only bytes from people whom you trust:
    machine code can do anything.

    Args:
        data: the bytes that `export_compiled` returned.

    Returns:
        The function. Its arguments must be arrays of the shapes and types for which it was exported.

    Raises:
        ArgumentError: the bytes are not those of an exported function.
    """
    require(*EXPORT_PACKAGES)
    if not data.startswith(FORMAT_HEADER):
        raise ArgumentError("data must be the bytes that udkjax.export_compiled returned")
    start = len(FORMAT_HEADER) + 8
    end = start + int.from_bytes(data[len(FORMAT_HEADER) : start], "little")
    for name, texts in json.loads(zlib.decompress(data[start:end])).items():
        loading.load_as(name, texts)
    return jax.export.deserialize(bytearray(data[end:])).call
