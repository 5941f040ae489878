"""VODE, by SciPy: the nearest relative of the paper's integrator that runs today, to tell an integrator's part from a method's.

IMSL's DIVPAG and VODE (Brown, Byrne, Hindmarsh, SIAM J. Sci. Stat. Comput. 10 (1989) 1038) both descend from Gear's and
Hindmarsh's programs: Adams-Moulton of variable order and step in Nordsieck form. VODE calls the right-hand side from Python, so
its times are meaningless and left out.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import ode

from udkjax.equations import Baumgarte
from udkjax.integrate import Result
from udkjax.integrate.native_equations import ConcreteRates
from udkjax.scene import Mechanism

NAME = "VODE"
ACCEPTED = 10  # in VODE's counters: steps taken
GIVE_UP = 20  # number of allowed steps per run, relative to the number between two instants
CAUSES = {-1: Result.step_limit, -4: Result.step_too_small, -5: Result.step_too_small}  # work, error tests, corrector


class Run(NamedTuple):
    """The part of the interface of a `simulate` solution that the study uses."""

    ts: np.ndarray
    q: np.ndarray
    v: np.ndarray
    time: float
    code: int
    stats: dict[str, int]


def run(
    mech: Mechanism, method: Callable, first_step: float, max_steps: int, ts, state, tol, rank_tol, number, alpha, beta
) -> Run:
    """Integrate with the right-hand side by machine code; `method` is a function of `rank_tol` and of the method's `number`."""
    rates, calls = ConcreteRates(mech, method(rank_tol, number), Baumgarte(alpha, beta)), 0

    def right_hand_side(t: float, y: np.ndarray) -> np.ndarray:
        nonlocal calls
        calls += 1
        return rates(t, y)

    limits = {"first_step": first_step, "nsteps": max(max_steps // GIVE_UP, 1)}
    solver = ode(right_hand_side).set_integrator("vode", method="adams", rtol=float(tol), atol=float(tol), **limits)
    solver.set_initial_value(np.concatenate([np.ravel(state.q), np.ravel(state.v)]), float(ts[0]))
    return _along(solver, np.asarray(ts), lambda: calls)


def _along(solver: Any, ts: np.ndarray, calls: Callable[[], int]) -> Run:
    """Return the run at the instants `ts`, up to the first that it does not reach."""
    ys = np.full((len(ts), len(solver.y)), np.nan)
    ys[0], reached, steps = solver.y, 0, 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # SciPy's word for a run that is given up
        for k, t in enumerate(ts[1:], 1):
            y = solver.integrate(t)
            steps = int(solver._integrator.iwork[ACCEPTED])
            if not (solver.successful() and np.isfinite(y).all()):
                break
            ys[k], reached = y, k
    finished = reached == len(ts) - 1
    cause = Result.successful if finished else CAUSES.get(solver.get_return_code(), Result.not_finite)
    q, v = (part.reshape(len(ts), -1, 3) for part in np.split(ys, 2, axis=1))
    end = float(ts[reached] if finished else np.clip(solver.t, ts[reached], ts[reached + 1]))
    unknown = {"steps": -1, "rejected": -1, "projections": 0}
    return Run(ts, q, v, end, int(cause), {"accepted": steps, "right_hand_sides": calls(), **unknown})
