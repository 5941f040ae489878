"""One right-hand side of the paper's linkage: a user's dense script compared with each method of udkjax."""

import statistics
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks.common import Compiled, alternate, ratio
from benchmarks.scripts import by_cholesky, by_pinv
from udkjax.equations import prepare

EVALUATIONS, ROUNDS = 1000, 31


def candidates(mechanism) -> dict:
    """Return right-hand sides y -> y' in JAX, by name."""

    def ours(equations):
        return lambda y: jnp.concatenate([y[12:], equations.accelerations(0.0, y[:12], y[12:])])

    methods = (udk.Elimination(), udk.Auto(), udk.SVD(), udk.Varga(), udk.Greville(), udk.Householder(), udk.GramSchmidt())
    return {
        "script, jnp.linalg.pinv": by_pinv,
        "script, Cholesky": by_cholesky,
        **{f"udkjax {type(m).__name__}": ours(prepare(mechanism, m)) for m in methods},
    }


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the time of an evaluation, and the speed-up over the script with pinv."""
    evaluations, rounds = (3, 2) if smoke else (EVALUATIONS, ROUNDS)
    mechanism = udk.library.parallelogram()
    y0 = jnp.concatenate([mechanism.q0.ravel(), mechanism.v0.ravel()])
    functions = candidates(mechanism)
    reference = jax.jit(by_pinv)(y0)
    for name, f in functions.items():
        np.testing.assert_allclose(f(y0), reference, rtol=0, atol=1e-2 if "Cholesky" in name else 1e-10, err_msg=name)

    def loop(f):  # each evaluation needs the one before, so that XLA cannot omit any
        return lambda y: jax.lax.fori_loop(0, evaluations, lambda _, y: y + 1e-12 * f(y), y)

    compiled = {name: Compiled(loop(f), y0) for name, f in functions.items()}
    times = alternate(compiled, (y0,), rounds)
    baseline = times["script, jnp.linalg.pinv"]
    figures = []
    print(f"{'one right-hand side':26} {'us':>9} {'quartiles':>17} {'faster':>8} {'compile s':>10}")
    for name, seconds in times.items():
        each = [s / evaluations * 1e6 for s in seconds]
        low, median, high = statistics.quantiles(each, n=4) if len(each) > 1 else each * 3
        row = {"name": name, "us": median, "quartiles": [low, high], "faster": ratio(baseline, seconds)}
        figures.append(row | {"compile_s": compiled[name].compile_seconds})
        print(f"{name:26} {median:9.3f} {low:8.3f}-{high:8.3f} {row['faster']:8.1f} {compiled[name].compile_seconds:10.2f}")
    return figures
