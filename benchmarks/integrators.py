"""Work and precision: calls of the right-hand side and errors of our integrators and SciPy's, on six problems."""

from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.integrate import ode, solve_ivp

import udkjax as udk
from benchmarks.common import Compiled, Work
from benchmarks.problems import PROBLEMS, STIFF, Problem
from udkjax.integrate.solvers.counting import count_evaluations, evaluations

Run = Callable[[float], tuple[float, ...]]  # from a tolerance to an error and numbers of calls
FIRST = 1e-6  # first step
FINER = 10 ** -np.arange(3.0, 12.01, 0.5)  # tolerances of the yardstick: its calls at any error lie between two of them
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
FOR_NOT_STIFF = {
    "Adams": udk.Adams(),
    "Adams, iterated": udk.Adams(corrector="iteration"),
    "Verner65": udk.Verner65(),
    "Dopri8": diffrax.Dopri8(),
    "BDF": udk.BDF(),
}
FOR_STIFF = {"BDF": udk.BDF()}


def ours(problem: Problem, solver: diffrax.AbstractSolver) -> Compiled:
    """Return a function from a tolerance to the end state, the calls of the right-hand side, Jacobians and accepted steps."""

    def run(tol):
        control: Any = diffrax.PIDController(rtol=tol, atol=tol * jnp.array(problem.scale), norm=optx.rms_norm)
        counted, control = count_evaluations(solver, control)
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: problem.f(t, y)),
            counted,
            t0=0.0,
            t1=problem.end,
            dt0=FIRST,
            y0=jnp.array(problem.y0),
            stepsize_controller=control,
            saveat=diffrax.SaveAt(t1=True, solver_state=True, controller_state=True),
            max_steps=1_000_000,
            throw=False,
        )
        assert found.ys is not None
        jacobians = getattr(found.solver_state, "jacobians", 0)
        return found.ys[0], evaluations(found.controller_state), jacobians, found.stats["num_accepted_steps"]

    return Compiled(run, jnp.asarray(TOLERANCES[0]))


def measured(problem: Problem, run: Compiled, tol: float) -> tuple[float, int, int, int]:
    """Return the error, calls of the right-hand side, Jacobians and accepted steps."""
    y, calls, jacobians, steps = jax.device_get(run(jnp.asarray(tol)))
    return problem.error(y), int(calls), int(jacobians), int(steps)


def vode(problem: Problem, tol: float) -> tuple[float, int]:
    """Return the error, and the calls of the right-hand side, by VODE's Adams methods (Brown, Byrne, Hindmarsh 1989)."""
    f, calls = _counted(problem)
    solver = ode(f).set_integrator("vode", method="adams", rtol=tol, atol=_atol(problem, tol), nsteps=10**6)
    return problem.error(solver.set_initial_value(np.array(problem.y0)).integrate(problem.end)), len(calls)


def scipy(problem: Problem, method: Any, tol: float) -> tuple[float, int]:
    """Do the same by a method of `solve_ivp`; calls for Jacobians by differences count."""
    f, calls = _counted(problem)
    options: Any = {"rtol": tol, "atol": _atol(problem, tol), "first_step": FIRST}
    found = solve_ivp(f, (0.0, problem.end), problem.y0, method=method, **options)
    return problem.error(found.y[:, -1]), len(calls)


def _atol(problem: Problem, tol: float) -> np.ndarray:
    return tol * np.broadcast_to(problem.scale, len(problem.y0))


def _counted(problem: Problem) -> Any:
    calls = []

    def f(t, y):
        calls.append(t)
        return problem.f(t, y, np)

    return f, calls


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the errors and the calls of the right-hand side, and their ratio to those of a known code at equal error.

    The known code is VODE's Adams methods or, for stiff problems, LSODA's backward differentiation formulas (those of VODE, as
    SciPy translated it for its version 1.17, take up to a hundred times the steps that the Fortran code took).
    """
    figures = []
    tolerances = TOLERANCES[2:3] if smoke else TOLERANCES
    print(f"{'problem':12} {'solver':16} {'tol':>7} {'error':>9} {'calls':>7} {'Jacobians':>9} {'steps':>7} {'ratio':>6}")
    for name, problem in PROBLEMS.items():
        if smoke and name not in ("pendulum", "Robertson"):
            continue
        if name in STIFF:
            yardstick, solvers = partial(scipy, problem, "LSODA"), FOR_STIFF
            runs: dict[str, Callable[[float], tuple[float, ...]]] = {
                "LSODA": yardstick,
                "Radau": partial(scipy, problem, "Radau"),
            }
        else:
            yardstick, solvers = partial(vode, problem), FOR_NOT_STIFF
            runs = {"VODE": yardstick, "DOP853": partial(scipy, problem, "DOP853")}
        known = Work([yardstick(tol) for tol in FINER])
        for solver in list(solvers)[: 1 if smoke else None]:
            runs[solver] = partial(measured, problem, ours(problem, solvers[solver]))
        for solver, run in runs.items():
            for tol in tolerances:
                error, calls, jacobians, steps = (*run(tol), 0, 0)[:4]
                ratio = calls / known.at(error)
                row = {"problem": name, "solver": solver, "tol": tol, "error": error, "calls": calls}
                figures.append(row | {"jacobians": jacobians, "steps": steps, "ratio": ratio})
                counts = f"{calls:7d} {jacobians:9d} {steps:7d} {ratio:6.2f}"
                print(f"{name:12} {solver:16} {tol:7.0e} {error:9.1e} {counts}")
    return figures
