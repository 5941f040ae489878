"""Inputs of machine code: all numbers of a scene in one vector, their tangents and cotangents, and samples."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from udkjax.scene.elements.held import row_size, rows_of, with_row
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.gradients import stop_gradients


class ActiveNumbers:
    """The numbers of a pytree, some of which are active: derivatives with respect to them are needed.

    Machine code receives the numbers as one vector, followed by two thresholds of pivots, which are inactive.

    Args:
        numbers: the pytree of arrays; a leaf may be None in place of an array.
        active: a pytree of the same form: True for active arrays, False or None for all others.

    Attributes:
        mask: True for each active number; False for the others and for the two thresholds.
    """

    def __init__(self, numbers: PyTree[Array], active: PyTree[bool]):
        self._numbers, self._active = leaves_and_none(numbers), leaves_and_none(active)
        self._tree = jax.tree.structure(numbers, is_leaf=lambda x: x is None)
        leaves = zip(self._numbers, self._active, strict=True)
        self.mask = (*(m is True for x, m in leaves if x is not None for _ in range(np.size(x))), False, False)

    def tangents(self, change: PyTree[Array]) -> Array:
        """Return a change of the pytree as one vector, with zeros for inactive numbers and for the two thresholds."""
        leaves = zip(self._numbers, self._active, leaves_and_none(change), strict=True)
        moving = [jnp.ravel(jnp.asarray(dx, float)) for x, m, dx in leaves if x is not None and m is True]
        mask = np.array(self.mask)
        # Two operations for any number of parts, as each operation of XLA takes as long as a hundred steps of a small scene.
        return jnp.concatenate([*moving, np.zeros(1)])[np.where(mask, np.cumsum(mask) - 1, np.sum(mask))]

    def cotangents(self, bars: Array) -> PyTree[Array]:
        """Return the pytree of the cotangents, None for inactive arrays, from the vector of the cotangents of all numbers."""
        parts, place = [], 0
        for x, m in zip(self._numbers, self._active, strict=True):
            size = 0 if x is None else np.size(x)
            parts.append(bars[place : place + size].reshape(np.shape(x)) if m is True else None)
            place += size
        return jax.tree.unflatten(self._tree, parts)


def leaves_and_none(tree: PyTree) -> list[Any]:
    """Return the leaves of a pytree; each None counts as a leaf."""
    return jax.tree.leaves(tree, is_leaf=lambda x: x is None)


class SampleRows:
    """The sampled numbers of a mechanism as rows, one for each interval between the breakpoints of a run."""

    def __init__(self, mechanism: Mechanism, breakpoints: Float[Array, "K"] | None):
        self.samples = mechanism.samples
        self._breakpoints = breakpoints

    def breakpoints(self, xp: ModuleType) -> Any:
        """Return the sorted breakpoints of the run, a NumPy array if they are concrete, otherwise an array of `xp`."""
        if self._breakpoints is None:
            return np.zeros(0)
        traced = isinstance(self._breakpoints, Tracer)
        return xp.sort(stop_gradients(self._breakpoints)) if traced else np.sort(np.asarray(self._breakpoints))

    def stand_in(self, mechanism: Mechanism, marks: bool = False) -> Mechanism:
        """Return a mechanism in which one row of zeros takes the place of all samples.

        `mechanism` may also be a pytree of tangents, in which samples without tangents stay None, or, with `marks`, of marks of
        active numbers: then the row is marked True if any of the samples is.
        """
        samples = {}
        for place, sampled in mechanism.samples.items():
            present = [leaf for leaf in leaves_and_none(sampled) if leaf is not None]
            zeros = np.zeros(row_size(self.samples[place])) if present else None
            samples[place] = with_row(self.samples[place], any(leaf is True for leaf in present) if marks else zeros)
        return mechanism.with_samples(samples)

    def places(self, mechanism: Mechanism) -> tuple[int, ...]:
        """Return the indices of a row's numbers among all numbers of the mechanism from `stand_in`."""
        if not self.samples:
            return ()
        blank = jax.tree.map(lambda x: np.zeros(np.shape(x), bool), self.stand_in(mechanism))
        marked = blank.with_samples({place: with_row(x, np.ones(row_size(x), bool)) for place, x in self.samples.items()})
        return tuple(np.flatnonzero(np.concatenate([np.ravel(x) for x in marked.numbers])).tolist())

    def rows(self, xp: ModuleType, samples: Sequence[Any] | None = None) -> Any:
        """Return the rows of R sampled numbers, one for each interval between K breakpoints: (K + 1, R).

        `samples`: the samples; None: those of the mechanism.
        """
        breakpoints = self.breakpoints(xp)
        columns = []
        for x in self.samples.values() if samples is None else samples:
            traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(x))
            rows, knots = rows_of(x, xp if traced else np), x.breakpoints
            if any(isinstance(b, Tracer) for b in (breakpoints, knots)):
                after = xp.concatenate([xp.full(1, -np.inf), breakpoints])
                columns.append(rows[xp.searchsorted(stop_gradients(xp.asarray(knots)), after, side="right")])
            elif np.array_equal(knots, breakpoints):
                columns.append(rows)
            else:
                columns.append(rows[np.searchsorted(np.asarray(knots, float), np.append(-np.inf, breakpoints), side="right")])
        return xp.concatenate(columns, axis=1)

    def changes(self, mechanism: Mechanism) -> Array:
        """Return the tangents of the rows, (K + 1, R), from `mechanism`, a pytree of the tangents of the mechanism."""
        leaves, form = jax.tree.flatten(list(self.samples.values()))
        given_tangents = leaves_and_none(list(mechanism.samples.values()))
        tangents = [jax.numpy.zeros(np.shape(x)) if dx is None else dx for x, dx in zip(leaves, given_tangents, strict=True)]
        return jax.jvp(lambda xs: self.rows(jax.numpy, jax.tree.unflatten(form, xs)), (leaves,), (tangents,))[1]

    def with_cotangents(self, mechanism: Mechanism, active: Mechanism, bars: Array) -> Mechanism:
        """Return `mechanism`, a pytree of cotangents, with those of the active samples, which follow from `bars`, of the rows."""
        leaves, form = jax.tree.flatten(list(self.samples.values()))
        marks = leaves_and_none(list(active.samples.values()))
        (sample_bars,) = jax.vjp(lambda xs: self.rows(jax.numpy, jax.tree.unflatten(form, xs)), leaves)[1](bars)
        active_bars = [bar if mark is True else None for bar, mark in zip(sample_bars, marks, strict=True)]
        return mechanism.with_samples(dict(zip(self.samples, jax.tree.unflatten(form, active_bars), strict=True)))
