"""Work and precision: 20 s of the paper's linkage, 401 outputs: udkjax, the equivalent C++ program, a user's script.

The accuracy of a run that crosses singular configurations is partly chance, depending on where steps end near them. So errors are
averaged, in logarithms, over five runs from neighbouring starts.
"""

import statistics
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks import native
from benchmarks.common import Compiled, at_equal_error, in_turn, ratio
from benchmarks.peers.peer import STARTS, Problem, problem
from benchmarks.scripts import solve

TARGETS = (1e-6, 1e-8, 1e-10)  # m and rad
TOLERANCES = tuple(float(tol) for tol in 10 ** -np.arange(4.0, 12.01, 0.5))
REGULARIZATIONS = (1e-4, 1e-10)  # regularizations of the script: the obvious one, and the most accurate one
OURS, NATIVE = "udkjax", "C++"
BESIDE = (0.0, -1.0, -0.5, 0.5, 1.0)  # degrees
ROUNDS, AT_LEAST = 7, 0.005  # s of CPU time that a timing of one start takes at least

# From a tolerance: coordinates (T, 12) from each start, and the CPU time of a run.
Candidate = tuple[Callable[[float], list[np.ndarray]], Callable[[float], float]]


def compiled(run: Callable, y0s: Sequence[Any], at_least: float) -> tuple[Candidate, float]:
    """Return a candidate from a function of (y0, tolerance) that returns coordinates, and the time to compile it (s)."""
    run = Compiled(run, y0s[0], jnp.asarray(TOLERANCES[0]))

    def seconds(tol: float) -> float:
        return statistics.mean(run.cpu_seconds(y0, jnp.asarray(tol), at_least=at_least) for y0 in y0s)

    return (lambda tol: [np.asarray(run(y0, jnp.asarray(tol))) for y0 in y0s], seconds), run.compile_seconds


def ours(mechanism: Any, ts: Any) -> Callable:
    """Return q (T, 12) by `udk.simulate` with its defaults except the tolerance."""

    def run(y0, tol):
        state = udk.State(y0[:12].reshape(4, 3), y0[12:].reshape(4, 3))
        return udk.simulate(mechanism, ts, state, tol, tol, throw=False).q.reshape(len(ts), 12)

    return run


def cpp(starts: Sequence[float], ts: Any, at_least: float) -> Candidate:
    """Return the candidate of the C++ program."""

    def runs(tol: float, states: bool, seconds: float) -> list[dict[str, Any]]:
        times = {"t1": float(ts[-1]), "outputs": len(ts)}
        return [native.run(states, start=start, tolerance=tol, seconds=seconds, **times) for start in starts]

    return (
        lambda tol: [run["states"][0, :, :12] for run in runs(tol, True, 0.0)],
        lambda tol: statistics.mean(run["seconds"] for run in runs(tol, False, at_least)),
    )


def error(tasks: Sequence[Problem], found: Sequence[np.ndarray]) -> float:
    """Return the geometric mean of the errors of runs from neighbouring starts; nan if one failed."""
    errors = [task.error(q) for task, q in zip(tasks, found, strict=True)]
    return float(np.exp(np.mean(np.log(errors))))


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the CPU time of each at errors of 1e-6, 1e-8 and 1e-10, also relative to udkjax."""
    rounds, tolerances, at_least = (1, TOLERANCES[2:9:2], 0.0) if smoke else (ROUNDS, TOLERANCES, AT_LEAST)
    figures, seconds_to_compile = [], {}
    print(f"{'20 s, 401 outputs':20} {'start':>6} {'error':>7} {'ms':>9} {'times ours':>11}")
    for start in STARTS[:1] if smoke else STARTS:
        starts = [start + beside for beside in BESIDE[: 2 if smoke else None]]
        tasks = [problem(each, 0.1 if smoke else 20.0) for each in starts]
        ts, y0s = tasks[0].ts, [jnp.concatenate([jnp.asarray(task.q0), jnp.zeros(12)]) for task in tasks]
        runs = {OURS: ours(udk.library.parallelogram(), ts)}
        runs |= {f"script, {tikhonov:.0e}": solve(ts, tikhonov) for tikhonov in REGULARIZATIONS[: 1 if smoke else None]}
        candidates: dict[str, Candidate] = {}
        for name, run in runs.items():
            candidates[name], seconds_to_compile[name] = compiled(run, y0s, at_least)
        if native.program() is not None:
            candidates[NATIVE] = cpp(starts, ts, at_least)

        errors = {(name, tol): error(tasks, states(tol)) for name, (states, _) in candidates.items() for tol in tolerances}
        timers = {
            (name, tol): lambda timer=timer, tol=tol: timer(tol)
            for tol in tolerances
            for name, (_, timer) in candidates.items()
            if np.isfinite(errors[name, tol])  # except for runs that did not end
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
    return figures
