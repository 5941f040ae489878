"""Accuracy of a run, by its constraints, its energy and, where one is known, the exact solution."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.equations import energy, violation
from udkjax.equations.analysis import analyse
from udkjax.integrate import Solution
from udkjax.integrate.events.conditions import frames_of
from udkjax.scene import Mechanism
from udkjax.study.exact import exact_coordinates

N_SAMPLES = 5  # times at which it is asked whether drivers move and potentials change


class Accuracy(NamedTuple):
    """Errors of a run, each the largest over all output times that it reached."""

    violation: float  # of any constraint, m or rad
    energy_change: float  # of the total energy since the start, J
    kinetic_energy: float  # J
    error: float | None  # of any coordinate against the exact solution, m or rad; None where none is known
    work: float | None  # of drivers, dampers, loads and impacts up to the end, J; None where there are none
    length: float  # characteristic, m: what a violation is measured by


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
    good = total[np.isfinite(total)]
    exact = exact_coordinates(mechanism, solution.ts, solution.q[0], solution.v[0])
    error = None if exact is None else float(np.nanmax(np.abs(np.asarray(solution.q) - exact)))
    works = solution.events is not None or not conserves_energy(mechanism, np.asarray(solution.ts))
    return Accuracy(
        violation=float(np.nanmax(largest_violation(violation(mechanism, solution)))),
        energy_change=float(np.nanmax(np.abs(total - total[0]))),
        kinetic_energy=float(np.nanmax(np.asarray(parts.kinetic))),
        error=error,
        work=float(good[-1] - good[0]) if works else None,
        length=float(analyse(mechanism).length),
    )


def conserves_energy(mechanism: Mechanism, ts: Float[ArrayLike, "T"]) -> bool:
    """Return whether nothing but errors changes the total energy: no driver moves, and all forces have potentials at rest."""
    frames = frames_of(mechanism.body_names, mechanism.q0.ravel(), mechanism.v0.ravel())
    ts = np.asarray(ts)  # of which JAX would compile a program to find the least
    times = np.linspace(np.min(ts), np.max(ts), N_SAMPLES)
    for element in mechanism.forces.values():
        seen = [frames[name] for name in mechanism.frames_of(element)]
        if element.loads(times[0], *seen) is not None:
            return False
        if any(jax.grad(lambda t, e=element, s=seen: 1.0 * e.potential(t, *s))(t) for t in times):
            return False
    return not any(jax.grad(lambda t, d=driver: 1.0 * d.motion(t))(t) for driver in mechanism.drivers.values() for t in times)


def largest_violation(violated: Float[ArrayLike, "T m"]) -> Float[np.ndarray, " T"]:
    """Return the largest violation of any constraint at each time (m or rad), from what `udkjax.violation` returns."""
    return np.abs(np.asarray(violated)).max(axis=1, initial=0.0)
