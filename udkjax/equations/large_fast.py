"""The fast form of large scenes: elimination where it can be trusted, with the derivatives of the plain form (large_plain.py)."""

from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from udkjax.equations.code import CONSISTENT
from udkjax.equations.large_plain import branch, plain_accelerations, plain_correction, plain_project, plain_tangential
from udkjax.equations.motion import FAR, NEAR, Tangential, Vector
from udkjax.pinv.block_methods import factorized, solved
from udkjax.pinv.blocks import by_block, flat

if TYPE_CHECKING:
    from udkjax.equations.large import LargeEquations


@jax.custom_jvp
def accelerations(equations: "LargeEquations", t: Any, q: Vector, v: Vector) -> Vector:
    """a = a_F + M^(-1/2) D^+ b of the rows kept; where the policy is to reveal the rank, those left out are looked at."""
    layout, root = equations.layout, equations.numbers["root"]
    free = equations.free(t, q, v)
    if not len(layout.kept.rows):
        return flat(free)
    D, b = equations.arrays(layout.kept, ["D", "b"], t, q, v, free)
    pattern = layout.kept.pattern
    factors, safe = factorized(pattern, D, equations.drop, loop=equations.loop)
    x = pattern.rmatvec(D, solved(pattern, factors, b, equations.loop))
    a = flat(free + root * x)
    if equations.branches and layout.left_out:
        safe = safe & _satisfied(equations, t, q, v, free, x)
    return _checked(equations, safe, a, plain_accelerations, t, q, v)


def _satisfied(equations: "LargeEquations", t: Any, q: Vector, v: Vector, free: Array, x: Array) -> Bool[Array, ""]:
    """Whether the accelerations satisfy the rows left out, too: D x = b, relative to the size of its terms."""
    rows = equations.layout.all
    D, b = equations.arrays(rows, ["D", "b"], t, q, v, free)
    sum_of = rows.pattern.matvec
    return jnp.all(jnp.abs(sum_of(D, x) - b) <= CONSISTENT * (sum_of(jnp.abs(D), jnp.abs(x)) + jnp.abs(b)))


@partial(jax.custom_jvp, nondiff_argnums=(4,))
def project(equations: "LargeEquations", t: Any, q: Vector, v: Vector, steps: int) -> tuple[Vector, Vector]:
    """q and v on the manifold, with the derivatives of `as_projected`."""
    return _fast_project(equations, t, q, v, steps) if equations.by_levels else plain_project(equations, t, q, v)


@project.defjvp
def _(steps, primals, tangents):
    equations, t, q, v = primals
    return jax.jvp(as_projected, (equations, t, *project(equations, t, q, v, steps)), tangents)


@jax.custom_jvp
def as_projected(equations: "LargeEquations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """A state on the manifold, with the derivatives of a projection that returns it."""
    del equations, t
    return q, v


@as_projected.defjvp
def _(primals, tangents):
    """Where the residuals vanish the tangents of one Newton step are those of the projection."""
    _, _, q, v = primals
    return (q, v), jax.jvp(plain_correction, primals, tangents)[1]


def _fast_project(equations: "LargeEquations", t: Any, q: Vector, v: Vector, steps: int) -> tuple[Vector, Vector]:
    """Newton steps in position until one moves nothing, and one in velocity: rounds of one loop, so as to compile one of them."""
    rows, root = equations.layout.kept, equations.numbers["root"]
    if not len(rows.rows):
        return q, v

    def step(state: Any) -> Any:
        k, q, v, closed, _, safe = state
        D, psi, psi_dot = equations.arrays(rows, ["D", "psi", "psi_dot"], t, q, v)
        factors, still = factorized(rows.pattern, D, equations.drop, loop=equations.loop)
        y = solved(rows.pattern, factors, jnp.where(closed, psi_dot, psi), equations.loop)
        x = flat(root * rows.pattern.rmatvec(D, y))
        near = (equations.size(x) <= FAR) | (k + 1 >= steps)
        return k + 1, jnp.where(closed, q, q - x), jnp.where(closed, v - x, v), near, closed, safe & still

    start = 0, q, v, *(jnp.array(x) for x in (False, False, True))
    _, *found, _, _, safe = jax.lax.while_loop(lambda s: ~s[-2], step, start)
    return _checked(equations, safe, tuple(found), plain_project, t, q, v)


def tangential(equations: "LargeEquations", t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> Tangential:
    """As the plain form, with one elimination for all of it, and the rest of it in rounds of one loop."""
    rows, root = equations.layout.kept, flat(equations.numbers["root"])
    if not len(rows.rows) or not equations.by_levels or equations.branches:
        return plain_tangential(equations, t, q, v, dq, dv)
    (D,) = equations.arrays(rows, ["D"], t, q, v)
    factors, far = factorized(rows.pattern, D, NEAR**2, loop=equations.loop)

    def left(x: Vector) -> Vector:
        residual = rows.pattern.matvec(D, by_block(x / root, 3))
        return x - root * flat(rows.pattern.rmatvec(D, solved(rows.pattern, factors, residual, equations.loop)))

    first, second = jax.lax.map(left, jnp.stack([dq, dv]))
    return Tangential(first, second, jnp.where(far, jnp.inf, 0.0))


accelerations.defjvp(lambda primals, tangents: jax.jvp(plain_accelerations, primals, tangents))


def _checked(equations: "LargeEquations", safe: Bool[Array, ""], fast: Any, plain: Any, *state: Any) -> Any:
    """Take what elimination gave where its pivots are safe; else turn to the dense method, or say that it is not a number."""
    if equations.policy.action == "drop":
        return fast
    if not equations.branches:
        return jax.tree.map(lambda x: jnp.where(safe, x, jnp.nan), fast)
    return branch(safe, lambda: fast, lambda: plain(equations.dense_form, *state))
