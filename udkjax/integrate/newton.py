"""Modified Newton for implicit multistep methods: a Jacobian that is kept while it serves.

An implicit step looks for the correction e to a predicted state y,

    e = c (f(t, y + e) - v),        c = h / gamma,

with v the predicted derivative. Newton's method, with a matrix M = I - c J that may be some steps old, repeats

    M d = c (f(t, y + e) - v) - e,        e <- e + d.

Its limit does not depend on M, nor does its derivative, which is that of the equation by the implicit function theorem. When to
take a new J and a new M, when to stop and when to give up are the rules of VODE (Brown, Byrne, Hindmarsh, "VODE: a
variable-coefficient ODE solver", SIAM J. Sci. Stat. Comput. 10, 1989).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.multistep import field

ITERATIONS = 3  # with one matrix, by default: more rarely help
JACOBIAN_STEPS, MATRIX_STEPS = 50, 20  # for which they are kept at most
CHANGE = 0.3  # of c, relatively, up to which M is kept
FASTEST = 0.3  # the rate of convergence falls by this factor an iteration at most: one fast iteration proves little
DIVERGING = 2.0  # ratio of successive corrections at which to give up


class Implicit(eqx.Module):
    """The equation e = c (f(t, y + e) - v) of a step, in vectors (n,)."""

    terms: Any
    args: Any
    unravel: Callable
    t: Float[Array, ""]
    y: Float[Array, "n"]
    v: Float[Array, "n"]
    c: Float[Array, ""]

    def field(self, e: Float[Array, "n"]) -> Float[Array, "n"]:
        """f(t, y + e)."""
        return field(self.terms, self.t, self.unravel(self.y + e), self.args)

    def with_jacobian(self, e: Float[Array, "n"]) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
        """f(t, y + e) and its derivative, from one call of the vector field."""
        jacobian, f = jax.jacfwd(lambda e: (self.field(e),) * 2, has_aux=True)(e)
        return f, jacobian


class Kept(eqx.Module):
    """What one step leaves to the next: J, the factors of M, their ages in steps, the rate of convergence, and counts."""

    jacobian: Float[Array, "n n"]
    lu: Float[Array, "n n"]
    pivots: Int[Array, "n"]
    c: Float[Array, ""]  # of M
    jacobian_age: Int[Array, ""]
    matrix_age: Int[Array, ""]
    rate: Float[Array, ""]
    evaluations: Int[Array, ""]
    jacobians: Int[Array, ""]
    factorizations: Int[Array, ""]


def nothing_kept(n: int, dtype: Any) -> Kept:
    """At the start."""
    matrix, none, one = jnp.zeros((n, n), dtype), jnp.array(0), jnp.ones((), dtype)
    return Kept(matrix, matrix, jnp.arange(n, dtype=jnp.int32), one, none, none, one, none, none, none)


def outdated(kept: Kept) -> Kept:
    """So that the next step takes a Jacobian."""
    return eqx.tree_at(lambda k: k.jacobian_age, kept, jnp.full_like(kept.jacobian_age, JACOBIAN_STEPS))


class _Iteration(eqx.Module):
    kept: Kept
    e: Float[Array, "n"]
    size: Float[Array, ""]  # of the last correction
    count: Int[Array, ""]
    fresh: Bool[Array, ""]  # the Jacobian is of this step
    renew: Bool[Array, ""]  # take a Jacobian now
    factor: Bool[Array, ""]  # and factorize M
    converged: Bool[Array, ""]
    failed: Bool[Array, ""]


@eqx.filter_custom_jvp
def solve(equation: Implicit, size: Callable, kept: Kept, iterations: int) -> tuple[Float[Array, "n"], Bool[Array, ""], Kept]:
    """Return e, whether it was found, and what is kept for the next step.

    `size` is a pytree that is called: of a correction it tells how much it matters, which shall be less than one. After so many
    `iterations` with one matrix it is given up.
    """
    renew = kept.jacobian_age >= JACOBIAN_STEPS
    factor = renew | (kept.matrix_age >= MATRIX_STEPS) | ~(jnp.abs(equation.c / kept.c - 1) <= CHANGE)
    no = jnp.array(False)
    start = _Iteration(kept, jnp.zeros_like(equation.y), jnp.ones_like(equation.c), jnp.array(0), no, renew, factor, no, no)

    def iterate(now: _Iteration) -> _Iteration:
        f, kept = _matrices(equation, now)
        residual = equation.c * (f - equation.v) - now.e
        d = 2 / (1 + equation.c / kept.c) * lu_solve((kept.lu, kept.pivots), residual)
        far = size(d)
        first = now.count == 0
        rate = jnp.where(first, kept.rate, jnp.maximum(FASTEST * kept.rate, far / now.size))
        converged = far * jnp.minimum(1.0, rate) <= 1
        hopeless = ~first & ~(far <= DIVERGING * now.size) | (now.count == iterations - 1) | ~jnp.isfinite(far)
        stuck, fresh = ~converged & hopeless, now.fresh | now.renew
        again = stuck & ~fresh
        kept = eqx.tree_at(lambda k: k.rate, kept, jnp.where(jnp.isfinite(rate) & ~stuck, rate, 1.0))
        e, far, count = (jnp.where(again, a, b) for a, b in ((0.0, now.e + d), (1.0, far), (0, now.count + 1)))
        return _Iteration(kept, e, far, count, fresh, again, again, converged, stuck & fresh)

    end = jax.lax.while_loop(lambda now: ~(now.converged | now.failed), iterate, start)
    kept = eqx.tree_at(lambda k: (k.jacobian_age, k.matrix_age), end.kept, (end.kept.jacobian_age + 1, end.kept.matrix_age + 1))
    return end.e, end.converged, kept


@solve.def_jvp
def _(primals, tangents):
    equation = primals[0]
    e, found, kept = solve(*primals)
    residual = lambda p: p.c * (p.field(e) - p.v)  # noqa: E731
    rhs = eqx.filter_jvp(residual, (equation,), (tangents[0],))[1]
    matrix = jnp.eye(len(e), dtype=e.dtype) - equation.c * jax.jacfwd(equation.field)(e)
    return (e, found, kept), (jnp.linalg.solve(matrix, rhs), None, jax.tree.map(lambda _: None, kept))


def _matrices(equation: Implicit, now: _Iteration) -> tuple[Float[Array, "n"], Kept]:
    """f, and what is kept, with a new J and a new M where they are due: branches, also under vmap while no member needs them."""
    kept, renew = now.kept, now.renew

    def renewed():
        f, jacobian = equation.with_jacobian(now.e)
        return f, jnp.where(renew, jacobian, kept.jacobian)

    f, jacobian = jax.lax.cond(eqxi.unvmap_any(renew), renewed, lambda: (equation.field(now.e), kept.jacobian))

    def factorized():
        lu, pivots = lu_factor(jnp.eye(len(f), dtype=f.dtype) - equation.c * jacobian)
        return jnp.where(now.factor, lu, kept.lu), jnp.where(now.factor, pivots, kept.pivots)

    lu, pivots = jax.lax.cond(eqxi.unvmap_any(now.factor), factorized, lambda: (kept.lu, kept.pivots))
    new = lambda a, b, pred: jnp.where(pred, a, b)  # noqa: E731
    kept = Kept(
        jacobian,
        lu,
        pivots,
        c=new(equation.c, kept.c, now.factor),
        jacobian_age=new(0, kept.jacobian_age, renew),
        matrix_age=new(0, kept.matrix_age, now.factor),
        rate=new(1.0, kept.rate, now.factor),
        evaluations=kept.evaluations + 1,
        jacobians=kept.jacobians + renew,
        factorizations=kept.factorizations + now.factor,
    )
    return f, kept
