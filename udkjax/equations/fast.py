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
from jaxtyping import Array, Bool

from udkjax.equations.code import scalars, stacked
from udkjax.equations.motion import Tangential, Vector
from udkjax.equations.plain import plain_accelerations, plain_correction, plain_project, plain_tangential
from udkjax.straightline import Program, when

if TYPE_CHECKING:
    from udkjax.equations.udwadia_kalaba import Equations

FAR = 1e-8  # m, rad: Newton's method converges quadratically, and leaves rounding errors of a residual that moves less


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def accelerations(program: str, equations: "Equations", t: Any, q: Vector, v: Vector) -> Vector:
    """a, by the program of this name."""
    *a, safe = equations.run(program, t, q, v)
    return _checked(equations, safe, stacked(a), plain_accelerations, t, q, v)


def project(equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """As the plain form, but with the factors of the first position kept: they differ by the residual, and so does the result."""
    found, _, safe = _projected(None, equations, t, q, v)
    return _trusted(found, safe)


def kept(equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector, list[Array]]:
    """`project` by elimination without a branch, and the factors of the first position: in a loop side by side.

    What a loop hands on costs as many addresses as there are arrays.
    """
    found, (_, factors), safe = _projected(None, equations, t, q, v)
    return *_trusted(found, safe), [stacked(factors)] if equations.loop else factors


def closed(equations: "Equations", t: Any, q: Vector, v: Vector, steps: Any) -> tuple[Vector, Vector, Array]:
    """By elimination without a branch: Newton steps in position and velocity, and how far the last one went."""
    found, (moved, _), safe = _projected(steps, equations, t, q, v)
    return *_trusted(found, safe), moved


def _trusted(found: Sequence[Array], safe: Any) -> tuple[Array, Array]:
    q, v = (jnp.where(safe, x, jnp.nan) for x in found)
    return q, v


@jax.custom_jvp
def _projected(steps: Any, equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Any, Any, Any]:
    """q and v, numbers in any case; how far the last step went, and the factors; and whether all that can be trusted.

    At most so many `steps` go in position and velocity, until one moves neither; if None, one in velocity, and in position a
    second if the first moved it. Derivatives are taken where q and v are then.
    """
    if not equations.eliminates:
        return plain_project(equations, t, q, v), (jnp.nan, []), jnp.array(True)
    *factors, safe = equations.run("factor", t, q, v)
    step = equations.code.program("step")

    # On scalars until all is done: vectors that a loop carries have the batch first under vmap, where the programs have it last.

    def without(xs: Sequence[Array], name: str, qs: Sequence[Array]) -> list[Array]:
        residual = equations.code.program(name)([*equations.constants, t, *qs, *xs], equations.loop)
        change = step([*equations.constants, *factors, *residual], equations.loop)
        return [x - y for x, y in zip(xs, change, strict=True)]

    def nearer(state: Any) -> Any:
        k, q, v, _ = state
        q1 = without(q, "psi_kept", q)
        v1 = without(v, "psi_dot_kept", q1)
        return k + 1, q1, v1, _largest_change([*q1, *v1], [*q, *v])

    qs, vs = scalars([q]), scalars([v])
    if steps is not None:
        _, *found, moved = jax.lax.while_loop(lambda s: (s[0] < steps) & ~(s[-1] <= FAR), nearer, (0, qs, vs, jnp.inf))
    else:
        q1 = without(qs, "psi_kept", qs)
        moved = _largest_change(q1, qs)
        q2 = when(moved > FAR, lambda q1: without(q1, "psi_kept", q1), q1)
        found = [q2, without(vs, "psi_dot_kept", q2)]
    found = [stacked(x) for x in found]
    if equations.branches:
        return _branched(equations, safe, tuple(found), plain_project, t, q, v), (moved, []), jnp.array(True)
    return tuple(found), (moved, factors), safe if _checks(equations) else jnp.array(True)


def _largest_change(new: Sequence[Array], old: Sequence[Array]) -> Array:
    """Of any number; by halves, so that few wait for others."""
    changes = [jnp.abs(x - y) for x, y in zip(new, old, strict=True)]
    while len(changes) > 1:
        pairs = zip(changes[::2], changes[1::2], strict=False)
        changes = [*(jnp.maximum(a, b) for a, b in pairs), *changes[len(changes) // 2 * 2 :]]
    return changes[0]


def tangential(
    equations: "Equations", t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector, factors: list[Array] | None
) -> Tangential:
    """What projection at q leaves of small changes: for estimates of errors, which nobody differentiates, nor do they branch."""
    if not equations.eliminates:
        return plain_tangential(equations, t, q, v, dq, dv)
    if factors is None:
        *factors, _ = equations.run("factor", t, q, v)
    factors = scalars(factors) if equations.loop else factors
    given = [*equations.constants, *factors, *scalars([dq, dv])]
    *changes, far = equations.code.program("tangential")(given, equations.loop)
    return Tangential(stacked(changes[: len(q)]), stacked(changes[len(q) :]), far)


def _checked(equations: "Equations", safe: Bool[Array, ""], fast: Any, plain: Any, *state: Any) -> Any:
    """Take what elimination gave where its pivots are safe, or where it drops the others itself; else turn to singular values."""
    if equations.branches:
        return _branched(equations, safe, fast, plain, *state)
    return jnp.where(safe, fast, jnp.nan) if _checks(equations) else fast


def _checks(equations: "Equations") -> bool:
    """Whether to mark what pivots that are not safe have to do with, instead of dropping their rows."""
    return equations.doubt and equations.code.elimination == "check"


def _branched(equations: "Equations", safe: Bool[Array, ""], fast: Any, plain: Any, *state: Any) -> Any:
    return jax.lax.cond(safe, lambda: fast, lambda: plain(equations.exact(), *state))


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


@partial(_projected.defjvp, symbolic_zeros=True)
def _(primals, tangents):
    equations, t, _, _ = primals[1:]
    (q, v), about, safe = _projected(*primals)
    dq, dv = _correction(equations, t, q, v, tangents[1:])
    return ((q, v), about, safe), ((dq, dv), *jax.tree.map(_no_tangent, (about, safe)))


@jax.custom_jvp
def as_projected(equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """A state on the manifold, with the derivatives of a projection that returns it."""
    del equations, t
    return q, v


@partial(as_projected.defjvp, symbolic_zeros=True)
def _(primals, tangents):
    equations, t, q, v = primals
    dq, dv = _correction(equations, t, q, v, tangents)
    return (q, v), (dq, dv)


def _correction(equations: "Equations", t: Any, q: Vector, v: Vector, tangents: Any) -> Sequence[Array]:
    """Where the residuals vanish the tangents of one Newton step are those of the projection."""
    primals, moving = (equations, t, q, v), _moving(tangents)
    if not any(moving):
        return jnp.zeros_like(q), jnp.zeros_like(v)
    if equations.branches or not equations.eliminates:
        return _by_plain_form("projection", primals, tangents)
    program = equations.code.derivative("projection", moving).evaluation("projection")
    kept = _run(program, *jax.lax.stop_gradient(primals))
    return _apply(Linear.at("projection", primals, moving, kept), _those(tangents, moving))


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


def _linear(linear: Linear, vector: Array) -> Array:
    derivative = linear.equations.code.derivative(linear.name, linear.moving)
    program = derivative.reverse if linear.transposed else derivative.forward
    return stacked(_run(program, *linear.primals, [*linear.kept, *scalars([vector])]))


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


def _apply(linear: Linear, vectors: list[Array]) -> list[Array]:
    """Tangents of what is found. In one vector: where vmap batches only some inputs, their cotangents know what to sum over."""
    found = _bind(linear, _flat(vectors))
    return [found[k : k + len(linear.q)] for k in range(0, len(found), len(linear.q))]


# --- the same by the plain form


def _by_plain_form(name: str, primals: Any, tangents: Any) -> list[Array]:
    moving = _moving(tangents)
    function, at = _plain(name, primals, moving)
    return jax.jvp(function, at, _those(tangents, moving))[1]


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

    return function, _those(primals, moving)


def _no_tangent(x: Any) -> Any:
    return jnp.zeros_like(x) if jnp.issubdtype(jnp.result_type(x), jnp.inexact) else np.zeros(jnp.shape(x), jax.dtypes.float0)


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
    return program([*equations.constants, t, *scalars([q, v]), *more], equations.loop)


def _flat(values: Sequence[Any]) -> Array:
    """Numbers and vectors in one vector."""
    return jnp.concatenate([jnp.ravel(jnp.asarray(x, jnp.result_type(float))) for x in values])
