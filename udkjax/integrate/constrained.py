"""A diffrax solver for constrained motion: each step ends on the constraint manifold."""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.integrate.projection import error_after_projection, project
from udkjax.integrate.solvers.counting import Wrapper, tally
from udkjax.integrate.solvers.multistep import Multistep
from udkjax.integrate.stabilization import Stabilization, StabilizedEquations


class Constrained(Wrapper):
    """A diffrax solver for the motion of a mechanism: `args` are its equations, y is (q, v) in one vector.

    With `projected` each step ends on the constraint manifold. The derivative at the end of a step, which a solver stores for the
    next step (FSAL), belongs to the state before projection. `made_jump` therefore makes the solver compute a new derivative.
    (A multistep method would discard its whole history: its `made_jump` is unchanged, since it detects that its newest point
    moved.) The part of an error that projection removes has a small weight. If only some coordinates are integrated, only their
    errors are controlled. All else, such as interpolation, is done by the wrapped solver. Error estimates are returned as
    `Tally`s, with the number of right-hand sides. A user-defined `Stabilization` changes the rates within a step, or the state
    at its end.
    """

    solver: diffrax.AbstractSolver
    projected: bool
    stabilization: Stabilization | None = None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        if (self.projected or self.stabilization is not None) and not isinstance(self.solver, Multistep):
            made_jump = jnp.array(True)
        if self.stabilization is not None:
            args = StabilizedEquations(args, self.stabilization, jnp.asarray(t1 - t0))
        equations, solver = args.fix_partition(t0, *jnp.split(y0, 2)), self.solver
        controlled = equations.independent
        if controlled is not None:
            solver = _with_partial_norm(solver, controlled)
        y1, error, dense, state, result = solver.step(terms, t0, t1, y0, equations, solver_state, made_jump)
        if self.projected:
            y1 = project(equations, t1, y1)
            if error is not None and not isinstance(self.solver, Multistep):
                error = jnp.concatenate(error_after_projection(equations, t1, *jnp.split(y1, 2), *jnp.split(error, 2))[:2])
        if self.stabilization is not None:
            y1 = jnp.concatenate(self.stabilization.end_of_step(args.at(t1, *jnp.split(y1, 2))))
        if controlled is not None:
            error = jnp.where(controlled, jnp.asarray(error), jnp.where(jnp.isfinite(y1), 0.0, jnp.nan))
        return y1, tally(self.solver, error, solver_state, state, made_jump), dense, state, result


class _PartialNorm(eqx.Module):
    """A norm of vectors that takes only the masked `components` into account."""

    norm: Callable[[Float[Array, "2n"]], Float[Array, ""]]
    components: Bool[Array, "2n"]

    def __call__(self, y: Float[Array, "2n"]) -> Float[Array, ""]:
        return self.norm(jnp.where(self.components, y, 0))


def _with_partial_norm(solver: diffrax.AbstractSolver, components: Bool[Array, "2n"]) -> diffrax.AbstractSolver:
    """Return a solver; if it is a multistep method, which controls its own errors, limit their norm to `components`."""
    if not isinstance(solver, Multistep):
        return solver
    return eqx.tree_at(lambda s: s.root_finder.norm, solver, _PartialNorm(solver.root_finder.norm, components))
