"""The fast form: straight-line programs for elimination, with derivatives by programs of their own (derivative.py).

A first derivative goes by the factors that the value was found with, forward or reverse; where `Auto` may branch, and for every
derivative beyond the first, it is that of the plain form.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.interpreters import ad
from jaxtyping import Array, Bool

from udkjax.equations.code import scalars, stacked
from udkjax.equations.motion import Vector
from udkjax.equations.plain import plain_accelerations, plain_correction, plain_project
from udkjax.straightline import Program

if TYPE_CHECKING:
    from udkjax.equations.udwadia_kalaba import Equations


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def accelerations(program: str, equations: "Equations", t: Any, q: Vector, v: Vector) -> Vector:
    """a, by the program of this name."""
    *a, safe = equations.run(program, t, q, v)
    return _checked(equations, safe, stacked(a), plain_accelerations, t, q, v)


@jax.custom_jvp
def project(equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """As the plain form, but with the factors of the first position kept: they differ by the residual, and so does the result."""
    if not equations.code.elimination:
        return plain_project(equations, t, q, v)
    *factors, safe = equations.run("factor", t, q, v)
    step = equations.code.program("step")

    def without(x: Vector, name: str, q: Vector) -> Vector:
        residual = equations.run(name, t, q, x)
        return x - stacked(step([*equations.constants, *factors, *residual]))

    q1 = without(q, "psi_kept", q)
    q2 = without(q1, "psi_kept", q1)
    return _checked(equations, safe, (q2, without(v, "psi_dot_kept", q2)), plain_project, t, q, v)


def _checked(equations: "Equations", safe: Bool[Array, ""], fast: Any, plain: Any, *state: Any) -> Any:
    """Take what elimination gave where its pivots are safe, or where it drops the others itself; else turn to singular values."""
    if equations.code.elimination == "drop" or not equations.doubt:
        return fast
    if equations.branches:
        return jax.lax.cond(safe, lambda: fast, lambda: plain(equations.exact(), *state))
    return jax.tree.map(lambda x: jnp.where(safe, x, jnp.nan), fast)


# --- derivatives


@partial(accelerations.defjvp, symbolic_zeros=True)
def _(program, primals, tangents):
    moving = _moving(tangents)
    if not any(moving):
        return accelerations(program, *primals), jnp.zeros_like(primals[2])
    if primals[0].branches:
        return accelerations(program, *primals), _by_plain_form("accelerations", primals, tangents)[0]
    a, kept = _evaluated(program, moving, *primals)
    return a, _apply(Linear.at("accelerations", primals, moving, kept), _those(tangents, moving))[0]


@partial(project.defjvp, symbolic_zeros=True)
def _(primals, tangents):
    """Where the residuals vanish the tangents of one Newton step are those of the projection."""
    equations, t, *state = primals
    projected = project(equations, t, *state)
    primals, moving = (equations, t, *projected), _moving(tangents)
    if not any(moving):
        return projected, (jnp.zeros_like(state[0]), jnp.zeros_like(state[1]))
    if equations.branches or not equations.code.elimination:
        dq, dv = _by_plain_form("projection", primals, tangents)
        return projected, (dq, dv)
    program = equations.code.derivative("projection", moving).evaluation("projection")
    kept = _run(program, *jax.lax.stop_gradient(primals))
    dq, dv = _apply(Linear.at("projection", primals, moving, kept), _those(tangents, moving))
    return projected, (dq, dv)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _evaluated(program: str, moving: tuple[bool, ...], equations: "Equations", t: Any, q: Vector, v: Vector) -> Any:
    """a, and what its derivative needs to know of the state."""
    outputs = _run(equations.code.derivative("accelerations", moving).evaluation(program), equations, t, q, v)
    n = len(q)
    return _checked(equations, outputs[n], stacked(outputs[:n]), plain_accelerations, t, q, v), outputs[n + 1 :]


@_evaluated.defjvp
def _(program, moving, primals, tangents):
    """What is known of the state is a function of it: a further derivative is taken of the state instead."""
    a, tangent = jax.jvp(partial(accelerations, program), primals, tangents)
    kept = _evaluated(program, moving, *primals)[1]
    return (a, kept), (tangent, [jnp.zeros_like(k) for k in kept])


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


# A primitive of its own, so that reverse mode runs the transposed program instead of transposing one operation after another, and
# so that no derivative is ever taken of what is kept.


def _linear(linear: Linear, vectors: list[Array]) -> list[Array]:
    derivative = linear.equations.code.derivative(linear.name, linear.moving)
    program = derivative.reverse if linear.transposed else derivative.forward
    values = [jnp.asarray(x) for x in _run(program, *linear.primals, [*linear.kept, *scalars(vectors)])]
    if linear.transposed:
        sizes = [np.shape(x) for x in _those(linear.primals, linear.moving)]
    else:
        sizes = [linear.q.shape] * (len(values) // len(linear.q))
    return _shaped(values, sizes)


@eqxi.filter_primitive_def
def _shapes(linear, vectors):
    structs = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), (linear, vectors))
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(_linear, *structs)]


@eqxi.filter_primitive_jvp
def _derivative(primals, tangents):
    linear, vectors = primals
    at, dots = tangents
    result = _apply(linear, vectors)
    if not jax.tree.leaves(at):
        return result, _apply(linear, [jnp.zeros_like(x) if d is None else d for x, d in zip(vectors, dots, strict=True)])
    return result, eqx.filter_jvp(_by_plain_form_of, primals, tangents)[1]


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangents):
    linear, vectors = inputs
    found = _apply(linear.T, cotangents)
    found = [c if isinstance(x, ad.UndefinedPrimal) else None for x, c in zip(vectors, found, strict=True)]
    return jax.tree.map(lambda _: None, linear), found


_apply_p = eqxi.create_vprim("derivative_of_elimination", eqxi.filter_primitive_def(_linear), _shapes, _derivative, _transpose)


def _apply(linear: Linear, vectors: list[Array]) -> list[Array]:
    return eqxi.filter_primitive_bind(_apply_p, linear, vectors)


# --- the same by the plain form


def _by_plain_form(name: str, primals: Any, tangents: Any) -> list[Array]:
    moving = _moving(tangents)
    function, at = _plain(name, primals, moving)
    return jax.jvp(function, at, _those(tangents, moving))[1]


def _by_plain_form_of(linear: Linear, vectors: list[Array]) -> list[Array]:
    function, at = _plain(linear.name, linear.primals, linear.moving)
    return list(jax.vjp(function, *at)[1](vectors)) if linear.transposed else jax.jvp(function, at, vectors)[1]


def _plain(name: str, primals: Any, moving: tuple[bool, ...]) -> tuple[Any, list[Array]]:
    """The plain form as a function of those inputs that are moving, and their values."""

    def function(*some: Array) -> list[Array]:
        rest = iter(some)
        *constants, t, q, v = (next(rest) if moves else x for x, moves in zip(_leaves(primals), moving, strict=True))
        equations = dataclasses.replace(primals[0], constants=constants)
        if name == "accelerations":
            return [plain_accelerations(equations, t, q, v)]
        return list(plain_correction(equations, t, q, v))

    return function, _those(primals, moving)


# --- lists of inputs: the constants, t, q, v


def _leaves(primals: Any) -> list[Any]:
    equations, t, q, v = primals
    return [*equations.constants, t, q, v]


def _moving(tangents: Any) -> tuple[bool, ...]:
    """Which inputs have a tangent at all."""
    return tuple(not isinstance(x, SymbolicZero) and x.dtype != jax.dtypes.float0 for x in _leaves(tangents))


def _those(values: Any, moving: tuple[bool, ...]) -> list[Any]:
    return [x for x, moves in zip(_leaves(values), moving, strict=True) if moves]


def _run(program: Program, equations: "Equations", t: Any, q: Any, v: Any, more: Sequence[Any] = ()) -> list[Any]:
    return program([*equations.constants, t, *scalars([q, v]), *more])


def _shaped(values: Sequence[Any], shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Scalars, gathered into numbers and vectors."""
    rest = iter(values)
    return [jnp.stack([next(rest) for _ in range(shape[0])]) if shape else next(rest) for shape in shapes]
