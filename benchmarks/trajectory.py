"""Work and precision: 20 s of the paper's linkage, 401 outputs: udkjax, the equivalent C++ program, a user's script."""

import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks import native
from benchmarks.common import Compiled, at_equal_error, in_turn, machine, ratio, report
from benchmarks.peers.peer import STARTS, problem
from benchmarks.scripts import solve

TARGETS = (1e-6, 1e-8, 1e-10)  # m and rad
TOLERANCES = tuple(float(tol) for tol in 10 ** -np.arange(4.0, 12.01, 0.5))
REGULARIZATIONS = (1e-4, 1e-10)  # of the script: what one would take first, and what is the most accurate
OURS, NATIVE = "udkjax", "C++"
ROUNDS, AT_LEAST = 7, 0.02  # s of CPU time that a timing takes at least

Candidate = tuple[Callable[[float], np.ndarray], Callable[[float], float]]  # coordinates (T, 12) and CPU time, from a tolerance


def compiled(run: Callable, y0: Any, at_least: float) -> tuple[Candidate, float]:
    """A candidate of a function of (y0, tolerance) that returns coordinates, and how long it took to compile (s)."""
    run = Compiled(run, y0, jnp.asarray(TOLERANCES[0]))
    states = lambda tol: np.asarray(run(y0, jnp.asarray(tol)))  # noqa: E731
    return (states, lambda tol: run.cpu_seconds(y0, jnp.asarray(tol), at_least=at_least)), run.compile_seconds


def ours(mechanism: Any, ts: Any) -> Callable:
    """q (T, 12) by `udk.simulate` with its defaults but for the tolerance."""

    def run(y0, tol):
        state = udk.State(y0[:12].reshape(4, 3), y0[12:].reshape(4, 3))
        return udk.simulate(mechanism, ts, state, tol, tol, throw=False).q.reshape(len(ts), 12)

    return run


def cpp(start: float, ts: Any, at_least: float) -> Candidate:
    """The C++ program."""

    def run(tol: float, states: bool, seconds: float) -> dict[str, Any]:
        times = {"t1": float(ts[-1]), "outputs": len(ts)}
        return native.run(states, start=start, tolerance=tol, seconds=seconds, **times)

    return lambda tol: run(tol, True, 0.0)["states"][0, :, :12], lambda tol: run(tol, False, at_least)["seconds"]


def main(smoke: bool = False, out: Path | None = None) -> list[dict[str, Any]]:
    """Print the CPU time that each takes at errors of 1e-6, 1e-8 and 1e-10, and how many times udkjax's that is."""
    rounds, tolerances, at_least = (1, TOLERANCES[2:9:2], 0.0) if smoke else (ROUNDS, TOLERANCES, AT_LEAST)
    about, figures, seconds_to_compile = machine(), [], {}
    if native.program() is not None:
        about["C++"] = native.version()
    print(f"{'20 s, 401 outputs':20} {'start':>6} {'error':>7} {'ms':>9} {'times ours':>11}")
    for start in STARTS[:1] if smoke else STARTS:
        task = problem(start, 0.1 if smoke else 20.0)
        y0 = jnp.concatenate([jnp.asarray(task.q0), jnp.zeros(12)])
        runs = {OURS: ours(udk.library.parallelogram(), task.ts)}
        runs |= {f"script, {tikhonov:.0e}": solve(task.ts, tikhonov) for tikhonov in REGULARIZATIONS[: 1 if smoke else None]}
        candidates: dict[str, Candidate] = {}
        for name, run in runs.items():
            candidates[name], seconds_to_compile[name] = compiled(run, y0, at_least)
        if native.program() is not None:
            candidates[NATIVE] = cpp(start, task.ts, at_least)

        errors = {(name, tol): task.error(states(tol)) for name, (states, _) in candidates.items() for tol in tolerances}
        timers = {
            (name, tol): lambda timer=timer, tol=tol: timer(tol)
            for tol in tolerances
            for name, (_, timer) in candidates.items()
            if np.isfinite(errors[name, tol])  # not of what has come to no end
        }
        times = in_turn(timers, rounds)
        for (name, tol), seconds in times.items():
            row = {"name": name, "start": start, "tol": tol, "error": errors[name, tol], "seconds": statistics.median(seconds)}
            figures.append(row)
        for target in TARGETS:
            costs = at_equal_error(times, errors, target)
            for name, seconds in costs.items():
                times_ours = ratio(seconds, costs[OURS])
                row = {"name": name, "start": start, "target": target, "seconds": statistics.median(seconds)}
                figures.append(row | {"times_ours": times_ours})
                print(f"{name:20} {start:6.0f} {target:7.0e} {row['seconds'] * 1e3:9.3f} {times_ours:11.2f}")
    print("compiled in: " + ", ".join(f"{name} {seconds:.1f} s" for name, seconds in seconds_to_compile.items()))
    report(about, figures, out)
    return figures
