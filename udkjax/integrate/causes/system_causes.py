"""The causes of failed runs of user-defined systems: a singular mass matrix, a function that is not finite, or an open state."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.integrate.solution import Result, Solution
from udkjax.programs.deferred import deferred

MOST_ROWS = 3  # rows of constraints that a cause names, those with the largest violations


def cause_in_functions(solution: Solution, system: ConstrainedSystem, end: tuple[Any, Any]) -> str:
    """Return the cause of a failed run that the functions of a system show at `end`, the last (t, y); "" if they show none."""
    q, v = np.split(np.asarray(end[1]), 2)
    text, is_open = system.cause_at(end[0], q, v), int(np.asarray(solution.code)) == Result.initial_state_open
    if text or not is_open or system.constraint is None:
        return text
    with jax.ensure_compile_time_eval():
        psi = _psi(system.traced(q.size), np.asarray(solution.ts[0]), np.asarray(solution.q[0]))
        return cause_of_opening(np.concatenate([np.ravel(x) for x in psi]))


@deferred
def _psi(system: Any, t: Any, q: Any) -> list[Any]:
    psi = system.constraint(t, q)
    return [*psi.values()] if isinstance(psi, Mapping) else [psi]


def cause_of_opening(psi: np.ndarray) -> str:
    """Name the rows of the constraint of a system that an initial state violates most, with the cure; "" if all psi are zero."""
    largest = [k for k in np.argsort(-np.abs(psi))[:MOST_ROWS].tolist() if psi[k]]
    found = ", ".join(f"constraint[{k}] is {psi[k]:.3g}" for k in largest)
    return f"the initial state is open: {found}; give a `State` at which constraints are zero" if found else ""
