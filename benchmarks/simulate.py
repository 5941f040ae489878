"""Work and precision: 20 s of the paper's linkage, 401 outputs, by several solvers and by a user's script."""

import statistics
from pathlib import Path

import diffrax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks.common import Compiled, alternate, machine, report
from benchmarks.scripts import by_cholesky
from udkjax.study.exact import exact_coordinates

STARTS = (-45.0, 60.0)  # degrees, at rest; from +60 it crosses singular configurations
TOLERANCES = (1e-6, 1e-8, 1e-10)
REGULARIZATIONS = (1e-4, 1e-10)  # what one would take first, and what is the most accurate
SOLVERS = {"Dopri8": diffrax.Dopri8(), "Tsit5": diffrax.Tsit5(), "Dopri5": diffrax.Dopri5()}


def ours(mechanism, ts, solver):
    """q (T, 12) and steps by udk.simulate, from a state and with a tolerance that may change without compiling anew."""

    def run(y0, tol):
        state = udk.State(y0[:12].reshape(4, 3), y0[12:].reshape(4, 3))
        solution = udk.simulate(mechanism, ts, state, tol, tol, solver=solver, throw=False)
        return solution.q.reshape(len(ts), 12), solution.stats["steps"]

    return run


def script(ts, tikhonov):
    """The same by a user's own script: diffrax, Cholesky factors of D D^T + `tikhonov` I, Baumgarte."""

    def run(y0, tol):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: by_cholesky(y, tikhonov=tikhonov)),
            diffrax.Dopri8(),
            t0=ts[0],
            t1=ts[-1],
            dt0=None,
            y0=y0,
            saveat=diffrax.SaveAt(ts=ts),
            stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol),
            max_steps=100_000,
            throw=False,
        )
        assert solution.ys is not None
        return solution.ys[:, :12], solution.stats["num_steps"]

    return run


def main(smoke: bool = False, out: Path | None = None):
    """Print milliseconds, steps and the largest error (m, rad) of each run."""
    end, rounds = (0.1, 1) if smoke else (20.0, 11)
    ts = np.linspace(0.0, end, 3 if smoke else 401)
    solvers = dict(list(SOLVERS.items())[:1]) if smoke else SOLVERS
    mechanism = udk.library.parallelogram()
    initial, exact = {}, {}
    for start in STARTS:
        placed = udk.library.parallelogram(np.deg2rad(start))
        initial[start] = jnp.concatenate([placed.q0.ravel(), placed.v0.ravel()])
        exact[start] = np.reshape(exact_coordinates(placed, ts, placed.q0, placed.v0), (len(ts), 12))

    about = machine()
    y0 = initial[STARTS[0]]
    runs = {f"udkjax {name}": ours(mechanism, ts, solver) for name, solver in solvers.items()}
    runs |= {f"script, {tikhonov:.0e}": script(ts, tikhonov) for tikhonov in REGULARIZATIONS}
    compiled = {name: Compiled(run, y0, jnp.asarray(TOLERANCES[0])) for name, run in runs.items()}
    figures = []
    print(f"{'20 s, 401 outputs':18} {'start':>6} {'tol':>7} {'ms':>9} {'steps':>7} {'us a step':>10} {'error':>9}")
    for start in STARTS:
        for tol in TOLERANCES:
            arguments = (initial[start], jnp.asarray(tol))
            times = alternate(compiled, arguments, rounds)
            for name, run in compiled.items():
                q, steps = run(*arguments)
                error, ms = float(jnp.abs(q - exact[start]).max()), statistics.median(times[name]) * 1e3
                error = error if np.isfinite(error) else float("nan")
                row = {"name": name, "start": start, "tol": tol, "ms": ms, "steps": int(steps), "error": error}
                figures.append(row | {"compile_s": compiled[name].compile_seconds})
                each = ms * 1e3 / max(int(steps), 1)
                print(f"{name:18} {start:6.0f} {tol:7.0e} {ms:9.3f} {int(steps):7d} {each:10.3f} {error:9.1e}")
    print("compiled in: " + ", ".join(f"{name} {run.compile_seconds:.1f} s" for name, run in compiled.items()))
    report(about, figures, out)
    return figures
