"""Unique multipliers of the paper's linkage for a thousand states in one call, compared with NumPy scripts for the same.

The scripts have the Jacobian of this one linkage written by hand; here it is differentiated from the joints of any scene.
"""

import statistics
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks.common import Compiled, cpu_seconds, in_turn

STATES, FEW = 1000, 20
ROUNDS = 9
TOL = 1e-6  # thresholds of the rank and of the shares, as in the package


def angles(count: int) -> np.ndarray:
    """Return angles of the links (rad) away from singular configurations."""
    return np.random.default_rng(0).uniform(-3.0, -0.2, count)


def coordinates(theta: np.ndarray) -> np.ndarray:
    """Return coordinates of all bodies (states, 4, 3)."""
    e, zero = np.stack([np.cos(theta), np.sin(theta)], axis=1), np.zeros((len(theta), 1))
    links = [np.concatenate([[x, 0.0] + e / 2, theta[:, None]], axis=1) for x in (0.0, 1.0, 2.0)]
    return np.stack([*links, np.concatenate([[1.0, 0.0] + e, zero], axis=1)], axis=1)


def hand_written(q: np.ndarray) -> np.ndarray:
    """Return Psi_q (states, 12, 12) of the linkage."""
    matrix = np.zeros((len(q), 12, 12))
    across = np.stack([-np.sin(q[:, :, 2]), np.cos(q[:, :, 2])], axis=2) / 2
    for k, spot in enumerate((-1.0, 0.0, 1.0)):
        ground, coupler = slice(2 * k, 2 * k + 2), slice(6 + 2 * k, 8 + 2 * k)
        matrix[:, ground, 3 * k : 3 * k + 2] = matrix[:, coupler, 3 * k : 3 * k + 2] = np.eye(2)
        matrix[:, ground, 3 * k + 2], matrix[:, coupler, 3 * k + 2] = -across[:, k], across[:, k]
        matrix[:, coupler, 9:11] = -np.eye(2)
        matrix[:, 6 + 2 * k, 11], matrix[:, 7 + 2 * k, 11] = spot * np.sin(q[:, 3, 2]), -spot * np.cos(q[:, 3, 2])
    return matrix


def share(u: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return the norm of each row of a basis of the left null space."""
    return np.sqrt(np.sum(np.where((sigma <= TOL * sigma[..., :1])[..., None, :], u, 0.0) ** 2, axis=-1))


def state_by_state(q: np.ndarray) -> np.ndarray:
    """Compute one state after another, as a script would."""
    return np.array([share(*np.linalg.svd(hand_written(one[None])[0])[:2]) for one in q])


def all_at_once(q: np.ndarray) -> np.ndarray:
    """Compute all states by NumPy's stacked matrices."""
    return share(*np.linalg.svd(hand_written(q))[:2])


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the time of a state by each way; all must agree to 1e-10."""
    mechanism, count = udk.library.parallelogram(), FEW if smoke else STATES
    q = coordinates(angles(count))
    here = Compiled(jax.vmap(lambda q: udk.uniqueness(mechanism, 0.0, q).share), jnp.asarray(q))
    expected = state_by_state(q)
    for found in (here.result, all_at_once(q)):
        np.testing.assert_allclose(found, expected, atol=1e-10)
    candidates = {"NumPy, state by state": state_by_state, "NumPy, stacked": all_at_once, "udkjax, vmap": here}
    calls = {name: partial(run, jnp.asarray(q) if run is here else q) for name, run in candidates.items()}
    times = in_turn({name: partial(cpu_seconds, call, 0.0) for name, call in calls.items()}, 1 if smoke else ROUNDS)
    figures = [{"name": name, "states": count, "us": statistics.median(times[name]) / count * 1e6} for name in candidates]
    print(f"{'uniqueness of 12 multipliers':30} {'us a state':>10}   of {count} states; compiled in {here.compile_seconds:.2f} s")
    for row in figures:
        print(f"{row['name']:30} {row['us']:10.2f}")
    return figures
