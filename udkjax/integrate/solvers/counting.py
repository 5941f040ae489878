"""Exact counts of right-hand sides, including those of rejected steps.

diffrax counts only steps, and restores the solver's state after a rejected step, but not the controller's. Each step therefore
returns its count together with its error estimate, and the controller adds them up.
"""

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Int, PyTree

NOT_COUNTED = -1  # count before the first step, which also returns the evaluations of the start


class Tally(eqx.Module):
    """The error estimate of an attempted step, and the numbers of calls of the vector field in and before it; None: unknown."""

    error: PyTree[Array]
    evaluations: Int[Array, ""] | None
    before: Int[Array, ""] | None


def tally(solver: diffrax.AbstractSolver, error: PyTree, before: PyTree, after: PyTree, made_jump: Bool[ArrayLike, ""]) -> Tally:
    """Return the tally of an attempted step, from the solver's states before and after it.

    The numbers of calls are known for explicit Runge-Kutta methods, from their tableau, and for methods whose state has a field
    `evaluations`, the number of calls so far.
    """
    if hasattr(before, "evaluations"):
        return Tally(error, after.evaluations - before.evaluations, before.evaluations)
    if not issubclass(type(solver), diffrax.AbstractERK):  # checked for its own type: a wrapper may take several steps at once
        return Tally(error, None, None)
    stages = solver.tableau.num_stages  # pyright: ignore[reportAttributeAccessIssue]
    if before is not None:  # the last stage of the previous step is the first of this one
        nothing_kept, _ = before
        stages = stages - jnp.where(nothing_kept | made_jump, 0, 1)
    return Tally(error, jnp.asarray(stages), jnp.asarray(0))


class Wrapper(diffrax.AbstractAdaptiveSolver, diffrax.AbstractWrappedSolver):
    """A diffrax solver that forwards all attributes and methods except `step` to another solver."""

    solver: eqx.AbstractVar[diffrax.AbstractSolver]

    @property
    def root_finder(self):
        """The root finder of an implicit solver: diffrax gives it the tolerances of the step size controller."""
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def scan_kind(self):
        """The kind of the loop over the stages of a Runge-Kutta method; some adjoints of diffrax set it."""
        return self.solver.scan_kind  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def term_structure(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_compatible_contr_kwargs

    def order(self, terms):
        return self.solver.order(terms)

    def strong_order(self, terms):
        return self.solver.strong_order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)


class CountingSolver(Wrapper):
    """A solver whose error estimates are `Tally`s."""

    solver: diffrax.AbstractSolver

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, error, dense, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        return y1, tally(self.solver, error, solver_state, state, made_jump), dense, state, result


class CountingController(diffrax.AbstractAdaptiveStepSizeController):
    """A step size controller that adds up the counts of a `CountingSolver`."""

    controller: diffrax.AbstractStepSizeController

    def __init__(self, controller: diffrax.AbstractStepSizeController):
        self.controller = controller

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.rtol  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.atol  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.norm  # pyright: ignore[reportAttributeAccessIssue]

    def wrap(self, direction):
        return CountingController(self.controller.wrap(direction))

    def init(self, *args, **kwargs):
        tnext, state = self.controller.init(*args, **kwargs)
        return tnext, (state, jnp.array(NOT_COUNTED))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error: PyTree, error_order, controller_state):
        state, total = controller_state
        keep, *times, jumped, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error.error, error_order, state
        )
        if y_error.evaluations is not None:
            # diffrax replaces NaN in errors, which converts these counts to floats
            taken, before = (jnp.asarray(x).astype(total.dtype) for x in (y_error.evaluations, y_error.before))
            total = jnp.where(total == NOT_COUNTED, before, total) + taken
        return keep, *times, jumped, (state, total), result


def count_evaluations(
    solver: diffrax.AbstractSolver, controller: diffrax.AbstractStepSizeController
) -> tuple[CountingSolver, CountingController]:
    """Return a counting solver and step size controller for `diffrax.diffeqsolve`.

    With `saveat=SaveAt(..., controller_state=True)` the count is `evaluations(run.controller_state)`.
    """
    return CountingSolver(solver), CountingController(controller)


def evaluations(controller_state: PyTree) -> Int[Array, ""]:
    """Return the number of calls of the vector field by a run's solver; -1 if it is unknown, or the run took no step.

    Calls to choose the first step are not included.
    """
    return controller_state[1]
