"""The first derivatives of a function as a linear map with its transpose, to JAX a primitive; and their derivatives.

A derivative of the map is one of two functions again, of x and a direction v, or of x and a cotangent w,

    g(x, v) = J(x) v,        h(x, w) = J(x)^T w.

Both change by the second derivative D^2 f along two directions, and by g and h themselves, which are linear in v and w:

    dg = D^2 f [v, dx] + J dv,        dh_i = w^T D^2 f [dx, e_i] + (J^T dw)_i        for each unit vector e_i,

and since w^T J(x) v is one number, the cotangents of x are w^T D^2 f [v, e_i], those of v and w h and g. So second derivatives
along pairs of directions are all that takes; those of higher orders are found so by forward mode of JAX.
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

from udkjax.pinv.linear_primitive import linear_primitive
from udkjax.programs.numpy_program import TooLongError, expand_as
from udkjax.programs.varying_axes import result_type
from udkjax.transforms.traced_numbers import Mask, replaced, select


class DifferentiableFunction(eqx.Module):
    """A function of a list of arrays that returns a list of arrays. Forward mode of it is JAX's."""

    @abstractmethod
    def __call__(self, xs: list[Array]) -> list[Array]:
        """Return f(x)."""

    @property
    def orders(self) -> int:
        """The order up to which its derivatives are machine code."""
        return 0

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

    def pull(self, xs: list[Array], active: Mask, ws: list[Array]) -> list[Array]:
        """Return J^T w, of those of x that are active, as a function whose forward mode is JAX's."""
        return _by_rows(lambda es: change_along(self, xs, active, es)[1], xs, active, ws)

    def twice(self, xs: list[Array], active: Mask, vs: list[Array], others: Mask, us: list[Array]) -> list[Array]:
        """Return D^2 f [v, u], along v of those of x that are active, and u of others."""
        return change_along(lambda xs: change_along(self, xs, active, vs)[1], xs, others, us)[1]


class Along(DifferentiableFunction):
    """g(x, v) = J(x) v, with v of those of x that are active."""

    of: DifferentiableFunction
    active: Mask = eqx.field(static=True)

    def __call__(self, xs: list[Array]) -> list[Array]:
        xs, vs = self.parts(xs)
        return change_along(self.of, xs, self.active, vs)[1]

    @property
    def orders(self) -> int:
        return self.of.orders - 1

    def forward(self, xs: list[Array], active: Mask, vs: list[Array], run: Any) -> list[Array]:
        del run
        (xs, directions), (of_x, of_v) = self.parts(xs), self.parts(active)
        dxs, dvs = vs[: sum(of_x)], vs[sum(of_x) :]
        found = [jnp.zeros(shape) for shape in self.shapes([*xs, *directions])]
        if dxs:
            found = self.of.twice(xs, self.active, directions, of_x, dxs)
        if dvs:
            found = [a + b for a, b in zip(found, self.of.forward(xs, self._those(of_v), dvs, None), strict=True)]
        return found

    def backward(self, xs: list[Array], active: Mask, ws: list[Array], run: Any) -> list[Array]:
        del run
        (xs, directions), (of_x, of_v) = self.parts(xs), self.parts(active)
        found = _by_rows(lambda es: self.of.twice(xs, self.active, directions, of_x, es), xs, of_x, ws)
        return [*found, *(self.of.backward(xs, self._those(of_v), ws, None) if any(of_v) else [])]

    def parts(self, xs: Sequence[Any]) -> tuple[Any, Any]:
        return xs[: len(self.active)], xs[len(self.active) :]

    def _those(self, which: Mask) -> Mask:
        """Return a mask of x, from one of those that are active."""
        rest = iter(which)
        return tuple(m and next(rest) for m in self.active)

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        return self.of.shapes(self.parts(xs)[0])


