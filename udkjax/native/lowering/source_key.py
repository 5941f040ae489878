"""Keys of user-defined objects by their source: objects with equal keys have equal machine code, in any process.

A key is a digest of the bytecode of all functions that the methods of an object reach, with their constants, closures and global
values. An object that reaches anything whose content is unknown or may change has no key. Functions of JAX and NumPy are
identified by their names and the versions of these libraries, functions of this package by the times of their files.
"""

import builtins
import dis
import hashlib
import os
import sys
from collections.abc import Iterable
from functools import cache, partial
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from udkjax.arrays import TreeMethod

_KNOWN_MODULES = frozenset(
    "abc builtins collections equinox functools itertools jax jaxlib jaxtyping math numpy operator typing".split()
)
_FOLDERS = ("equations/laws", "native/language", "native/lowering", "native/parts", "native/pseudoinverses", "pinv")
_PACKAGE = Path(__file__).parents[2]
_FILES = ("integrate/stabilization.py",)  # with classes from which those of users are derived
_PREFIXES = tuple(f"{_PACKAGE.name}.{x.removesuffix('.py').replace('/', '.')}" for x in (*_FOLDERS, *_FILES))
# Functions whose results may change.
_CHANGING_FUNCTIONS = frozenset("fromfile fromregex genfromtxt load loadtxt memmap random".split())
_WITHOUT_KEY = frozenset("__import__ breakpoint compile eval exec globals hash id input locals open vars".split())
# Methods that dataclasses generate; tracing does not use them.
_GENERATED_METHODS = frozenset("__eq__ __hash__ __init__ __replace__ __repr__".split())
_Compiled = type(jax.jit(lambda: None))
_PLAIN_TYPES = (type(None), bool, int, float, complex, str, bytes, type(...))


def source_key(*objects: Any) -> str | None:
    """Return one key of several objects and numbers; None if any of them has no key."""
    try:
        found = _Source()
        found.add_all((_versions(), *objects))
    except _UnknownError:
        return None
    return found.digest.hexdigest()[:32]


class _UnknownError(Exception):
    """An object has no key."""


@cache
def _versions() -> tuple[Any, ...]:
    """Return the versions of libraries and files whose functions a key contains by name only.

    Raises:
        _UnknownError: the files of the package cannot be found.
    """
    files = [file for folder in _FOLDERS for file in sorted((_PACKAGE / folder).rglob("*.py"))]
    files += [_PACKAGE / name for name in _FILES] if files else []
    if not files:
        raise _UnknownError
    times = [(str(file), (status := os.stat(file)).st_mtime_ns, status.st_size) for file in files]
    return sys.version, jax.__version__, np.__version__, eqx.__version__, *times


def _is_known(module: Any) -> bool:
    """Return True if keys contain the objects of a module of this name by their names only."""
    parts = str(module).split(".")
    return "random" not in parts and (parts[0] in _KNOWN_MODULES or str(module).startswith(_PREFIXES))


class _Source:
    """The SHA-256 digest of objects. An object that is added again adds the place of its first addition only."""

    def __init__(self):
        self.digest, self._places, self._kept = hashlib.sha256(), {}, []

    def _note(self, *tokens: Any):
        self.digest.update(repr(tokens).encode())

    def add_all(self, objects: Iterable[Any]):
        for x in objects:
            self._add(x)

    def _add(self, x: Any):
        if type(x) in _PLAIN_TYPES:
            self._note(type(x).__name__, x)
        elif id(x) in self._places:
            self._note("again", self._places[id(x)])
        else:
            self._places[id(x)] = len(self._places)
            self._kept.append(x)  # so that no other object has the same identity
            self._add_object(x)

    def _add_object(self, x: Any):
        match x:
            case np.ndarray() | np.generic() | jax.Array() if not isinstance(x, Tracer) and x.dtype != object:
                self._note("array", str(x.dtype), np.shape(x), np.asarray(x).tobytes())
            case tuple() | list():
                self._note(type(x).__name__, len(x))
                self.add_all((*(() if type(x) in (tuple, list) else (type(x),)), *x))
            case dict():
                self._note("dict", len(x))
                self.add_all(part for item in x.items() for part in item)
            case frozenset() if all(type(part) in _PLAIN_TYPES for part in x):
                self._note("frozenset", sorted(map(repr, x)))
            case FunctionType():
                self._add_function(x)
            case MethodType():
                self.add_all((x.__func__, x.__self__))
            case property():
                self.add_all((x.fget,))
            case TreeMethod():
                self.add_all((x.function,))
            case staticmethod() | classmethod():
                self.add_all((x.__func__,))
            case partial():
                self.add_all((x.func, x.args, x.keywords))
            case type():
                self._add_class(x)
            case eqx.Module():
                self.add_all((type(x), vars(x)))
            case _:
                self._add_named(x)

    def _add_named(self, x: Any):
        """Add a module or function of a known library by its name, or a compiled function of JAX by the one that it compiles."""
        module = x.__name__ if isinstance(x, ModuleType) else getattr(x, "__module__", None)
        name = getattr(x, "__name__", None)
        if _is_known(module) and isinstance(name, str) and name not in _CHANGING_FUNCTIONS:
            self._note("named", type(x).__name__, module, name)
        elif type(x) is _Compiled:
            self._note("compiled")
            self._add(getattr(x, "__wrapped__", None))
        else:
            raise _UnknownError

    def _add_class(self, x: type):
        self._note("class", x.__module__, x.__qualname__)
        if _is_known(x.__module__):
            return
        self.add_all(x.__bases__)
        for name, value in vars(x).items():
            is_special = name.startswith("__") and name.endswith("__")
            if name != "_abc_impl" and not (is_special and (name in _GENERATED_METHODS or not isinstance(value, FunctionType))):
                self._note("attribute", name)
                self._add(value)

    def _add_function(self, x: FunctionType):
        if _is_known(x.__module__):
            if x.__name__ in _CHANGING_FUNCTIONS:
                raise _UnknownError
            return self._note("function", x.__module__, x.__qualname__)
        self._note("function")
        self.add_all((x.__defaults__, x.__kwdefaults__, vars(x)))
        try:
            self.add_all(cell.cell_contents for cell in x.__closure__ or ())
        except ValueError:  # an empty cell
            raise _UnknownError from None
        return self._add_code(x.__code__, x.__globals__)

    def _add_code(self, code: CodeType, values: dict[str, Any]):
        """Add bytecode, with the global values that it reads."""
        counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        self._note("code", code.co_code, code.co_exceptiontable, counts, names)
        for x in code.co_consts:
            if isinstance(x, CodeType):
                self._add_code(x, values)
            else:
                self._add(x)
        for step in dis.get_instructions(code):
            self._add_step(step.opname, str(step.argval), values)

    def _add_step(self, operation: str, name: str, values: dict[str, Any]):
        """Add the global value that an instruction reads; refuse instructions whose results may change."""
        match operation:
            case "LOAD_GLOBAL" | "LOAD_NAME":
                self._add_global(name, values)
            case "LOAD_ATTR" | "LOAD_METHOD" | "IMPORT_FROM" if name in _CHANGING_FUNCTIONS:
                raise _UnknownError
            case "IMPORT_NAME" if not _is_known(name):
                raise _UnknownError
            case "STORE_GLOBAL":
                raise _UnknownError

    def _add_global(self, name: str, values: dict[str, Any]):
        self._note("global", name)
        if name in values:
            self._add(values[name])
        elif name in _WITHOUT_KEY or not hasattr(builtins, name):
            raise _UnknownError
