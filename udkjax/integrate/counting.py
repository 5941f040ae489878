"""Count right-hand sides exactly: also those of steps that were rejected.

diffrax counts steps, and where its controller rejects a step it restores the solver's state. The controller's own state it does
not restore. So a step says beside its error estimate what it took, and the controller adds that up.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp

from udkjax.integrate.wrapper import Wrapper

NOT_KNOWN = -1


class Tally(eqx.Module):
    """An error estimate, the calls of the vector field that it took, and the calls before the attempt.

    What is not known is None.
    """

    error: Any
    evaluations: Any
    before: Any


def tally(solver: Any, error: Any, before: Any, after: Any, made_jump: Any) -> Tally:
    """What an attempt took, from the solver's states before and after it.

    Known for explicit Runge-Kutta methods, from their tableau, and for every method whose state has a field `evaluations`, the
    calls until then.
    """
    if hasattr(before, "evaluations"):
        return Tally(error, after.evaluations - before.evaluations, before.evaluations)
    if not issubclass(type(solver), diffrax.AbstractERK):  # by its own type: a wrapper may take several steps in one
        return Tally(error, None, None)
    stages = solver.tableau.num_stages
    if before is not None:  # the last stage of the step before is the first of this one, unless there is none
        nothing_kept, _ = before
        stages = stages - jnp.where(nothing_kept | made_jump, 0, 1)
    return Tally(error, jnp.asarray(stages), jnp.asarray(0))


class Counted(Wrapper):
    """A solver whose error estimates are `Tally`s."""

    solver: diffrax.AbstractSolver

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, error, dense, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        return y1, tally(self.solver, error, solver_state, state, made_jump), dense, state, result


class Counting(diffrax.AbstractAdaptiveStepSizeController):
    """A step size controller that adds up what the attempts of a `Counted` solver took."""

    controller: Any

    def __init__(self, controller: Any):
        self.controller = controller

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.norm

    def wrap(self, direction):
        return Counting(self.controller.wrap(direction))

    def init(self, *args, **kwargs):
        tnext, state = self.controller.init(*args, **kwargs)
        return tnext, (state, jnp.array(NOT_KNOWN))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error: Any, error_order, controller_state):
        state, total = controller_state
        keep, *times, jumped, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error.error, error_order, state
        )
        if y_error.evaluations is not None:
            # diffrax replaces what is not a number in an error, and so makes these of a float type
            taken, before = (jnp.asarray(x).astype(total.dtype) for x in (y_error.evaluations, y_error.before))
            total = jnp.where(total == NOT_KNOWN, before, total) + taken
        return keep, *times, jumped, (state, total), result


def count_evaluations(solver: Any, controller: Any) -> tuple[Any, Any]:
    """Make a solver and its step size controller count: give both, as they come back, to `diffrax.diffeqsolve`.

    With `saveat=SaveAt(..., controller_state=True)` the count is `evaluations(run.controller_state)`.
    """
    return Counted(solver), Counting(controller)


def evaluations(controller_state: Any) -> Any:
    """Calls of the vector field by a run's solver, or -1: not known, or no step was taken. Choosing a first step takes more."""
    return controller_state[1]
