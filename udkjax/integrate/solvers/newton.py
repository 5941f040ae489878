"""Modified Newton method for implicit multistep methods, with a Jacobian that is reused while it converges.

An implicit step solves for the correction e of a predicted state y,

    e = c (f(t, y + e) - v),        c = h / gamma,

where v is the predicted derivative. Newton's method, with a matrix M = I - c J that may be some steps old, repeats

    M d = c (f(t, y + e) - v) - e,        e <- e + d.

Its limit and its derivative, by the implicit function theorem, do not depend on M. The rules for a new J and M, for stopping and
for giving up are those of VODE (Brown, Byrne, Hindmarsh, "VODE: a variable-coefficient ODE solver", SIAM J. Sci. Stat. Comput. 10
(1989) 1038), with its names in the comments below.
"""

from collections.abc import Callable

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.scipy.linalg import lu_factor, lu_solve
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from udkjax.integrate.solvers.multistep import Unravel, vector_field

ITERATIONS = 3  # MAXCOR: iterations with one matrix; more rarely help
JACOBIAN_STEPS, MATRIX_STEPS = 50, 20  # MSBJ, MSBP: largest ages in steps
COEFFICIENT_CHANGE = 0.3  # CCMAX: largest relative change of c with the same M
RATE_MEMORY = 0.3  # CRDOWN: largest decrease of the rate of convergence in an iteration, since one fast iteration proves little
DIVERGING_RATIO = 2.0  # RDIV: ratio of successive corrections at which to give up


class Implicit(eqx.Module):
    """The equation e = c (f(t, y + e) - v) of a step, in vectors (n,)."""

    terms: PyTree
    args: PyTree
    unravel: Unravel
    t: Float[Array, ""]
    y: Float[Array, "n"]
    v: Float[Array, "n"]
    c: Float[Array, ""]

    def field(self, e: Float[Array, "n"]) -> Float[Array, "n"]:
        """Return f(t, y + e)."""
        return vector_field(self.terms, self.t, self.unravel(self.y + e), self.args)

    def with_jacobian(self, e: Float[Array, "n"]) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
        """Return f(t, y + e) and its derivative, from one call of the vector field."""
        jacobian, f = jax.jacfwd(lambda e: (self.field(e),) * 2, has_aux=True)(e)
        return f, jacobian


class NewtonState(eqx.Module):
    """The state of the iteration after a step: J, the factors of M, their ages in steps, the rate of convergence, and counts."""

    jacobian: Float[Array, "n n"]
    lu: Float[Array, "n n"]
    pivots: Int[Array, "n"]
    c: Float[Array, ""]  # the c of M
    jacobian_age: Int[Array, ""]
    matrix_age: Int[Array, ""]
    rate: Float[Array, ""]
    evaluations: Int[Array, ""]
    jacobians: Int[Array, ""]
    factorizations: Int[Array, ""]


def initial_state(n: int, dtype: DTypeLike) -> NewtonState:
    """Return the state before the first step."""
    matrix, none, one = jnp.zeros((n, n), dtype), jnp.array(0), jnp.ones((), dtype)
    return NewtonState(matrix, matrix, jnp.arange(n, dtype=jnp.int32), one, none, none, one, none, none, none)


def invalidate(state: NewtonState) -> NewtonState:
    """Return the state with a Jacobian too old for the next step."""
    return eqx.tree_at(lambda k: k.jacobian_age, state, jnp.full_like(state.jacobian_age, JACOBIAN_STEPS))


class _Iteration(eqx.Module):
    state: NewtonState
    e: Float[Array, "n"]
    size: Float[Array, ""]  # size of the last correction
    count: Int[Array, ""]
    fresh: Bool[Array, ""]  # the Jacobian was computed in this step
    renew: Bool[Array, ""]  # compute a Jacobian now
    factor: Bool[Array, ""]  # factorize M now
    converged: Bool[Array, ""]
    failed: Bool[Array, ""]