class Back(Along):
    """h(x, w) = J(x)^T w, of those of x that are active."""

    def __call__(self, xs: list[Array]) -> list[Array]:
        xs, ws = self.parts(xs)
        return self.of.pull(xs, self.active, ws)

    def forward(self, xs: list[Array], active: Mask, vs: list[Array], run: Any) -> list[Array]:
        del run
        (xs, bars), (of_x, of_w) = self.parts(xs), self.parts(active)
        dxs, dws = vs[: sum(of_x)], vs[sum(of_x) :]
        found = [jnp.zeros(x.shape) for x in select(xs, self.active)]
        if dxs:
            found = _by_rows(lambda es: self.of.twice(xs, of_x, dxs, self.active, es), xs, self.active, bars)
        if dws:
            dws = replaced([jnp.zeros(x.shape) for x in bars], of_w, dws)
            found = [a + b for a, b in zip(found, self.of.backward(xs, self.active, dws, None), strict=True)]
        return found

    def backward(self, xs: list[Array], active: Mask, ws: list[Array], run: Any) -> list[Array]:
        del run
        (xs, bars), (of_x, of_w) = self.parts(xs), self.parts(active)
        found = _by_rows(lambda es: self.of.twice(xs, self.active, ws, of_x, es), xs, of_x, bars)
        return [*found, *(select(self.of.forward(xs, self.active, ws, None), of_w) if any(of_w) else [])]

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        return [x.shape for x in select(self.parts(xs)[0], self.active)]


def _by_rows(rate: Callable[[list[Array]], list[Array]], xs: list[Array], active: Mask, ws: list[Array]) -> list[Array]:
    """Return the gradient of w^T r(e) of a linear function r of changes e of those of x that are active: of each unit vector."""
    some = [x.shape for x in select(xs, active)]
    if not some:
        return []
    row = lambda e: jnp.vdot(_flat(ws), _flat(rate(_split(e, some))))  # noqa: E731
    return _split(jax.vmap(row)(jnp.eye(sum(map(math.prod, some)))), some)


def change_along(function: Callable, xs: list[Array], active: Mask, vs: list[Array]) -> tuple[Any, Any]:
    """Return f(x), and its change along v, of those of x that are active, by forward mode."""
    return jax.jvp(lambda *some: function(replaced(xs, active, some)), select(xs, active), vs)


# --- the linear map


class Linear(eqx.Module):
    """v -> J(x) v, or transposed w -> J(x)^T w, of those of x that are active."""

    function: DifferentiableFunction
    xs: list[Array]
    run: Any  # stored by the evaluation for its first derivatives; None: nothing
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
    return result_type((sum(map(math.prod, linear.T.inputs)),), jax.tree.leaves((linear, vector)), vector.dtype)


@eqxi.filter_primitive_jvp
def _derivative(primals, tangents):
    linear, vector = primals
    at, change = tangents
    found = _bind(linear, vector)
    if all(dx is None for dx in at.xs):
        return found, _bind(linear, change)
    kind = Back if linear.transposed else Along
    parts = [None] * len(linear.inputs) if change is None else _split(change, linear.inputs)
    dxs = [*at.xs, *parts]
    active = tuple(dx is not None for dx in dxs)
    further = Linear(kind(linear.function, linear.active), [*linear.xs, *_split(vector, linear.inputs)], None, active)
    return found, _bind(further, _flat(select(dxs, active)))


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangent):
    linear, _ = inputs
    return jax.tree.map(lambda _: None, linear), _bind(linear.T, cotangent)


_linear_p = linear_primitive("derivative_of_a_run", _apply, _shape, _derivative, _transpose)


@eqxi.filter_primitive_def
def _apply_short(linear, vector):
    """Apply a map of machine code; others take diffrax's loops, which are compiled in any case."""
    if linear.run is None and linear.function.orders < 1:
        raise TooLongError
    return _apply(linear, vector)


expand_as(_linear_p, lambda **parameters: partial(_apply_short, **parameters))


def _bind(linear: Linear, vector: Array) -> Array:
    return eqxi.filter_primitive_bind(_linear_p, linear, vector)


def _flat(xs: Sequence[Any]) -> Array:
    return jnp.concatenate([jnp.ravel(jnp.asarray(x)) for x in xs])


def _split(vector: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
    return [part.reshape(shape) for part, shape in zip(jnp.split(vector, ends), shapes, strict=True)]
