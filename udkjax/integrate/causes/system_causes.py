"""The causes of failed runs of user-defined systems: a singular mass matrix, a function that is not finite, or an open state."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from udkjax.equations.systems.function_causes import cause_at
from udkjax.integrate.solution import Result, Solution
from udkjax.programs.deferred import deferred

MOST_ROWS = 3  # rows of constraints that a cause names, those with the largest violations


def cause_in_functions(solution: Solution, system: Any, end: tuple[Any, Any]) -> str:
    """Return the cause of a failed run that the functions of a system show at `end`, the last (t, y); "" if they show none."""
    text = cause_at(system, end[0], *np.split(np.asarray(end[1]), 2))
    with jax.ensure_compile_time_eval():
        is_open = int(np.asarray(solution.code)) == Result.initial_state_open
        if not text and is_open and system.constraint is not None:
            psi = _psi(system, np.asarray(solution.ts[0]), np.asarray(solution.q[0]))
            text = cause_of_opening(np.ravel(psi))
    return text


@deferred
def _psi(system: Any, t: Any, q: Any) -> Array:
    return system.constraint(t, q)


def cause_of_opening(psi: np.ndarray) -> str:
    """Name the rows of the constraint of a system that an initial state violates most, with the cure; "" if all psi are zero."""
    largest = [k for k in np.argsort(-np.abs(psi))[:MOST_ROWS].tolist() if psi[k]]
    found = ", ".join(f"constraint[{k}] is {psi[k]:.3g}" for k in largest)
    return f"the initial state is open: {found}; give a `State` at which constraints are zero" if found else ""
