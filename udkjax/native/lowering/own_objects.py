"""User-defined objects whose methods, written in jax.numpy, become functions of machine code."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from udkjax.native.code import code_cache
from udkjax.native.language.ir import DOUBLE
from udkjax.native.language.program import UnsupportedError
from udkjax.native.language.text import with_evaluated
from udkjax.native.lowering.arrays import Stored
from udkjax.native.lowering.lowering import LoweredFunction, Lowering, traced
from udkjax.native.lowering.module_calls import simplified
from udkjax.native.lowering.rules import lower
from udkjax.native.lowering.source_key import source_key


class NumberOfRun(NamedTuple):
    """The shape of an array among the leaves of an object, whose numbers are inputs of machine code."""

    shape: tuple[int, ...]


@dataclass(frozen=True)
class OwnObject:
    """A user-defined object as a tree without the numbers of its arrays: equal objects have equal machine code.

    Leaves that are not arrays are stored with their types, as 1, 1.0 and True are equal.
    """

    structure: Any
    leaves: tuple[Any, ...]

    @classmethod
    def of(cls, x: Any) -> "OwnObject":
        """Return an object without its numbers.

        Raises:
            UnsupportedError: the object has arrays of another type than float64.
        """
        leaves, structure = jax.tree.flatten(x)
        for array in numbers_of(x):
            if array.dtype != np.float64:
                raise UnsupportedError(f"arrays of type {array.dtype}")
        return cls(structure, tuple(NumberOfRun(np.shape(x)) if _is_number(x) else (type(x), x) for x in leaves))

    @property
    def sizes(self) -> list[int]:
        """The number of elements of each array of the object."""
        return [int(np.prod(x.shape)) for x in self.leaves if isinstance(x, NumberOfRun)]

    @property
    def template(self) -> Any:
        """The object with a `NumberOfRun` in place of each array."""
        return jax.tree.unflatten(self.structure, [x if isinstance(x, NumberOfRun) else x[1] for x in self.leaves])

    def filled(self, numbers: jax.Array) -> Any:
        """Return the object whose arrays have the elements of one vector, in the order of `sizes`."""
        parts = iter(np.split(np.arange(sum(self.sizes)), np.cumsum(self.sizes)[:-1]))
        leaves = [numbers[next(parts)].reshape(x.shape) if isinstance(x, NumberOfRun) else x[1] for x in self.leaves]
        return jax.tree.unflatten(self.structure, leaves)


def numbers_of(x: Any) -> list[Any]:
    """Return the arrays among the leaves of a user-defined object."""
    return [leaf for leaf in jax.tree.leaves(x) if _is_number(leaf)]


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


@contextmanager
def named(kind: str, x: Any) -> Iterator[None]:
    """Turn errors of the `with` block, which traces and lowers a method of the object x, into errors that name the object.

    Raises:
        UnsupportedError: the message names the object, and the operation without machine code or the error of its method.
    """
    name = f"the {kind} {type(x).__name__}"
    try:
        yield
    except UnsupportedError as error:
        raise UnsupportedError(f"{error} of {name}") from error
    except Exception as error:  # text of a user may raise any error
        raise UnsupportedError(f"{name} ({type(error).__name__} while it was traced)") from error


class OwnMethod(Protocol):
    """The code of a method of a user-defined object; equal code has equal text."""

    @property
    def own(self) -> OwnObject: ...

    def evaluate(self, *inputs: Any) -> Any:
        """Return the results of the method; JAX traces this."""


class Input(NamedTuple):
    """An input of a function: its name, its shape, and for a matrix the length of its rows in memory."""

    name: str
    shape: tuple[int, ...]
    stride: int | None = None


class Written(NamedTuple):
    """A function as machine code, and the number of float64 numbers of scratch memory that it needs in each lane."""

    function: LoweredFunction
    size: int
    unchanged: Sequence[int | None] = ()  # for each result, the index of the input that it is, or None

    def calls(self, name: str) -> bool:
        """Return whether the function calls, also indirectly, the function `name` of the module."""
        return any(f"@{name}(" in f.text() for f in with_evaluated([self.function]))

    def within(self, size: int) -> LoweredFunction:
        """Return the function if `size` numbers of scratch memory in each lane are enough for it.

        Raises:
            RuntimeError: the memory is too small.
        """
        if self.size > size:
            raise RuntimeError(f"{self.function.name} takes memory for {self.size} numbers, not {size}")
        return self.function


@lru_cache(maxsize=64)
def written(code: OwnMethod, inputs: tuple[Input, ...], width: int, within: Any = None) -> Written:
    """Return the function `name(inputs..., scratch)` of a user's method, which stores its outputs at the start of `scratch`.

    Its text is stored on disk under a key of the object's source, if there is one: tracing and lowering take 30 ms.

    Args:
        code: The method.
        inputs: The inputs of the function, and their shapes.
        width: The number of lanes.
        within: Describes the module whose functions the method may call. The function is then `name(work, inputs..., scratch)`,
            with indices in the memory at `work` instead of pointers. None: it calls none.
    """
    pointers, in_module = [*(x.name for x in inputs), "scratch"], within is not None
    key = source_key(type(code).__name__, code.own.template, within, inputs, width)
    stored = None if key is None else code_cache.read(f"text-{key}")
    if stored is not None:
        name, size, unchanged, *parts = json.loads(stored)
        return Written(LoweredFunction.of_parts(name, pointers, width, in_module, parts), size, unchanged)
    f, closed = LoweredFunction("own", pointers, width, in_module), _traced(code, tuple(x.shape for x in inputs))
    places = {id(a): k for k, a in enumerate(closed.jaxpr.invars)}
    found = Written(f, _write(f, closed, inputs), [places.get(id(a)) for a in closed.jaxpr.outvars])
    f.name = f"own_{hashlib.sha256(f.text().encode()).hexdigest()[:16]}"
    if key is not None and not f.evaluated:
        code_cache.write(f"text-{key}", json.dumps((f.name, found.size, found.unchanged, *f.parts)).encode())
    return found


@lru_cache(maxsize=64)
def _traced(code: OwnMethod, shapes: tuple[tuple[int, ...], ...]) -> Any:
    return simplified(traced(code.evaluate, [jax.ShapeDtypeStruct(shape, float) for shape in shapes]))


def _write(f: LoweredFunction, closed: Any, inputs: Sequence[Input]) -> int:
    """Write the operations of a jaxpr; return the number of float64 numbers that they need in scratch memory in each lane."""
    to = Lowering(f, f.given["scratch"], lower)
    strides = (None if x.stride is None else (x.stride, 1) for x in inputs)
    given = [Stored(f.given[x.name], x.shape, DOUBLE, True, strides=y) for x, y in zip(inputs, strides, strict=True)]
    outputs = [to.new(v.aval.shape, DOUBLE, True) for v in closed.jaxpr.outvars]
    for output, found in zip(outputs, to.closed(closed, given), strict=True):
        to.fill(output, found)
    return to.size
