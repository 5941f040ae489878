"""How far a run can be trusted: what its constraints, its energy and, where one is known, the exact solution say."""

from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.equations import energy, violation
from udkjax.integrate import Solution
from udkjax.scene import Mechanism
from udkjax.study.exact import exact_coordinates


class Accuracy(NamedTuple):
    """What `accuracy` finds, each the largest over all output times that a run reached."""

    violation: float  # of any constraint, m or rad
    energy_change: float  # of the total energy since the start, J: loads that do work change it, too
    kinetic_energy: float  # J
    error: float | None  # of any coordinate against the exact solution, m or rad; None where none is known


def accuracy(mechanism: Mechanism, solution: Solution) -> Accuracy:
    """Return how far a run, or part of one that failed, can be trusted.

    Args:
        mechanism: what was simulated.
        solution: one run, no batch.

    Returns:
        The largest violation, energies and error: see `Accuracy`.
    """
    parts = energy(mechanism, solution)
    total = np.asarray(parts.total)
    exact = exact_coordinates(mechanism, solution.ts, solution.q[0], solution.v[0])
    error = None if exact is None else float(np.nanmax(np.abs(np.asarray(solution.q) - exact)))
    return Accuracy(
        violation=float(np.nanmax(largest_violation(violation(mechanism, solution)))),
        energy_change=float(np.nanmax(np.abs(total - total[0]))),
        kinetic_energy=float(np.nanmax(np.asarray(parts.kinetic))),
        error=error,
    )


def largest_violation(violated: Float[ArrayLike, "T m"]) -> Float[np.ndarray, " T"]:
    """Return the largest violation of any constraint at each time (m or rad), from what `udkjax.violation` returns."""
    return np.abs(np.asarray(violated)).max(axis=1, initial=0.0)
