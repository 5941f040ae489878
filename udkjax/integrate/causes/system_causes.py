"""The causes of failed runs of user-defined systems: a singular mass matrix, a function that is not finite, or an open state."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, ArrayLike

from udkjax.integrate.solution import Result, Solution
from udkjax.programs.deferred import deferred

MOST_ROWS = 3  # rows of constraints that a cause names, those with the largest violations
SINGULAR = 1e-12  # M is singular if its smallest eigenvalue is at most this, relative to the largest


def cause_in_functions(solution: Solution, system: Any, end: tuple[Any, Any]) -> str:
    """Return the cause of a failed run that the functions of a system show at `end`, the last (t, y); "" if they show none."""
    t, (q, v) = np.asarray(end[0]), np.split(np.asarray(end[1]), 2)
    with jax.ensure_compile_time_eval():
        text = cause_of(_values(system, t, q, v))
        is_open = int(np.asarray(solution.code)) == Result.initial_state_open
        if not text and is_open and system.constraint is not None:
            psi = _psi(system, np.asarray(solution.ts[0]), np.asarray(solution.q[0]))
            text = cause_of_opening(np.ravel(psi))
    return text


@deferred
def _values(system: Any, t: Any, q: Any, v: Any) -> dict[str, Array]:
    """Return the values of all functions of a system at a state, by name."""
    values = {"mass": system.mass(q)}
    values |= {name: function(t, q) for name in ("constraint", "potential") if (function := getattr(system, name)) is not None}
    names = "force", "velocity_constraint"
    return values | {name: function(t, q, v) for name in names if (function := getattr(system, name)) is not None}


@deferred
def _psi(system: Any, t: Any, q: Any) -> Array:
    return system.constraint(t, q)


def cause_of_opening(psi: np.ndarray) -> str:
    """Name the rows of the constraint of a system that an initial state violates most, with the cure; "" if all psi are zero."""
    largest = [k for k in np.argsort(-np.abs(psi))[:MOST_ROWS].tolist() if psi[k]]
    found = ", ".join(f"constraint[{k}] is {psi[k]:.3g}" for k in largest)
    return f"the initial state is open: {found}; give a `State` at which constraints are zero" if found else ""


def cause_of(values: Mapping[str, ArrayLike]) -> str:
    """Return the cause of failure that the values of the functions of a system at a state show; "" if they show none."""
    broken = [name for name, value in values.items() if not np.all(np.isfinite(np.asarray(value)))]
    if broken:
        return f"{' and '.join(broken)} of the system {'is' if len(broken) == 1 else 'are'} not finite"
    M = np.asarray(values["mass"])
    eigenvalues = np.linalg.eigvalsh((M + M.T) / 2)
    if not eigenvalues[0] > SINGULAR * np.abs(eigenvalues).max():
        return (
            f"the mass matrix is not positive definite: its eigenvalues are {eigenvalues[0]:.3g} to {eigenvalues[-1]:.3g}. Add "
            "mass in directions that the constraints fix, such as Psi_q^T Psi_q to M and Psi_q^T gamma to F: the motion stays "
            "the same"
        )
    return ""
