"""Reference motions of the atlas, each found in two ways that share no line of code, and how far these are apart.

One is the package's own, at a tolerance at which rounding dominates. The other is exact where the mechanism is a parallelogram,
and else the Udwadia-Kalaba equation of `reference_equations`, in NumPy, with a truncated SVD, by SciPy's DOP853.
"""

import tomllib
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp

import udkjax as udk
from experiments.parts.atlas_problems import Problem
from experiments.parts.reference_equations import evaluate_all

OUTPUTS = 21  # instants of each run at which it is compared
FINE = 1e-13  # tolerance of the package's reference
RANK = 1e-8  # of the largest singular value; below it, directions are left out


class Reference(NamedTuple):
    """Coordinates (starts, T, bodies, 3) at `ts`, and the distance between the two ways, relative to the problem's lengths."""

    ts: Float[np.ndarray, "T"]
    q: Float[np.ndarray, "starts T bodies 3"]
    apart: Float[np.ndarray, "starts"]
    ways: str


def reference(problem: Problem, starts: int) -> Reference:
    """Return the motions of a problem from its starts."""
    mechanism, states, ts = problem.mechanism, problem.states(starts), np.linspace(0.0, problem.end, OUTPUTS)
    atol = FINE * problem.lengths.min()
    runs = [udk.simulate(mechanism, ts, state, rtol=FINE, atol=atol, max_steps=100_000) for state in states]
    own = np.stack([np.asarray(run.q) for run in runs])
    if problem.exact:
        other, ways = np.stack([problem.exact(mechanism, ts, state) for state in states]), "elliptic functions"
    else:
        other, ways = by_scipy(mechanism, states, ts), "NumPy and SciPy"
    apart = (np.abs(own - other) / problem.lengths).max((1, 2, 3))
    return Reference(ts, other if problem.exact else own, apart, ways)


def by_scipy(
    mechanism: udk.Mechanism, states: list[udk.State], ts: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "starts T bodies 3"]:
    """Integrate a = F/m + M^(-1/2) D^+ (gamma - Psi_q F/m) without a line of the package, from all states at once."""
    plain = udk.Mechanism(mechanism.bodies, mechanism.joints, mechanism.drivers, mechanism.forces, mechanism.gravity)
    table = {"driver": [], "force": [], **tomllib.loads(udk.dumps(plain))}
    shape = (2, len(states), len(table["body"]), 3)

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y.reshape(shape)
        found = evaluate_all(table, t, q, v)
        return np.concatenate([v.ravel(), *(acceleration(terms) for terms in found)])

    def acceleration(terms) -> np.ndarray:
        free, root = terms.force / terms.mass, terms.mass**-0.5
        return free + root * (np.linalg.pinv(terms.psi_q * root, rcond=RANK) @ (terms.gamma - terms.psi_q @ free))

    y0 = np.array([[np.asarray(s.q) for s in states], [np.asarray(s.v) for s in states]]).ravel()
    found = solve_ivp(slope, (ts[0], ts[-1]), y0, "DOP853", ts, rtol=FINE, atol=FINE)
    assert found.success, found.message
    return np.moveaxis(found.y.reshape(*shape, len(ts))[0], -1, 1)
