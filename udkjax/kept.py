"""Compiled programs that the next process finds again without tracing them.

JAX keeps compiled programs by their text, which it has to trace and to write down first: a third of what a second process waits
for, and more than half with larger scenes. Where a program follows from the structure of a function's arguments alone, as those
of this package do, that structure finds it: described in words, by the names and values of what is known, and the types and
shapes of arrays. What cannot be described, as functions of users, is traced; and so is everything where this package is not as it
was imported.
"""

import functools
import hashlib
import os
import pickle
import platform
import secrets
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from udkjax.environment import XLA_FLAGS, cache_folder
from udkjax.straightline import cut

PACKAGE = __name__.partition(".")[0]
MOST = 64  # programs of a function at hand; the one that was made first makes room
LIBRARIES = ("jax", "jaxlib", "equinox", "numpy")
# With other settings JAX makes other programs, or looks at what they do: then it is left to it.
USUAL = {
    "jax_enable_x64": True,
    "jax_disable_jit": False,
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_check_tracer_leaks": False,
    "jax_enable_checks": False,
    "jax_default_device": None,
    "jax_default_matmul_precision": None,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
}
DIGEST = 32  # bytes, of SHA-256
CPU = Path("/proc/cpuinfo")  # of Linux; elsewhere `platform` knows the processor
OF_CPU = ("vendor_id", "cpu family", "model", "model name", "stepping", "flags", "Features", "CPU implementer", "CPU part")
PLAIN = (type(None), bool, int, float, complex, str, bytes)


class Kept:
    """`function` jitted, its programs kept beside those of JAX: for functions whose arguments say all that they compute with."""

    def __init__(self, function: Callable[..., Any]):
        self._function, self._jitted = function, eqx.filter_jit(function)
        self._programs: dict[Any, Program | None] = {}
        self._imported = list(_attributes())
        functools.update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        leaves, tree = jax.tree.flatten(arguments)
        arrays = [x for x in leaves if eqx.is_array(x)]
        if any(isinstance(x, Tracer) for x in leaves) or isinstance(cut([np.zeros(())])[0], Tracer) or not _usual():
            return self._jitted(*arguments)
        key = tree, *((type(x), jax.typeof(x) if eqx.is_array(x) else x) for x in leaves)
        if key not in self._programs:
            if len(self._programs) == MOST:
                del self._programs[next(iter(self._programs))]
            file = self._file(arguments)
            program = None if file is None else _read(file) or self._made(file, arguments, arrays)
            self._programs[key] = program
        program = self._programs[key]
        return self._jitted(*arguments) if program is None else program(arrays)

    def _file(self, arguments: Any) -> Path | None:
        """Where the program is kept, if it can be."""
        folder = _folder()
        if folder is None or any(vars(of).get(name) is not x for of, name, x in self._imported):
            return None
        try:
            words = "\n".join([self._function.__qualname__, *_words(arguments), *_surroundings()])
        except _UnknownError:
            return None
        return folder / f"{PACKAGE}-{hashlib.sha256(words.encode()).hexdigest()}-cache"

    def _made(self, file: Path, arguments: Any, arrays: list[Any]) -> "Program":
        """Make the program, and keep it, if it calls no library: who finds it could not prepare that."""
        _, static = eqx.partition(arguments, eqx.is_array)
        tree = jax.tree.structure(eqx.filter(arguments, eqx.is_array))
        results: list[Any] = []

        def of_arrays(*arrays: Any) -> list[Any]:
            given = self._function(*eqx.combine(jax.tree.unflatten(tree, arrays), static))
            leaves, whole = jax.tree.flatten(given)
            found = [x for x in leaves if eqx.is_array(x)]
            places = map(_Place, range(len(found)))
            results[:] = [jax.tree.unflatten(whole, [next(places) if eqx.is_array(x) else x for x in leaves])]
            return found

        # Under a name of its own, so that JAX does not find it: what has been read cannot be written again.
        of_arrays.__name__ = f"{self._function.__name__}_{secrets.token_hex(8)}"
        lowered = jax.jit(of_arrays).lower(*arrays)
        compiled = lowered.compile()
        if "custom_call" not in lowered.as_text():
            try:
                _write(file, zlib.compress(pickle.dumps((serialize(compiled), results[0])), level=1))
            except Exception:  # of JAX or of pickle, whatever it is: then this one is not kept
                pass
            else:
                for double in file.parent.glob(f"*{of_arrays.__name__}*"):
                    double.unlink(missing_ok=True)
        return Program(compiled, results[0])


class Program:
    """A compiled program, of arrays alone, and the tree that its results are part of: with a `_Place` for each of them."""

    def __init__(self, compiled: Callable[..., list[Any]], results: Any):
        self._compiled, self._results = compiled, results

    def __call__(self, arrays: list[Any]) -> Any:
        found = self._compiled(*arrays)
        return jax.tree.map(lambda x: found[x.number] if isinstance(x, _Place) else x, self._results)


