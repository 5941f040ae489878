"""Why a user-defined system cannot be closed or integrated: its mass matrix is singular, or a function is not finite."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, ArrayLike

from udkjax.equations.systems.traced_system import FUNCTION_ARGUMENTS, joined_rows
from udkjax.programs.deferred import deferred

SINGULAR_TOL = 1e-12  # M is singular if its smallest eigenvalue is at most this, relative to the largest


def cause_at(system: Any, t: Any, q: Any, v: Any) -> str:
    """Return the cause of failure that the functions of a system show at a state; "" if they show none."""
    with jax.ensure_compile_time_eval():
        return cause_of(_values(system, np.asarray(t, float), np.asarray(q, float), np.asarray(v, float)))


@deferred
def _values(system: Any, t: Any, q: Any, v: Any) -> dict[str, Array]:
    """Return the values of all functions of a system at a state, by name."""
    given = {"t": t, "q": q, "v": v}
    functions = {name: function for name in FUNCTION_ARGUMENTS if (function := getattr(system, name)) is not None}
    return {name: joined_rows(function(*(given[x] for x in FUNCTION_ARGUMENTS[name]))) for name, function in functions.items()}


def cause_of(values: Mapping[str, ArrayLike]) -> str:
    """Return the cause of failure that the values of the functions of a system at a state show; "" if they show none."""
    broken = [name for name, value in values.items() if not np.all(np.isfinite(np.asarray(value)))]
    if broken:
        return f"{' and '.join(broken)} of the system {'is' if len(broken) == 1 else 'are'} not finite"
    M = np.asarray(values["mass"])
    eigenvalues = np.linalg.eigvalsh((M + M.T) / 2)
    small = SINGULAR_TOL * np.abs(eigenvalues).max()
    if eigenvalues[0] > small:
        return ""
    cure = "No motion may have a negative kinetic energy v^T M v / 2: check the signs in `mass`"
    if eigenvalues[0] >= -small:
        cure = (
            "Add mass in directions that the constraints fix, such as Psi_q^T Psi_q to M and Psi_q^T gamma to F: the motion "
            "stays the same"
        )
    return f"the mass matrix is not positive definite: its eigenvalues are {eigenvalues[0]:.3g} to {eigenvalues[-1]:.3g}. {cure}"
