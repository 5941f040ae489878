"""The derivative of what elimination finds, at one state: a linear map with a transpose, by programs of its own (derivative.py).

It is a primitive, so that reverse mode runs the transposed program instead of transposing one operation after another, and so
that no derivative is ever taken of what is kept. A derivative of the map itself is that of the plain form.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from udkjax.equations.code import stacked
from udkjax.equations.motion import Vector
from udkjax.equations.plain import plain_accelerations, plain_correction

if TYPE_CHECKING:
    from udkjax.equations.programs import Equations


class Linear(eqx.Module):
    """The derivative of the accelerations or of the projection at one state, or its transpose: a linear map.

    Of tangents of those inputs that are `moving` to the tangents of what is found, each a list of arrays.
    """

    equations: "Equations"
    t: Array
    q: Vector
    v: Vector
    kept: list[Array]
    name: str = eqx.field(static=True)
    moving: tuple[bool, ...] = eqx.field(static=True)
    transposed: bool = eqx.field(static=True, default=False)

    @classmethod
    def at(cls, name: str, primals: Any, moving: tuple[bool, ...], kept: list[Array]) -> "Linear":
        equations, t, q, v = primals
        t = jnp.asarray(t, jnp.result_type(float))
        return cls(equations, t, q, v, [jax.lax.stop_gradient(jnp.asarray(k)) for k in kept], name, moving)

    @property
    def T(self) -> "Linear":
        return dataclasses.replace(self, transposed=not self.transposed)

    @property
    def primals(self) -> tuple["Equations", Array, Vector, Vector]:
        return self.equations, self.t, self.q, self.v


def _linear(linear: Linear, vector: Array) -> Array:
    derivative = linear.equations.code.derivative(linear.name, linear.moving)
    program = derivative.reverse if linear.transposed else derivative.forward
    equations, *state = linear.primals
    return stacked(equations.call(program, *state, *linear.kept, vector))


@eqxi.filter_primitive_def
def _shape(linear, vector):
    found = jax.eval_shape(
        _linear, *jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), (linear, vector))
    )
    return jax.core.ShapedArray(found.shape, found.dtype)


@eqxi.filter_primitive_jvp
def _derivative(primals, tangents):
    linear, vector = primals
    at, dot = tangents
    result = _bind(linear, vector)
    if not jax.tree.leaves(at):
        return result, _bind(linear, dot)
    return result, eqx.filter_jvp(_by_plain_form_of, primals, tangents)[1]


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangent):
    linear, _ = inputs
    return jax.tree.map(lambda _: None, linear), _bind(linear.T, cotangent)


_linear_p = eqxi.create_vprim("derivative_of_elimination", eqxi.filter_primitive_def(_linear), _shape, _derivative, _transpose)


def _bind(linear: Linear, vector: Array) -> Array:
    return eqxi.filter_primitive_bind(_linear_p, linear, vector)


def applied(linear: Linear, vectors: list[Array]) -> list[Array]:
    """Tangents of what is found. In one vector: where vmap batches only some inputs, their cotangents know what to sum over."""
    found = _bind(linear, _flat(vectors))
    return [found[k : k + len(linear.q)] for k in range(0, len(found), len(linear.q))]


# --- the same by the plain form


def by_plain_form(name: str, primals: Any, tangents: Any) -> list[Array]:
    """The tangents of what is found, by the plain form."""
    moving = moving_of(tangents)
    function, at = _plain(name, primals, moving)
    return jax.jvp(function, at, those(tangents, moving))[1]


def _by_plain_form_of(linear: Linear, vector: Array) -> Array:
    function, at = _plain(linear.name, linear.primals, linear.moving)
    if linear.transposed:
        ends = np.cumsum([np.size(x) for x in jax.eval_shape(function, *at)])[:-1]
        return _flat(jax.vjp(function, *at)[1](jnp.split(vector, ends)))
    ends = np.cumsum([np.size(x) for x in at])[:-1]
    parts = [part.reshape(np.shape(x)) for part, x in zip(jnp.split(vector, ends), at, strict=True)]
    return _flat(jax.jvp(function, at, parts)[1])


def _plain(name: str, primals: Any, moving: tuple[bool, ...]) -> tuple[Any, list[Array]]:
    """The plain form as a function of those inputs that are moving, and their values."""

    def function(*some: Array) -> list[Array]:
        rest = iter(some)
        *constants, t, q, v = (next(rest) if moves else x for x, moves in zip(_leaves(primals), moving, strict=True))
        equations = dataclasses.replace(primals[0], constants=constants)
        if name == "accelerations":
            return [plain_accelerations(equations, t, q, v)]
        return list(plain_correction(equations, t, q, v))

    return function, those(primals, moving)


# --- lists of inputs: the constants, t, q, v


def _leaves(primals: Any) -> list[Any]:
    equations, t, q, v = primals
    return [*equations.constants, t, q, v]


def moving_of(tangents: Any) -> tuple[bool, ...]:
    """Which inputs have a tangent at all."""
    return tuple(not isinstance(x, SymbolicZero) and x.dtype != jax.dtypes.float0 for x in _leaves(tangents))


def those(values: Any, moving: tuple[bool, ...]) -> list[Any]:
    """Of constants, t, q and v, or their tangents, those that are moving."""
    return [x for x, moves in zip(_leaves(values), moving, strict=True) if moves]


def _flat(values: Sequence[Any]) -> Array:
    """Numbers and vectors in one vector."""
    return jnp.concatenate([jnp.ravel(jnp.asarray(x, jnp.result_type(float))) for x in values])
