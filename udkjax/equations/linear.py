"""The derivative of what elimination finds, at one state: a linear map with a transpose, by programs of its own (derivative.py).

It is a primitive, so that reverse mode runs the transposed program instead of transposing one operation after another, and so
that no derivative is ever taken of what is kept.

A derivative of the map itself is that of the textbook. The programs depend on the numbers of the scene by constants, the textbook
by the numbers themselves. So the map takes the tangents of both, which say the same: the programs use those of the constants, the
textbook those of the numbers. Transposed, the programs give cotangents of the constants, and none of the numbers, the textbook
those of the numbers: what JAX adds to the derivatives of the former, because the constants are functions of the numbers, is
taken off the latter.
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

if TYPE_CHECKING:
    from udkjax.equations.programs import Equations


class Linear(eqx.Module):
    """The derivative of the accelerations or of the projection at one state, or its transpose: a linear map.

    Of tangents of those inputs that are `moving` or `moved` to the tangents of what is found, each a list of arrays.
    """

    equations: "Equations"
    t: Array
    q: Vector
    v: Vector
    kept: list[Array]
    name: str = eqx.field(static=True)
    moving: tuple[bool, ...] = eqx.field(static=True)  # of the constants, t, q, v
    moved: tuple[bool, ...] = eqx.field(static=True)  # of the numbers of the scene and the gains
    transposed: bool = eqx.field(static=True, default=False)

    @classmethod
    def at(cls, name: str, primals: Any, moving: tuple[bool, ...], moved: tuple[bool, ...], kept: list[Array]) -> "Linear":
        equations, t, q, v = primals
        t = jnp.asarray(t, jnp.result_type(float))
        return cls(equations, t, q, v, [jax.lax.stop_gradient(jnp.asarray(k)) for k in kept], name, moving, moved)

    @property
    def T(self) -> "Linear":
        return dataclasses.replace(self, transposed=not self.transposed)

    @property
    def primals(self) -> tuple["Equations", Array, Vector, Vector]:
        return self.equations, self.t, self.q, self.v


def _linear(linear: Linear, vector: Array) -> Array:
    derivative = linear.equations.code.derivative(linear.name, linear.moving)
    equations, *state = linear.primals
    numbers = sum(np.size(x) for x in those_numbers(linear.primals, linear.moved))
    if linear.transposed:
        found = stacked(equations.call(derivative.reverse, *state, *linear.kept, vector))
        return jnp.concatenate([found, jnp.zeros(numbers, found.dtype)])
    return stacked(equations.call(derivative.forward, *state, *linear.kept, vector[: len(vector) - numbers]))


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
    if not linear.transposed:
        return result, eqx.filter_jvp(_by_plain_form_of, primals, tangents)[1]
    change = eqx.filter_jvp(_by_plain_form_transposed, primals, tangents)[1]
    constants = linear.moving[:-3]
    if not any(constants) or not any(linear.moved):
        return result, change
    bars = [bar[0] for bar in jax.lax.split(result[: sum(constants)], [1] * sum(constants))]
    twice = _flat(through_constants(linear.equations, at.equations, constants, linear.moved, bars))
    return result, change.at[len(change) - len(twice) :].add(-twice)


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangent):
    linear, _ = inputs
    return jax.tree.map(lambda _: None, linear), _bind(linear.T, cotangent)


_linear_p = eqxi.create_vprim("derivative_of_elimination", eqxi.filter_primitive_def(_linear), _shape, _derivative, _transpose)


def _bind(linear: Linear, vector: Array) -> Array:
    return eqxi.filter_primitive_bind(_linear_p, linear, vector)


def applied(linear: Linear, vectors: list[Array], numbers: list[Array]) -> list[Array]:
    """Tangents of what is found. In one vector: where vmap batches only some inputs, their cotangents know what to sum over."""
    found = _bind(linear, _flat([*vectors, *numbers]))
    return [found[k : k + len(linear.q)] for k in range(0, len(found), len(linear.q))]


# --- the same by the textbook


def by_plain_form(name: str, primals: Any, tangents: Any) -> list[Array]:
    """The tangents of what is found, by the textbook."""
    state, moved = tuple(not _is_zero(x) for x in tangents[1:]), numbers_moving_of(tangents)
    function, at = _plain(name, primals, state, moved)
    along = [*those_numbers(tangents, moved), *(x for x, moves in zip(tangents[1:], state, strict=True) if moves)]
    return jax.jvp(function, at, along)[1]


def _by_plain_form_of(linear: Linear, vector: Array) -> Array:
    function, at = _plain(linear.name, linear.primals, linear.moving[-3:], linear.moved)
    constants = sum(linear.moving[:-3])
    state, numbers = jnp.split(vector[constants:], [_size(those(linear.primals, linear.moving)) - constants])
    parts, k = [], 0
    for x in at:  # the numbers, then t, q and v
        parts.append(jnp.concatenate([numbers, state])[k : k + np.size(x)].reshape(np.shape(x)))
        k += np.size(x)
    return _flat(jax.jvp(function, at, parts)[1])


def _by_plain_form_transposed(linear: Linear, vector: Array) -> Array:
    function, at = _plain(linear.name, linear.primals, linear.moving[-3:], linear.moved)
    found = jax.eval_shape(function, *at)
    back = jax.vjp(function, *at)[1](jnp.split(vector, np.cumsum([x.size for x in found])[:-1]))
    numbers = sum(linear.moved)
    return _flat([*[0.0] * sum(linear.moving[:-3]), *back[numbers:], *back[:numbers]])


def through_constants(
    equations: "Equations", along: Any, constants: tuple[bool, ...], moved: tuple[bool, ...], bars: list[Array]
) -> list[Array]:
    """What cotangents of some constants, given as they are, add to the change of those of the numbers that are moved, `along` a
    change of any numbers: None where they have none."""
    numbers, changes = _numbers((equations,)), _numbers((along,))
    turned = tuple(not _is_zero(dx) for dx in changes)

    def pulled(*some: Array) -> list[Array]:
        here = _replaced(numbers, turned, some)

        def function(*some: Array) -> list[Array]:
            found = equations.constants_of(*_with(equations, (True,) * len(here), _replaced(here, moved, some)))
            return [c for c, moves in zip(found, constants, strict=True) if moves]

        return list(jax.vjp(function, *(x for x, m in zip(here, moved, strict=True) if m))[1](bars))

    at, direction = ([x for x, turns in zip(xs, turned, strict=True) if turns] for xs in (numbers, changes))
    return jax.jvp(pulled, at, direction)[1]


def _replaced(values: Sequence[Any], which: tuple[bool, ...], some: Sequence[Any]) -> list[Any]:
    rest = iter(some)
    return [next(rest) if m else x for x, m in zip(values, which, strict=True)]


def _plain(name: str, primals: Any, state: tuple[bool, ...], moved: tuple[bool, ...]) -> tuple[Any, list[Array]]:
    """The textbook as a function of those of the numbers and of t, q and v that move, and their values."""
    equations, *here = primals

    def function(*some: Array) -> list[Array]:
        mechanism, baumgarte = _with(equations, moved, some[: sum(moved)])
        rest = iter(some[sum(moved) :])
        t, q, v = (next(rest) if moves else x for x, moves in zip(here, state, strict=True))
        plain = dataclasses.replace(equations.plain, mechanism=mechanism, baumgarte=baumgarte)
        return [plain.accelerations(t, q, v)] if name == "accelerations" else list(plain.correct(t, q, v))

    return function, [*those_numbers(primals, moved), *(x for x, moves in zip(here, state, strict=True) if moves)]


# --- lists of inputs: the constants, t, q, v; and the numbers of the scene and the gains


def _leaves(primals: Any) -> list[Any]:
    equations, t, q, v = primals
    return [*equations.constants, t, q, v]


def _numbers(primals: Any) -> list[Any]:
    textbook = primals[0].textbook
    return jax.tree.leaves((textbook.mechanism, textbook.baumgarte), is_leaf=lambda x: x is None or isinstance(x, SymbolicZero))


def _with(equations: "Equations", moved: tuple[bool, ...], some: Sequence[Array]) -> Any:
    """The mechanism and the gains, some of whose numbers are replaced."""
    both = equations.textbook.mechanism, equations.textbook.baumgarte
    leaves, tree = jax.tree.flatten(both, is_leaf=lambda x: x is None)
    return tree.unflatten(_replaced(leaves, moved, some))


def _is_zero(x: Any) -> bool:
    return x is None or isinstance(x, SymbolicZero) or x.dtype == jax.dtypes.float0


def moving_of(tangents: Any) -> tuple[bool, ...]:
    """Which of the constants, t, q and v have a tangent at all."""
    return tuple(not _is_zero(x) for x in _leaves(tangents))


def numbers_moving_of(tangents: Any) -> tuple[bool, ...]:
    """Which numbers of the scene and which gains have a tangent at all."""
    return tuple(not _is_zero(x) for x in _numbers(tangents))


def those(values: Any, moving: tuple[bool, ...]) -> list[Any]:
    """Of constants, t, q and v, or their tangents, those that are moving."""
    return [x for x, moves in zip(_leaves(values), moving, strict=True) if moves]


def those_numbers(values: Any, moved: tuple[bool, ...]) -> list[Any]:
    """Of the numbers of the scene and the gains, or their tangents, those that are moved."""
    return [x for x, moves in zip(_numbers(values), moved, strict=True) if moves]


def _size(values: Sequence[Any]) -> int:
    return sum(np.size(x) for x in values)


def _flat(values: Sequence[Any]) -> Array:
    """Numbers and vectors in one vector."""
    return jnp.concatenate([jnp.ravel(jnp.asarray(x, jnp.result_type(float))) for x in values])
