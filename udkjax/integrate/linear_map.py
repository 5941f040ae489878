"""The first derivatives of a function as a linear map with its transpose, to JAX a primitive; and their derivatives.

A derivative of the map is one of two functions again, of x and a direction v, or of x and a cotangent w,

    g(x, v) = J(x) v,        h(x, w) = J(x)^T w.

Forward mode of both is JAX's. In reverse mode, since w^T J(x) v is one number, of which derivatives may be taken in any order,
the cotangents of x are d/dx (w^T J v) = dh(x, w) along v, and those of v and w are h and g. There h is found row by row, w^T J e
for each unit vector e, so that forward mode through diffrax is all that derivatives of higher orders take.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.expressions.numpy_program import TooLongError, expand_as
from udkjax.integrate.traced_numbers import Mask, replaced, select
from udkjax.pinv.linear_primitive import linear_primitive


class DifferentiableFunction(eqx.Module):
    """A function of a list of arrays that returns a list of arrays. Forward mode of it is JAX's."""

    @abstractmethod
    def __call__(self, xs: list[Array]) -> list[Array]:
        """Return f(x)."""

    def pull(self, xs: list[Array], active: Mask, ws: list[Array]) -> list[Array]:
        """Return J^T w, of those of x that are active: w^T J e for each unit vector e. Forward mode of it is JAX's, too."""
        some = select(xs, active)
        units = jnp.eye(sum(x.size for x in some))
        shapes = [x.shape for x in some]
        row = lambda e: jnp.vdot(_flat(ws), _flat(change_along(self, xs, active, _split(e, shapes))[1]))  # noqa: E731
        return _split(jax.vmap(row)(units), shapes)

    @abstractmethod
    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        """Return the shapes of f(x)."""

    def forward(self, xs: list[Array], active: Mask, vs: list[Array], run: Any) -> list[Array]:
        """Return J v. `run` is what evaluating f at x has left for its first derivatives, if anything."""
        del run
        return change_along(self, xs, active, vs)[1]

    def backward(self, xs: list[Array], active: Mask, ws: list[Array], run: Any) -> list[Array]:
        """Return J^T w, of those of x that are active, in the same way."""
        del run
        return self.pull(xs, active, ws)

    @property
    def plain(self) -> "DifferentiableFunction":
        """The same in the form that is differentiated more than once."""
        return self


class Along(DifferentiableFunction):
    """g(x, v) = J(x) v, with v of those of x that are active."""

    of: DifferentiableFunction
    active: Mask = eqx.field(static=True)

    def __call__(self, xs: list[Array]) -> list[Array]:
        xs, vs = self.parts(xs)
        return change_along(self.of, xs, self.active, vs)[1]

    def pull(self, xs: list[Array], active: Mask, ws: list[Array]) -> list[Array]:
        xs, vs = self.parts(xs)
        of_x, of_v = active[: len(xs)], active[len(xs) :]
        either = tuple(a or b for a, b in zip(of_x, self.active, strict=True))
        found, change = change_along(lambda xs: self.of.pull(xs, either, ws), xs, self.active, vs)
        change = select(change, tuple(x for x, e in zip(of_x, either, strict=True) if e))
        found = select(found, tuple(m for m, e in zip(self.active, either, strict=True) if e))
        return [*change, *select(found, of_v)]

    def parts(self, xs: list[Array]) -> tuple[list[Array], list[Array]]:
        return xs[: len(self.active)], xs[len(self.active) :]

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        return self.of.shapes(self.parts(xs)[0])


class Back(Along):
    """h(x, w) = J(x)^T w, of those of x that are active."""

    def __call__(self, xs: list[Array]) -> list[Array]:
        xs, ws = self.parts(xs)
        return self.of.pull(xs, self.active, ws)

    def pull(self, xs: list[Array], active: Mask, ws: list[Array]) -> list[Array]:
        (xs, bars), directions = self.parts(xs), ws
        of_x, of_w = active[: len(xs)], active[len(xs) :]
        found = []
        if any(of_x):
            found += change_along(lambda xs: self.of.pull(xs, of_x, bars), xs, self.active, directions)[1]
        if any(of_w):
            found += select(change_along(self.of, xs, self.active, directions)[1], of_w)
        return found

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        return [x.shape for x in select(self.parts(xs)[0], self.active)]


def change_along(function: Callable, xs: list[Array], active: Mask, vs: list[Array]) -> tuple[Any, Any]:
    """Return f(x), and its change along v, of those of x that are active, by forward mode."""
    return jax.jvp(lambda *some: function(replaced(xs, active, some)), select(xs, active), vs)


# --- the linear map


class Linear(eqx.Module):
    """v -> J(x) v, or transposed w -> J(x)^T w, of those of x that are active."""

    function: DifferentiableFunction
    xs: list[Array]
    run: Any  # what evaluating it has left for its first derivatives; None: nothing
    active: Mask = eqx.field(static=True)
    transposed: bool = eqx.field(static=True, default=False)

    @property
    def T(self) -> "Linear":
        return replace(self, transposed=not self.transposed)

    @property
    def inputs(self) -> list[tuple[int, ...]]:
        """The shapes of what it is applied to."""
        return self.function.shapes(self.xs) if self.transposed else [x.shape for x in select(self.xs, self.active)]

    def applied(self, vs: list[Array]) -> list[Array]:
        return _split(_bind(self, _flat(vs)), self.T.inputs)


def _apply(linear: Linear, vector: Array) -> Array:
    function, vs = linear.function, _split(vector, linear.inputs)
    apply = function.backward if linear.transposed else function.forward
    return _flat(apply(linear.xs, linear.active, vs, linear.run))


@eqxi.filter_primitive_def
def _shape(linear, vector):
    return jax.core.ShapedArray((sum(map(math.prod, linear.T.inputs)),), vector.dtype)


@eqxi.filter_primitive_jvp
def _derivative(primals, tangents):
    linear, vector = primals
    at, change = tangents
    found = _bind(linear, vector)
    if all(dx is None for dx in at.xs):
        return found, _bind(linear, change)
    kind, function = Back if linear.transposed else Along, linear.function
    parts = [None] * len(linear.inputs) if change is None else _split(change, linear.inputs)
    dxs = [*at.xs, *parts]
    active = tuple(dx is not None for dx in dxs)
    further = Linear(kind(function.plain, linear.active), [*linear.xs, *_split(vector, linear.inputs)], None, active)
    return found, _bind(further, _flat(select(dxs, active)))


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangent):
    linear, _ = inputs
    return jax.tree.map(lambda _: None, linear), _bind(linear.T, cotangent)


_linear_p = linear_primitive("derivative_of_a_run", _apply, _shape, _derivative, _transpose)


@eqxi.filter_primitive_def
def _apply_first(linear, vector):
    """Apply a map of first derivatives; those of higher orders take diffrax's loops, which are compiled in any case."""
    if linear.run is None:
        raise TooLongError
    return _apply(linear, vector)


expand_as(_linear_p, lambda **parameters: partial(_apply_first, **parameters))


def _bind(linear: Linear, vector: Array) -> Array:
    return eqxi.filter_primitive_bind(_linear_p, linear, vector)


def _flat(xs: Sequence[Any]) -> Array:
    return jnp.concatenate([jnp.ravel(jnp.asarray(x)) for x in xs])


def _split(vector: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
    return [part.reshape(shape) for part, shape in zip(jnp.split(vector, ends), shapes, strict=True)]
