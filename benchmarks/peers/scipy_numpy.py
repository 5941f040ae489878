"""SciPy and NumPy: the Udwadia-Kalaba equations with dense matrices, Baumgarte's stabilization, SciPy's integrators."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import get_lapack_funcs

from benchmarks.peers.peer import GRAVITY, INERTIA, MASS, PINS, PIVOTS, Coordinates, Peer, Problem, Run

BAUMGARTE = 10.0  # 1/s, both gains: less drifts, more is stiffer
RANK = 0.1  # singular values of D below this fraction of the largest are zero: from +60 degrees, 0.001 loses the branch

(dsyevd,) = get_lapack_funcs(("syevd",))  # eigh takes three times as long with checks of its input
ROOT = np.repeat(MASS, 3) ** -0.5
ROOT[2::3] = np.array(INERTIA) ** -0.5
WEIGHT = np.array([0.0, -GRAVITY, 0.0] * 4)
CONSTANT = np.zeros((12, 12))  # rows of the Jacobian: feet 0 to 5, tips 6 to 11
for link in range(3):
    for axis in range(2):
        CONSTANT[2 * link + axis, 3 * link + axis] = CONSTANT[6 + 2 * link + axis, 3 * link + axis] = 1.0
        CONSTANT[6 + 2 * link + axis, 9 + axis] = -1.0
FEET, TIPS, THETA = np.arange(0, 6, 2), np.arange(6, 12, 2), np.arange(2, 9, 3)


def constraint(q, v):
    """Return Psi, its Jacobian and -(Psi_q v)_q v."""
    J, psi, gamma = CONSTANT.copy(), np.empty(12), np.empty(12)
    theta, rate = q[2:9:3], v[2:9:3] ** 2
    c, s = 0.5 * np.cos(theta), 0.5 * np.sin(theta)
    along, across = np.cos(q[11]) * PINS, np.sin(q[11]) * PINS
    J[FEET, THETA], J[FEET + 1, THETA] = s, -c
    J[TIPS, THETA], J[TIPS + 1, THETA] = -s, c
    J[6::2, 11], J[7::2, 11] = across, -along
    x, y = q[0:9:3], q[1:9:3]
    psi[0:6:2], psi[1:6:2] = x - c - PIVOTS, y - s
    psi[6::2], psi[7::2] = x + c - q[9] - along, y + s - q[10] - across
    gamma[0:6:2], gamma[1:6:2] = -c * rate, -s * rate
    gamma[6::2], gamma[7::2] = c * rate - along * v[11] ** 2, s * rate - across * v[11] ** 2
    return psi, J, gamma


def by_eigenvalues(t, y):
    """Return y' with the pseudoinverse of D from the eigenvalues of D D^T: two to three times faster than by an SVD."""
    v = y[12:]
    psi, J, gamma = constraint(y[:12], v)
    D = J * ROOT
    values, vectors, _ = dsyevd(D @ D.T)
    values, vectors = values[kept := values > RANK**2 * values[-1]], vectors[:, kept]
    b = gamma - J @ (WEIGHT + 2 * BAUMGARTE * v) - BAUMGARTE**2 * psi
    return np.concatenate([v, WEIGHT + ROOT * ((vectors @ ((b @ vectors) / values)) @ D)])


def by_pinv(t, y):
    """Return y' with NumPy's pseudoinverse of D."""
    v = y[12:]
    psi, J, gamma = constraint(y[:12], v)
    b = gamma - J @ (WEIGHT + 2 * BAUMGARTE * v) - BAUMGARTE**2 * psi
    return np.concatenate([v, WEIGHT + ROOT * (np.linalg.pinv(J * ROOT, rcond=RANK) @ b)])


def solving(rhs, method: str):
    """Return a peer's setup: `rhs` by a method of `solve_ivp`."""

    def setup(problem: Problem) -> Run:
        y0 = np.concatenate([problem.q0, np.zeros(12)])

        def run(tol: float) -> Coordinates:
            found = solve_ivp(rhs, (0.0, problem.ts[-1]), y0, method=method, rtol=tol, atol=tol, t_eval=problem.ts)
            return found.y[:12].T

        return run

    return setup


TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
PEERS = (
    Peer("SciPy DOP853, eigenvalues", "scipy", "tolerance", TOLERANCES, solving(by_eigenvalues, "DOP853")),
    Peer("SciPy LSODA, eigenvalues", "scipy", "tolerance", TOLERANCES, solving(by_eigenvalues, "LSODA")),
    Peer("SciPy DOP853, pinv", "scipy", "tolerance", TOLERANCES, solving(by_pinv, "DOP853")),
)
