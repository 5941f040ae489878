"""Reference motions of the atlas, each found in two ways that share no line of code, and how far these are apart.

One is the package's own, at a tolerance at which rounding dominates. The other is exact where the mechanism is a parallelogram,
and else the Udwadia-Kalaba equation in NumPy, with a truncated SVD, by SciPy's DOP853: of a mechanism with the terms of
`reference_equations`, of a closed chain in space with those of its quadratic rows.
"""

import tomllib
from typing import NamedTuple

import jax
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
    """Coordinates (starts, T, bodies, 3), of a system (starts, T, n), at `ts`.

    `apart`: the distance between the two ways, relative to the problem's lengths.
    """

    ts: Float[np.ndarray, "T"]
    q: Float[np.ndarray, "starts T ..."]
    apart: Float[np.ndarray, "starts"]
    ways: str


def reference(problem: Problem, starts: int) -> Reference:
    """Return the motions of a problem from its starts."""
    mechanism, states, ts = problem.mechanism, problem.states(starts), np.linspace(0.0, problem.end, OUTPUTS)
    atol = FINE * problem.lengths.min()
    runs = [udk.simulate(mechanism, ts, state, rtol=FINE, atol=atol, max_steps=100_000) for state in states]
    own = np.stack([np.asarray(run.q) for run in runs])
    if problem.exact and isinstance(mechanism, udk.Mechanism):
        other, ways = np.stack([problem.exact(mechanism, ts, state) for state in states]), "elliptic functions"
    elif isinstance(mechanism, udk.Mechanism):
        other, ways = by_scipy(mechanism, states, ts), "NumPy and SciPy"
    else:
        other, ways = np.stack([chain_by_scipy(mechanism, state, ts) for state in states]), "NumPy and SciPy"
    apart = (np.abs(own - other) / problem.lengths).reshape(len(own), -1).max(1)
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
        mass, psi_q = found[0].mass, np.stack([terms.psi_q for terms in found])
        root, free = mass**-0.5, np.stack([terms.force for terms in found]) / mass
        missing = np.stack([terms.gamma for terms in found])[..., None] - psi_q @ free[..., None]
        push = np.linalg.pinv(psi_q * root, rcond=RANK) @ missing
        return np.concatenate([v.ravel(), (free + root * push[..., 0]).ravel()])

    y0 = np.array([[np.asarray(s.q) for s in states], [np.asarray(s.v) for s in states]]).ravel()
    found = solve_ivp(slope, (ts[0], ts[-1]), y0, "DOP853", ts, rtol=FINE, atol=FINE)
    assert found.success, found.message
    return np.moveaxis(found.y.reshape(*shape, len(ts))[0], -1, 1)


def chain_by_scipy(system: udk.ConstrainedSystem, state: udk.State, ts: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T n"]:
    """Integrate a system with constant M, constant F and quadratic rows Psi(q) = q^T A q / 2 + B q + c, by NumPy and SciPy.

    A, B and c are found from values of the functions alone, exactly but for rounding: no derivative by JAX, and no line of the
    package's equations, takes part.
    """
    rows, potential = system.constraint, system.potential
    assert rows is not None and potential is not None
    n, unit = len(state.q), np.eye(len(state.q))
    psi = np.asarray(jax.vmap(lambda q: rows(0.0, q))(np.concatenate([np.zeros((1, n)), unit, -unit])))
    pairs = np.asarray(jax.vmap(lambda q: rows(0.0, q))((unit[:, None] + unit).reshape(n * n, n)))
    c, plus, minus = psi[0], psi[1 : n + 1], psi[n + 1 :]
    B = (plus - minus).T / 2
    A = np.moveaxis(pairs.reshape(n, n, -1) - plus[:, None] - plus[None] + c, -1, 0)  # bilinear: Psi(x + y) - Psi(x) - Psi(y) + c
    mass = np.diag(np.asarray(system.mass(state.q)))
    heights = np.asarray(jax.vmap(lambda q: potential(0.0, q))(np.concatenate([np.zeros((1, n)), unit])))
    free = (heights[0] - heights[1:]) / mass
    root = mass**-0.5

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y.reshape(2, n)
        jacobian, gamma = A @ q + B, -(A @ v) @ v
        push = np.linalg.pinv(jacobian * root, rcond=RANK) @ (gamma - jacobian @ free)
        return np.concatenate([v, free + root * push])

    y0 = np.concatenate([np.asarray(state.q), np.asarray(state.v)])
    found = solve_ivp(slope, (ts[0], ts[-1]), y0, "DOP853", ts, rtol=FINE, atol=FINE)
    assert found.success, found.message
    return found.y[:n].T
