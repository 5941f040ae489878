"""Trees of numbers that are partly traced: only the traced ones are arguments of a function with derivatives."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, PyTree

from udkjax.annotations import TreeDef
from udkjax.arrays import number
from udkjax.programs.varying_axes import vary_together

Mask = tuple[bool, ...]  # True for the arrays of a list that have tangents


class ConcreteNumbers:
    """The concrete arrays of a tree, with None for traced ones; static because they are compared by value."""

    def __init__(self, arrays: Sequence[Array | None]):
        self.arrays = arrays
        self._key = tuple(None if x is None else (x.shape, np.asarray(x).tobytes()) for x in arrays)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ConcreteNumbers) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class TreeOfNumbers(eqx.Module):
    """A tree as a function of its traced float arrays. The others stay concrete: JAX would trace them all."""

    rest: PyTree  # the tree without arrays of floats
    concrete: ConcreteNumbers = eqx.field(static=True)
    structure: TreeDef = eqx.field(static=True)

    def __call__(self, xs: Sequence[Array]) -> Any:
        traced = iter(xs)
        arrays = [next(traced) if x is None else x for x in self.concrete.arrays]
        return eqx.combine(jax.tree.unflatten(self.structure, arrays), self.rest)

    def marks(self, active: Mask) -> Any:
        """Return the tree with True for active arrays and False for others."""
        traced = iter(active)
        return jax.tree.unflatten(self.structure, [x is None and next(traced) for x in self.concrete.arrays])

    def changes(self, active: Mask, active_arrays: Sequence[Array]) -> Any:
        """Return the tree with `active_arrays` for active arrays and None for others."""
        marks, values = jax.tree.leaves(self.marks(active)), iter(active_arrays)
        return jax.tree.unflatten(self.structure, [next(values) if m else None for m in marks])


def split_numbers(tree: PyTree) -> tuple[TreeOfNumbers, list[Array]]:
    """Return a tree as a function of its traced float arrays, and these arrays."""
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    concrete = ConcreteNumbers([None if isinstance(x, Tracer) else number(x) if isinstance(x, np.ndarray) else x for x in leaves])
    return TreeOfNumbers(rest, concrete, structure), vary_together([x for x in leaves if isinstance(x, Tracer)])


def select(xs: Sequence[Any], which: Mask) -> list[Any]:
    """Return the entries that `which` marks."""
    return [x for x, m in zip(xs, which, strict=True) if m]


def replaced(xs: Sequence[Array], active: Mask, active_arrays: Sequence[Array]) -> list[Array]:
    """Return the arrays xs with the active arrays replaced by `active_arrays`, in order."""
    values = iter(active_arrays)
    return [next(values) if m else x for x, m in zip(xs, active, strict=True)]