class _Place:
    def __init__(self, number: int):
        self.number = number


class _UnknownError(Exception):
    """It cannot be described so that another process would describe the same thing in the same way."""


def _words(x: Any, known: bool = False) -> Iterator[str]:
    """Describe a value: of arrays the type and shape only, or, where they are `known` when the program is traced, the numbers."""
    kind = type(x)
    name, ours = f"{kind.__module__}.{kind.__qualname__}", _is_ours(kind)
    if kind in PLAIN:
        yield f"{name} {x!r}"
    elif eqx.is_array(x) and not known:
        yield f"array {jax.typeof(x)} {jax.typeof(x).weak_type}"
    elif issubclass(kind, np.ndarray | np.generic):
        yield f"{name} {x.dtype} {x.shape} {x.tobytes().hex()}"
    elif issubclass(kind, Enum) and ours:
        yield f"{name} {x.name}"
    elif issubclass(kind, type | FunctionType) and _is_ours(x):
        yield f"{name} {x.__module__}.{x.__qualname__}"
    elif kind in (tuple, list) or (issubclass(kind, tuple) and ours):
        yield f"{name} of {len(x)}"
        for each in x:
            yield from _words(each, known)
    elif kind is dict:
        yield f"{name} of {len(x)}"
        for pair in x.items():
            yield from _words(pair, known)
    elif ours and is_dataclass(x):
        for field in fields(x):
            yield f"{name}.{field.name}"
            yield from _words(getattr(x, field.name), known or field.metadata.get("static", False))
    else:
        raise _UnknownError


def _is_ours(x: Any) -> bool:
    """Whether a class or function is one of this package, which its name finds."""
    return str(x.__module__).partition(".")[0] == PACKAGE and "<" not in x.__qualname__


def _surroundings() -> Iterator[str]:
    """What else a program depends on: who makes it, and for which processor."""
    yield from (f"{name} {version(name)}" for name in LIBRARIES)
    yield f"{sys.version} {platform.system()} {platform.machine()}"
    yield os.environ.get(XLA_FLAGS, "")
    package = os.path.dirname(__file__)
    if not os.path.exists(__file__):  # in an archive, say
        raise _UnknownError
    for folder, _, names in sorted(os.walk(package)):
        for file in sorted(os.path.join(folder, name) for name in names if name.endswith(".py")):
            status = os.stat(file)
            yield f"{file.removeprefix(package)} {status.st_size} {status.st_mtime_ns}"
    if CPU.exists():
        first = CPU.read_text().partition("\n\n")[0]  # it stands for all
        yield from (line for line in first.splitlines() if line.partition(":")[0].strip() in OF_CPU)
    else:
        yield platform.processor()


def _attributes() -> Iterator[tuple[Any, str, Any]]:
    """What the modules of this package and their classes are made of: whose it is, its name, and what it is."""
    for module in [m for name, m in sys.modules.items() if name.partition(".")[0] == PACKAGE]:
        for name, value in list(vars(module).items()):
            yield module, name, value
            if isinstance(value, type) and value.__module__ == module.__name__:
                yield from ((value, inner, x) for inner, x in list(vars(value).items()))


def _usual() -> bool:
    """Whether JAX is as it is by itself, on one CPU."""
    usual = all(getattr(jax.config, name, value) == value for name, value in USUAL.items())
    usual &= not jax.config.read("jax_disable_most_optimizations")
    return usual and jax.default_backend() == "cpu" and jax.device_count() == 1


def _folder() -> Path | None:
    """Where programs are kept, if JAX keeps its own there."""
    folder = cache_folder()
    used = jax.config.jax_enable_compilation_cache and jax.config.jax_compilation_cache_dir
    return folder if folder is not None and str(folder) == used else None


def _read(file: Path) -> Program | None:
    try:
        data = file.read_bytes()
    except OSError:
        return None
    if hashlib.sha256(data[DIGEST:]).digest() != data[:DIGEST]:  # a file that was cut short, say
        return None
    try:
        executable, results = pickle.loads(zlib.decompress(data[DIGEST:]))
        return Program(deserialize_and_load(*executable), results)
    except Exception:  # of pickle or of XLA, whatever it is: then it is made again
        return None


def _write(file: Path, kept: bytes) -> None:
    """Whole, or not at all."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        # What is left of it where there is no room has the name of a program, so that it is removed like one.
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix="-cache", delete=False) as new:
            new.write(hashlib.sha256(kept).digest() + kept)
        os.replace(new.name, file)
    except OSError:  # no room, or not allowed
        pass
