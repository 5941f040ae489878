"""The motion of a mechanism as a diffrax solver takes it: each step with care, and returned to the constraint manifold."""

from typing import Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.equations.rank_policy import REFUSE
from udkjax.integrate.counting import again, tally
from udkjax.integrate.multistep import Multistep
from udkjax.integrate.projection import lasting, project
from udkjax.integrate.wrapper import Wrapper


class Constrained(Wrapper):
    """A diffrax solver for the motion of a mechanism: `args` are its equations, y is (q, v) in one vector.

    Each step is taken by equations that do not branch, and taken again by those that do where a number came out that is not
    finite: a branch a step instead of one a stage, and a real one under vmap too as long as no member needs it. With `projected`
    the step ends on the constraint manifold. A derivative at its end that the solver would keep for the next step (FSAL) belongs
    to the state before projection; told that the state has jumped, the solver takes a new one. (Not so a multistep method, which
    would forget its whole history: it sees for itself that its newest point was moved.) What projection takes back of an error
    hardly counts. Where the equations integrate only some coordinates, errors are those of these alone. Error estimates, with
    their counts, and interpolation are the wrapped solver's.
    """

    solver: diffrax.AbstractSolver
    projected: bool

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        if self.projected and not isinstance(self.solver, Multistep):
            made_jump = jnp.array(True)
        if not args.branches:
            return self._attempt(terms, t0, t1, y0, args, solver_state, made_jump)
        state = (solver_state, made_jump)
        quick = _in_a_loop(self, terms, t0, t1, y0, args.with_policy(REFUSE), *state)
        doubt = ~jnp.all(jnp.isfinite(quick[0]))

        def fallback():
            y1, error, *rest = _arrays(self._attempt(terms, t0, t1, y0, args, *state))
            return y1, again(quick[1], error), *rest

        return _second_thoughts(doubt, fallback, quick)

    def _attempt(self, terms, t0, t1, y0, equations, solver_state, made_jump):
        equations, solver = equations.held(t0, *jnp.split(y0, 2)), self.solver
        judged = None if equations.independent is None else jnp.tile(equations.independent, 2)
        if judged is not None:
            solver = _judging(solver, judged)
        y1, error, dense, state, result = solver.step(terms, t0, t1, y0, equations, solver_state, made_jump)
        if self.projected:
            y1 = project(equations, t1, y1)
            if error is not None and not isinstance(self.solver, Multistep):
                error = jnp.concatenate(lasting(equations, t1, *jnp.split(y1, 2), *jnp.split(error, 2))[:2])
        if judged is not None:
            error = jnp.where(judged, jnp.asarray(error), jnp.where(jnp.isfinite(y1), 0.0, jnp.nan))
        return y1, tally(self.solver, error, solver_state, state, made_jump), dense, state, result


class _Among(eqx.Module):
    """A norm of some components."""

    norm: Any
    components: Bool[Array, "2n"]

    def __call__(self, y: Float[Array, "2n"]) -> Any:
        return self.norm(jnp.where(self.components, y, 0))


def _judging(solver: diffrax.AbstractSolver, components: Bool[Array, "2n"]) -> Any:
    """A multistep method judges its errors itself: let it see those of some components alone."""
    if not isinstance(solver, Multistep):
        return solver
    return eqx.tree_at(lambda s: s.root_finder.norm, solver, _Among(solver.root_finder.norm, components))


@eqx.filter_custom_jvp
def _in_a_loop(solver: Constrained, terms, t0, t1, y0, equations, solver_state, made_jump):
    """One attempt, as a loop of one round.

    On the CPU, XLA compiles a small loop into one function, but not the loop over the steps, which holds a branch: there each of
    the attempt's hundreds of operations would be a call of its own (5 us a step instead of 1).
    """
    rounds = jnp.where(jnp.isnan(t0), 2, 1)  # one; unknown to the compiler, which removes a loop of one round
    attempt = lambda y: _arrays(solver._attempt(terms, t0, t1, y, equations, solver_state, made_jump))  # noqa: E731
    start = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(lambda: attempt(y0)[1:]))
    loop = jax.lax.while_loop(lambda c: c[0] < rounds, lambda c: (c[0] + 1, attempt(c[1][0])), (0, (y0, *start)))
    return loop[1]


@_in_a_loop.def_jvp
def _(primals, tangents):
    return eqx.filter_jvp(lambda solver, *rest: _arrays(solver._attempt(*rest)), primals, tangents)


def _arrays(tree: Any) -> Any:
    return jax.tree.map(jnp.asarray, tree)


def _second_thoughts(doubt: Any, fallback: Any, quick: Any) -> Any:
    """What was found without branching, or, where that is doubtful, what `fallback` finds."""
    where = lambda a, b: jnp.where(doubt, a, b)  # noqa: E731
    return jax.lax.cond(eqxi.unvmap_any(doubt), lambda: jax.tree.map(where, fallback(), quick), lambda: quick)
