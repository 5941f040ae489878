"""The Jacobian J(x) of a function as a linear map with its transpose, which is a JAX primitive, and its derivatives.

To differentiate the map, its two applications are treated as functions of x and a tangent v, or of x and a cotangent w:

    g(x, v) = J(x) v,        h(x, w) = J(x)^T w.

Their derivatives need the second derivative D^2 f along two directions, and g and h themselves, which are linear in v and w:

    dg = D^2 f [v, dx] + J dv,        dh_i = w^T D^2 f [dx, e_i] + (J^T dw)_i        for each unit vector e_i.

In reverse mode, since w^T J(x) v is a scalar, the cotangents of x are w^T D^2 f [v, e_i], and those of v and w are h and g.
Second derivatives along pairs of directions are thus sufficient; JAX's forward mode computes higher orders.
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
    """A function from a list of arrays to a list of arrays, which JAX differentiates in forward mode.

    `active` marks the inputs that have derivatives; tangents and cotangents of inputs are listed for these only.
    """

    @abstractmethod
    def __call__(self, inputs: list[Array]) -> list[Array]:
        """Return f(x)."""

    @property
    def orders(self) -> int:
        """The highest order of derivatives that machine code computes; by default 0: JAX computes all."""
        return 0

    @abstractmethod
    def shapes(self, inputs: list[Array]) -> list[tuple[int, ...]]:
        """Return the shapes of f(x)."""

    def forward(self, inputs: list[Array], active: Mask, tangents: list[Array], run: Any) -> list[Array]:
        """Return J v, with v the `tangents` of the active inputs.

        `run` is the record that the evaluation of f at x stored for first derivatives; None: it stored none.
        """
        del run
        return change_along(self, inputs, active, tangents)[1]

    def backward(self, inputs: list[Array], active: Mask, cotangents: list[Array], run: Any) -> list[Array]:
        """Return J^T w for the active inputs, with w the `cotangents` of the results. `run` is as in `forward`."""
        del run
        return self.pull(inputs, active, cotangents)

    def pull(self, inputs: list[Array], active: Mask, cotangents: list[Array]) -> list[Array]:
        """Return J^T w in a form that JAX can differentiate in forward mode."""
        return _by_rows(lambda units: change_along(self, inputs, active, units)[1], inputs, active, cotangents)

    def twice(
        self, inputs: list[Array], active: Mask, tangents: list[Array], others: Mask, other_tangents: list[Array]
    ) -> list[Array]:
        """Return D^2 f [v, u], with v along the `active` inputs and u along the `others`."""
        self.require_order(2)
        return change_along(lambda inputs: change_along(self, inputs, active, tangents)[1], inputs, others, other_tangents)[1]

    def require_order(self, order: int) -> None:
        """Raise an error if derivatives of this order that JAX takes of `__call__` would be wrong.

        By default they are right, and nothing happens.
        """


class TangentMap(DifferentiableFunction):
    """The function g(x, v) = J(x) v of the inputs x, followed by tangents v of the `active` inputs."""

    of: DifferentiableFunction
    active: Mask = eqx.field(static=True)

    def __call__(self, inputs: list[Array]) -> list[Array]:
        inputs, tangents = self.parts(inputs)
        return change_along(self.of, inputs, self.active, tangents)[1]

    @property
    def orders(self) -> int:
        return self.of.orders - 1

    def forward(self, inputs: list[Array], active: Mask, tangents: list[Array], run: Any) -> list[Array]:
        del run
        (inputs, directions), (of_x, of_v) = self.parts(inputs), self.parts(active)
        dxs, dvs = tangents[: sum(of_x)], tangents[sum(of_x) :]
        result = [jnp.zeros(shape) for shape in self.shapes([*inputs, *directions])]
        if dxs:
            result = self.of.twice(inputs, self.active, directions, of_x, dxs)
        if dvs:
            result = [a + b for a, b in zip(result, self.of.forward(inputs, self._expand(of_v), dvs, None), strict=True)]
        return result

    def backward(self, inputs: list[Array], active: Mask, cotangents: list[Array], run: Any) -> list[Array]:
        del run
        (inputs, directions), (of_x, of_v) = self.parts(inputs), self.parts(active)
        by_inputs = _by_rows(lambda units: self.of.twice(inputs, self.active, directions, of_x, units), inputs, of_x, cotangents)
        return [*by_inputs, *(self.of.backward(inputs, self._expand(of_v), cotangents, None) if any(of_v) else [])]

    def parts(self, inputs: Sequence[Any]) -> tuple[Any, Any]:
        return inputs[: len(self.active)], inputs[len(self.active) :]

    def _expand(self, which: Mask) -> Mask:
        """Return a mask of x from a mask of the active entries of x."""
        marks = iter(which)
        return tuple(m and next(marks) for m in self.active)

    def require_order(self, order: int) -> None:
        self.of.require_order(order + 1)

    def shapes(self, inputs: list[Array]) -> list[tuple[int, ...]]:
        return self.of.shapes(self.parts(inputs)[0])


class CotangentMap(TangentMap):
    """The function h(x, w) = J(x)^T w of the inputs x, followed by cotangents w of the results."""

    def __call__(self, inputs: list[Array]) -> list[Array]:
        inputs, cotangents = self.parts(inputs)
        return self.of.pull(inputs, self.active, cotangents)

    def forward(self, inputs: list[Array], active: Mask, tangents: list[Array], run: Any) -> list[Array]:
        del run
        (inputs, ws), (of_x, of_w) = self.parts(inputs), self.parts(active)
        dxs, dws = tangents[: sum(of_x)], tangents[sum(of_x) :]
        result = [jnp.zeros(x.shape) for x in select(inputs, self.active)]
        if dxs:
            result = _by_rows(lambda units: self.of.twice(inputs, of_x, dxs, self.active, units), inputs, self.active, ws)
        if dws:
            dws = replaced([jnp.zeros(x.shape) for x in ws], of_w, dws)
            result = [a + b for a, b in zip(result, self.of.backward(inputs, self.active, dws, None), strict=True)]
        return result

    def backward(self, inputs: list[Array], active: Mask, cotangents: list[Array], run: Any) -> list[Array]:
        del run
        (inputs, ws), (of_x, of_w) = self.parts(inputs), self.parts(active)
        by_inputs = _by_rows(lambda units: self.of.twice(inputs, self.active, cotangents, of_x, units), inputs, of_x, ws)
        return [*by_inputs, *(select(self.of.forward(inputs, self.active, cotangents, None), of_w) if any(of_w) else [])]

    def shapes(self, inputs: list[Array]) -> list[tuple[int, ...]]:
        return [x.shape for x in select(self.parts(inputs)[0], self.active)]


def _by_rows(
    rate: Callable[[list[Array]], list[Array]], inputs: list[Array], active: Mask, cotangents: list[Array]
) -> list[Array]:
    """Return the gradient of w^T r(e) with respect to e, one array for each active input, by evaluating r at all unit vectors.

    Args:
        rate: r, a linear function of the tangents e of the active inputs.
        inputs: x.
        active: the mask of the active inputs.
        cotangents: w.
    """
    shapes = [x.shape for x in select(inputs, active)]
    if not shapes:
        return []
    weights = _flat(cotangents)

    def row(e: Array) -> Array:
        change = _flat(rate(_split(e, shapes)))
        return jnp.vdot(weights, jnp.where((weights == 0) & jnp.isnan(change), 0.0, change))  # a lost derivative that is not used

    return _split(jax.vmap(row)(jnp.eye(sum(map(math.prod, shapes)))), shapes)


def change_along(function: Callable, inputs: list[Array], active: Mask, tangents: list[Array]) -> tuple[Any, Any]:
    """Return f(x) and its derivative along v, the `tangents` of the active inputs, by forward mode."""
    return jax.jvp(lambda *active_inputs: function(replaced(inputs, active, active_inputs)), select(inputs, active), tangents)


# --- the linear map


class Linear(eqx.Module):
    """The map v -> J(x) v, or transposed, w -> J(x)^T w."""

    function: DifferentiableFunction
    inputs: list[Array]
    run: Any  # the record that the evaluation stored for first derivatives, or None
    active: Mask = eqx.field(static=True)
    transposed: bool = eqx.field(static=True, default=False)

    @property
    def T(self) -> "Linear":
        return replace(self, transposed=not self.transposed)

    @property
    def argument_shapes(self) -> list[tuple[int, ...]]:
        """The shapes of the arguments: tangents of the active inputs or, if `transposed`, cotangents of the results."""
        return self.function.shapes(self.inputs) if self.transposed else [x.shape for x in select(self.inputs, self.active)]

    def applied(self, tangents: list[Array]) -> list[Array]:
        return _split(_bind(self, _flat(tangents)), self.T.argument_shapes)


def _apply(linear: Linear, vector: Array) -> Array:
    function, tangents = linear.function, _split(vector, linear.argument_shapes)
    apply = function.backward if linear.transposed else function.forward
    return _flat(apply(linear.inputs, linear.active, tangents, linear.run))


@eqxi.filter_primitive_def
def _shape(linear, vector):
    return result_type((sum(map(math.prod, linear.T.argument_shapes)),), jax.tree.leaves((linear, vector)), vector.dtype)


@eqxi.filter_primitive_jvp
def _derivative(primals, tangents):
    linear, vector = primals
    d_linear, d_vector = tangents
    result = _bind(linear, vector)
    if all(dx is None for dx in d_linear.inputs):
        return result, _bind(linear, d_vector)
    kind = CotangentMap if linear.transposed else TangentMap
    changes = [None] * len(linear.argument_shapes) if d_vector is None else _split(d_vector, linear.argument_shapes)
    dxs = [*d_linear.inputs, *changes]
    active = tuple(dx is not None for dx in dxs)
    further = Linear(
        kind(linear.function, linear.active), [*linear.inputs, *_split(vector, linear.argument_shapes)], None, active
    )
    return result, _bind(further, _flat(select(dxs, active)))


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangent):
    linear, _ = inputs
    return jax.tree.map(lambda _: None, linear), _bind(linear.T, cotangent)


_linear_p = linear_primitive("derivative_of_a_run", _apply, _shape, _derivative, _transpose)


@eqxi.filter_primitive_def
def _apply_short(linear, vector):
    """Apply a map outside of compiled programs if machine code computes it; otherwise raise `TooLongError`.

    Other maps contain loops of diffrax, which are compiled in any case.
    """
    if linear.run is None and linear.function.orders < 1:
        raise TooLongError
    return _apply(linear, vector)


expand_as(_linear_p, lambda **parameters: partial(_apply_short, **parameters))


def _bind(linear: Linear, vector: Array) -> Array:
    return eqxi.filter_primitive_bind(_linear_p, linear, vector)


def _flat(inputs: Sequence[Any]) -> Array:
    return jnp.concatenate([jnp.ravel(jnp.asarray(x)) for x in inputs])


def _split(vector: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
    return [part.reshape(shape) for part, shape in zip(jnp.split(vector, ends), shapes, strict=True)]
