"""The computations of `precision`, by the environment's precision: `python -m experiments.parts.in_precision FILE [--smoke]`."""

import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.pinv_accuracy import METHODS, SIZE, collection, padded
from udkjax.study.accuracy import exact_coordinates

STARTS = (-45.0, 60.0)  # degrees, at rest; from +60 the linkage crosses singular configurations
THRESHOLDS = {"default": (1e-4, 1e-6), "wide": (1e-2, 1e-3)}  # of the rank, and where `Auto` leaves elimination
TOLERANCES = 10.0 ** np.arange(-2, -13, -1)
END, OUTPUTS = 20.0, 41  # s


def runs(tolerances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return errors of q (m, rad), right-hand sides, result codes (thresholds, starts, tolerances) of the paper's linkage."""
    ts = np.linspace(0.0, END, OUTPUTS)
    mechanism = udk.library.parallelogram(np.deg2rad(STARTS[0]))

    @jax.jit
    def run(q0, v0, tols, thresholds):
        def one(tol):
            choices: dict = {
                "method": udk.Auto(thresholds[0], branch_tol=thresholds[1]),
                "max_steps": 20_000,
                "drift_tol": 1e-2,
                "throw": False,
            }
            sol = udk.simulate(mechanism, ts, udk.State(q0, v0), tol, tol, **choices)
            return sol.q, sol.stats["right_hand_sides"], sol.code

        return jax.lax.map(one, tols)

    results = []
    for thresholds in THRESHOLDS.values():
        for start in STARTS:
            placed = udk.library.parallelogram(np.deg2rad(start))
            q, cost, code = run(placed.q0, placed.v0, jnp.asarray(tolerances), jnp.asarray(thresholds))
            exact: Any = exact_coordinates(placed, ts, placed.q0, placed.v0)
            results.append((np.abs(np.asarray(q, float) - exact).max(axis=(1, 2, 3)), np.asarray(cost), np.asarray(code)))
    errors, costs, codes = (np.reshape(x, (len(THRESHOLDS), len(STARTS), -1)) for x in zip(*results))
    return errors, costs, codes


def inverses(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return relative errors and ranks (methods, matrices) of the collection, each method with its own threshold."""
    matrices = collection().values()
    stack = jnp.array([padded(a) for a, *_ in matrices], jnp.result_type(float))
    exact = np.array([padded(plus) for _, plus, *_ in matrices])

    def one(a, make):
        plus = make().plus(a)
        return plus @ jnp.eye(SIZE, dtype=a.dtype), plus.rank

    errors, ranks = [], []
    for name in names:
        found, rank = jax.jit(jax.vmap(lambda a, make=METHODS[name]: one(a, make)))(stack)
        off = np.asarray(found, float) - exact
        errors.append(np.linalg.norm(off, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2)))
        ranks.append(np.asarray(rank))
    return np.array(errors), np.array(ranks)


def main(file: str, smoke: bool) -> None:
    """Write everything to an .npz file."""
    names = ("SVD", "Elimination") if smoke else tuple(METHODS)
    error, rank = inverses(names)
    tolerances = TOLERANCES[1:6:2] if smoke else TOLERANCES
    run, cost, code = runs(tolerances)
    eps = float(jnp.finfo(jnp.result_type(float)).eps)
    np.savez(file, names=names, tol=tolerances, error=error, rank=rank, run=run, cost=cost, code=code, eps=eps)


if __name__ == "__main__":
    main(sys.argv[1], "--smoke" in sys.argv[2:])
