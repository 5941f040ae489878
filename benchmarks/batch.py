"""Ten-second trajectories of the paper's linkage per second and core: udkjax by vmap, C++ in lanes and one by one, a script."""

import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks import native
from benchmarks.common import Compiled, at_equal_error, in_turn, ratio
from benchmarks.peers.peer import STARTS, coordinates
from benchmarks.scripts import solve
from udkjax.study.accuracy import pendulum

TARGETS = (1e-6, 1e-8)  # m and rad: the largest error over coordinates and members
TOLERANCES = tuple(float(tol) for tol in 10 ** -np.arange(4.0, 10.01, 1.0))
END, SPREAD = 10.0, 10.0  # s; degrees to both sides together
MEMBERS, FEW = 1024, 256  # members for ours and C++; for the script, which takes a second for these
MANY = 16384  # members on two cores: the scheduler may start both threads on one core, and separates them only some ms later
OUTPUTS = {"end only": 2, "201 outputs": 201}
OURS, LANES, SCALAR, SCRIPT = "udkjax", "C++, 8 lanes", "C++, one by one", "script"
ROUNDS = 3
REGULARIZATION = 1e-10  # of the script: a larger regularization does not reach such errors
OMEGA = np.sqrt(3.5 * 9.81 / 3.05)  # 1/s: 3.05 theta'' = -3.5 g cos(theta)


def angles(start: float, members: int) -> np.ndarray:
    """Return the angles (rad) from which members are released, around `start` (degrees)."""
    return np.deg2rad(start + SPREAD * np.linspace(-0.5, 0.5, members))


def exact(releases: np.ndarray, ts: np.ndarray) -> np.ndarray:
    """Return the exact coordinates (members, T, 12)."""
    links = np.stack([angle + pendulum(ts, angle + np.pi / 2, 0.0, OMEGA) for angle in releases])
    return np.stack([coordinates(np.repeat(theta[:, None], 3, axis=1), 0 * theta) for theta in links])


def states(releases: np.ndarray) -> jax.Array:
    """Return states (members, 24) at rest."""
    q = coordinates(np.repeat(releases[:, None], 3, axis=1), 0 * releases)
    return jnp.asarray(np.concatenate([q, 0 * q], axis=1))


def ours(mechanism: Any, ts: np.ndarray) -> Callable:
    """Return a function from states (members, 24) and a tolerance to coordinates (members, T, 12)."""

    def one(y0, tol):
        state = udk.State(y0[:12].reshape(4, 3), y0[12:].reshape(4, 3))
        return udk.simulate(mechanism, ts, state, tol, tol, throw=False).q.reshape(len(ts), 12)

    return jax.vmap(one, in_axes=(0, None))


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print trajectories per second of CPU time at errors of 1e-6 and 1e-8, and how many times slower than udkjax each is."""
    rounds, tolerances = (1, TOLERANCES[2:4]) if smoke else (ROUNDS, TOLERANCES)
    members, few, end = (4, 2, 0.1) if smoke else (MEMBERS, FEW, END)
    figures = []
    print(f"{'10 s':16} {'start':>6} {'':12} {'error':>7} {'a second':>9} {'ours is':>8} times as many")
    for start in STARTS[:1] if smoke else STARTS:
        for kind, outputs in list(OUTPUTS.items())[: 1 if smoke else None]:
            ts = np.linspace(0.0, end, outputs)
            compiled_in, measured = _measure(start, ts, members, few, tolerances, rounds)
            figures.append({"name": "compiled", "start": start, "outputs": kind, "compile_seconds": compiled_in})
            for (name, tol), (error, seconds) in measured.items():
                row = {"name": name, "start": start, "outputs": kind, "tol": tol, "error": error}
                figures.append(row | {"per_second": 1 / statistics.median(seconds)})
            errors = {key: error for key, (error, _) in measured.items()}
            times = {key: seconds for key, (_, seconds) in measured.items()}
            for target in TARGETS:
                costs = at_equal_error(times, errors, target)
                for name, seconds in costs.items():
                    row = {"name": name, "start": start, "outputs": kind, "target": target}
                    row |= {"per_second": 1 / statistics.median(seconds), "times_ours": ratio(seconds, costs[OURS])}
                    figures.append(row)
                    print(f"{name:16} {start:6.0f} {kind:12} {target:7.0e} {row['per_second']:9.0f} {row['times_ours']:8.2f}")
    compiled_in = [row["compile_seconds"] for row in figures if row["name"] == "compiled"]
    print(f"compiled in {min(compiled_in):.1f} to {max(compiled_in):.1f} s")
    figures += _cores(smoke)
    return figures


def _measure(start: float, ts: np.ndarray, members: int, few: int, tolerances: Any, rounds: int) -> tuple[float, dict]:
    """Return our time to compile; by candidate and tolerance the largest error and, by rounds, the CPU time of a trajectory."""
    releases, spare = angles(start, members), angles(start, few)
    truth = {len(each): exact(each, ts) for each in (releases, spare)}
    errors, timers, compiled_in = {}, {}, 0.0

    def largest(q: np.ndarray) -> float:
        error = float(np.abs(q[..., :12] - truth[len(q)]).max())
        return error if np.isfinite(error) else float("nan")

    script = jax.vmap(solve(ts, REGULARIZATION), in_axes=(0, None))
    for name, run, y0 in ((OURS, ours(udk.library.parallelogram(), ts), states(releases)), (SCRIPT, script, states(spare))):
        jitted = Compiled(run, y0, jnp.asarray(tolerances[0]))
        if name == OURS:
            compiled_in = jitted.compile_seconds
        for tol in tolerances[: 4 if name == SCRIPT else None]:
            errors[name, tol] = largest(np.asarray(jitted(y0, jnp.asarray(tol))))
            timers[name, tol] = lambda j=jitted, y=y0, tol=tol: j.cpu_seconds(y, jnp.asarray(tol)) / len(y)
    if native.program() is not None:
        for name, lanes in ((LANES, 8), (SCALAR, 1)):
            for tol in tolerances:
                run = partial(
                    native.run, mode="batch", starts=releases, lanes=lanes, tolerance=tol, t1=float(ts[-1]), outputs=len(ts)
                )
                errors[name, tol] = largest(run(states=True, seconds=0.0)["states"])
                timers[name, tol] = lambda run=run: run(seconds=0.05)["seconds"] / members
    times = in_turn(timers, rounds)
    return compiled_in, {key: (errors[key], times[key]) for key in times}


def _cores(smoke: bool) -> list[dict[str, Any]]:
    """Return the speed-up of two cores over one: trajectories per second of wall time, at tolerance 1e-7."""
    available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(available) < 2:
        print("two cores: there is one, or this system does not say")
        return []
    members, end = (32, 0.1) if smoke else (MANY, END)
    run, y0 = ours(udk.library.parallelogram(), np.array([0.0, end])), states(angles(-45.0, members))
    tol = jnp.asarray(1e-7)
    batch = Compiled(run, y0, tol)

    def wall(cores: list[int]) -> float:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), cores)
        start = time.perf_counter()
        batch(y0, tol)
        return time.perf_counter() - start

    times = in_turn({"one": lambda: wall(available[:1]), "two": lambda: wall(available[:2])}, 1 if smoke else 7)
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), available)
    rates = {name: members / statistics.median(seconds) for name, seconds in times.items()}
    figures = rates | {"speedup": ratio(times["one"], times["two"])}
    print(f"two cores: {figures['speedup']:.2f} times as many as one ({rates['two']:.0f} against {rates['one']:.0f} a second)")
    return [{"name": "two cores", **figures}]
