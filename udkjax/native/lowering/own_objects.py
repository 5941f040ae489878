"""User-defined objects whose methods, written in jax.numpy, become functions of machine code."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.native.language.ir import DOUBLE
from udkjax.native.language.program import UnsupportedError
from udkjax.native.lowering.arrays import Stored
from udkjax.native.lowering.lowering import LoweredFunction, Lowering
from udkjax.native.lowering.rules import lower


class NumberOfRun(NamedTuple):
    """A leaf that is an array: its numbers are inputs of machine code."""

    shape: tuple[int, ...]


@dataclass(frozen=True)
class OwnObject:
    """A user-defined object as a tree without its numbers: equal objects have equal machine code.

    Other leaves are stored with their types, as 1, 1.0 and True are equal.
    """

    structure: Any
    leaves: tuple[Any, ...]

    @classmethod
    def of(cls, x: Any) -> "OwnObject":
        """Leave the numbers of an object out.

        Raises:
            UnsupportedError: it has arrays of another type than float64.
        """
        leaves, structure = jax.tree.flatten(x)
        for array in numbers_of(x):
            if array.dtype != np.float64:
                raise UnsupportedError(f"arrays of type {array.dtype}")
        return cls(structure, tuple(NumberOfRun(np.shape(x)) if _is_number(x) else (type(x), x) for x in leaves))

    @property
    def sizes(self) -> list[int]:
        """The number of elements of each of its arrays."""
        return [int(np.prod(x.shape)) for x in self.leaves if isinstance(x, NumberOfRun)]

    def filled(self, numbers: jax.Array) -> Any:
        """Return the object with numbers, which are in one vector."""
        parts = iter(np.split(np.arange(sum(self.sizes)), np.cumsum(self.sizes)[:-1]))
        leaves = [numbers[next(parts)].reshape(x.shape) if isinstance(x, NumberOfRun) else x[1] for x in self.leaves]
        return jax.tree.unflatten(self.structure, leaves)


def numbers_of(x: Any) -> list[Any]:
    """Return the arrays of a user-defined object."""
    return [leaf for leaf in jax.tree.leaves(x) if _is_number(leaf)]


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


@contextmanager
def named(kind: str, x: Any) -> Iterator[None]:
    """Name the object in the errors of a block that traces and lowers one of its methods.

    Raises:
        UnsupportedError: the message says what has no machine code, or which error its text raised.
    """
    name = f"the {kind} {type(x).__name__}"
    try:
        yield
    except UnsupportedError as error:
        raise UnsupportedError(f"{error} of {name}") from error
    except Exception as error:  # text of a user may raise any error
        raise UnsupportedError(f"{name} ({type(error).__name__} while it was traced)") from error


class Written(NamedTuple):
    """A function of machine code, and how many numbers of memory it takes in each lane."""

    function: LoweredFunction
    size: int


def written(closed: Any, inputs: Sequence[tuple[str, int | None]], width: int) -> Written:
    """Write `name(inputs..., scratch)`, whose outputs are in `scratch` from its beginning, one after another.

    Args:
        closed: The jaxpr.
        inputs: The name of each input, and for a matrix the length of its rows in memory.
        width: The number of lanes.
    """
    f = LoweredFunction("own", [*(name for name, _ in inputs), "scratch"], width)
    to = Lowering(f, f.given["scratch"], lower)
    given = [
        Stored(f.given[name], v.aval.shape, DOUBLE, True, strides=None if stride is None else (stride, 1))
        for (name, stride), v in zip(inputs, closed.jaxpr.invars, strict=True)
    ]
    outputs = [to.new(v.aval.shape, DOUBLE, True) for v in closed.jaxpr.outvars]
    for output, found in zip(outputs, to.closed(closed, given), strict=True):
        to.fill(output, found)
    f.name = f"own_{hashlib.sha256(f.text().encode()).hexdigest()[:16]}"
    return Written(f, to.size)


def traced(function: Callable[..., Any], *shapes: tuple[int, ...]) -> Any:
    """Return the jaxpr of a function of arrays of numbers."""
    return jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(shape, float) for shape in shapes))