@eqx.filter_custom_jvp
def solve(
    equation: Implicit, size: Callable[[Float[Array, "n"]], Float[Array, ""]], state: NewtonState, iterations: int
) -> tuple[Float[Array, "n"], Bool[Array, ""], NewtonState]:
    """Return e, whether the iteration converged, and the state for the next step.

    Args:
        equation: the equation for e.
        size: a function, as a pytree, that returns the size of a correction; e has converged if its error is of size one or less.
        state: the state after the last step.
        iterations: the number of iterations with one matrix after which the iteration fails.
    """
    renew = state.jacobian_age >= JACOBIAN_STEPS
    factor = renew | (state.matrix_age >= MATRIX_STEPS) | ~(jnp.abs(equation.c / state.c - 1) <= COEFFICIENT_CHANGE)
    no = jnp.array(False)
    start = _Iteration(state, jnp.zeros_like(equation.y), jnp.ones_like(equation.c), jnp.array(0), no, renew, factor, no, no)

    def iterate(now: _Iteration) -> _Iteration:
        f, state = _matrices(equation, now)
        residual = equation.c * (f - equation.v) - now.e
        d = 2 / (1 + equation.c / state.c) * lu_solve((state.lu, state.pivots), residual)
        far = size(d)
        first = now.count == 0
        rate = jnp.where(first, state.rate, jnp.maximum(RATE_MEMORY * state.rate, far / now.size))
        converged = far * jnp.minimum(1.0, rate) <= 1
        hopeless = ~first & ~(far <= DIVERGING_RATIO * now.size) | (now.count == iterations - 1) | ~jnp.isfinite(far)
        stuck, fresh = ~converged & hopeless, now.fresh | now.renew
        refreshes = stuck & ~fresh
        state = eqx.tree_at(lambda k: k.rate, state, jnp.where(jnp.isfinite(rate) & ~stuck, rate, 1.0))
        e, far, count = (jnp.where(refreshes, a, b) for a, b in ((0.0, now.e + d), (1.0, far), (0, now.count + 1)))
        return _Iteration(state, e, far, count, fresh, refreshes, refreshes, converged, stuck & fresh)

    end = jax.lax.while_loop(lambda now: ~(now.converged | now.failed), iterate, start)
    state = eqx.tree_at(
        lambda k: (k.jacobian_age, k.matrix_age), end.state, (end.state.jacobian_age + 1, end.state.matrix_age + 1)
    )
    return end.e, end.converged, state


@solve.def_jvp
def _(primals, tangents):
    equation = primals[0]
    e, found, state = solve(*primals)
    residual = lambda p: p.c * (p.field(e) - p.v)  # noqa: E731
    rhs = eqx.filter_jvp(residual, (equation,), (tangents[0],))[1]
    matrix = jnp.eye(len(e), dtype=e.dtype) - equation.c * jax.jacfwd(equation.field)(e)
    return (e, found, state), (jnp.linalg.solve(matrix, rhs), None, jax.tree.map(lambda _: None, state))


def _matrices(equation: Implicit, now: _Iteration) -> tuple[Float[Array, "n"], NewtonState]:
    """Return f, and the state with a new J and a new M if they are due.

    J and M are each computed in a branch, which under vmap is skipped as long as no member needs it.
    """
    state, renew = now.state, now.renew

    def take_jacobian():
        f, jacobian = equation.with_jacobian(now.e)
        return f, jnp.where(renew, jacobian, state.jacobian)

    f, jacobian = jax.lax.cond(eqxi.unvmap_any(renew), take_jacobian, lambda: (equation.field(now.e), state.jacobian))

    def factorize():
        lu, pivots = lu_factor(jnp.eye(len(f), dtype=f.dtype) - equation.c * jacobian)
        return jnp.where(now.factor, lu, state.lu), jnp.where(now.factor, pivots, state.pivots)

    lu, pivots = jax.lax.cond(eqxi.unvmap_any(now.factor), factorize, lambda: (state.lu, state.pivots))
    new = lambda a, b, pred: jnp.where(pred, a, b)  # noqa: E731
    state = NewtonState(
        jacobian,
        lu,
        pivots,
        c=new(equation.c, state.c, now.factor),
        jacobian_age=new(0, state.jacobian_age, renew),
        matrix_age=new(0, state.matrix_age, now.factor),
        rate=new(1.0, state.rate, now.factor),
        evaluations=state.evaluations + 1,
        jacobians=state.jacobians + renew,
        factorizations=state.factorizations + now.factor,
    )
    return f, state
