"""Count right-hand sides exactly: also those of steps that were rejected.

diffrax counts steps, and where its controller rejects a step it restores the solver's state. The controller's own state it does
not restore. So a step says beside its error estimate what it took, and the controller adds that up.
"""

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Int, PyTree

NOT_COUNTED = -1  # before the first step, which says how many evaluations the start took


class Tally(eqx.Module):
    """An error estimate, the calls of the vector field of the attempt, and those before it; None where they are not known."""

    error: PyTree[Array]
    evaluations: Int[Array, ""] | None
    before: Int[Array, ""] | None


def tally(solver: diffrax.AbstractSolver, error: PyTree, before: PyTree, after: PyTree, made_jump: Bool[ArrayLike, ""]) -> Tally:
    """Count the calls of an attempt, from the solver's states before and after it.

    Known for explicit Runge-Kutta methods, from their tableau, and for every method whose state has a field `evaluations`, the
    calls until then.
    """
    if hasattr(before, "evaluations"):
        return Tally(error, after.evaluations - before.evaluations, before.evaluations)
    if not issubclass(type(solver), diffrax.AbstractERK):  # by its own type: a wrapper may take several steps in one
        return Tally(error, None, None)
    stages = solver.tableau.num_stages  # pyright: ignore[reportAttributeAccessIssue]
    if before is not None:  # the last stage of the step before is the first of this one, unless there is none
        nothing_kept, _ = before
        stages = stages - jnp.where(nothing_kept | made_jump, 0, 1)
    return Tally(error, jnp.asarray(stages), jnp.asarray(0))


class Wrapper(diffrax.AbstractAdaptiveSolver, diffrax.AbstractWrappedSolver):
    """A diffrax solver around another one, which answers everything that diffrax asks, but for the step itself."""

    solver: eqx.AbstractVar[diffrax.AbstractSolver]

    @property
    def root_finder(self):
        """Of an implicit solver: diffrax gives it the tolerances of the step size controller."""
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def scan_kind(self):
        """Of a Runge-Kutta method: some adjoints choose the kind of the loop over its stages."""
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
    """A step size controller that adds up what the attempts of a `CountingSolver` took."""

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
            # diffrax replaces what is not a number in an error, and so makes these of a float type
            taken, before = (jnp.asarray(x).astype(total.dtype) for x in (y_error.evaluations, y_error.before))
            total = jnp.where(total == NOT_COUNTED, before, total) + taken
        return keep, *times, jumped, (state, total), result


def count_evaluations(
    solver: diffrax.AbstractSolver, controller: diffrax.AbstractStepSizeController
) -> tuple[CountingSolver, CountingController]:
    """Make a solver and its step size controller count: give both, as they come back, to `diffrax.diffeqsolve`.

    With `saveat=SaveAt(..., controller_state=True)` the count is `evaluations(run.controller_state)`.
    """
    return CountingSolver(solver), CountingController(controller)


def evaluations(controller_state: PyTree) -> Int[Array, ""]:
    """Return the calls of the vector field by a run's solver, or -1: not known, or no step was taken.

    The choice of a first step takes more.
    """
    return controller_state[1]
