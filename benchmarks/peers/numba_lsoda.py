"""Numba: the same equations compiled, in SciPy's LSODA (numbalsoda has no wheels for these Pythons)."""

import numpy as np
from scipy.integrate import odeint

from benchmarks.peers.peer import GRAVITY, PINS, PIVOTS, Coordinates, Peer, Problem, Run
from benchmarks.peers.scipy_numpy import BAUMGARTE, CONSTANT, RANK, ROOT, TOLERANCES

PIVOT = 0.03  # pivot of D D^T relative to the first: below it, a configuration counts as nearly singular
ZERO = 1e-9  # likewise: remainder of dependent rows by rounding


def right_hand_side():
    """Return y' (24,), compiled: pivoted Cholesky factors of D D^T if its rank is clear, else eigenvalues."""
    from numba import njit  # pyright: ignore[reportMissingImports]

    @njit
    def matrices(y):
        D, b = CONSTANT * ROOT, np.empty(12)
        along, across = np.cos(y[11]), np.sin(y[11])
        for i in range(3):
            j, foot, tip = 3 * i, 2 * i, 6 + 2 * i
            c, s = 0.5 * np.cos(y[j + 2]), 0.5 * np.sin(y[j + 2])
            p, r = PINS[i] * along, PINS[i] * across
            rate, turn = y[14 + j], y[23]
            D[foot, j + 2], D[foot + 1, j + 2] = s * ROOT[j + 2], -c * ROOT[j + 2]
            D[tip, j + 2], D[tip + 1, j + 2] = -s * ROOT[j + 2], c * ROOT[j + 2]
            D[tip, 11], D[tip + 1, 11] = r * ROOT[11], -p * ROOT[11]
            b[foot] = position(y[j] - c - PIVOTS[i], y[12 + j] + s * rate) - c * rate**2
            b[foot + 1] = position(y[j + 1] - s, y[13 + j] - c * rate) - s * rate**2 + GRAVITY
            b[tip] = position(y[j] + c - y[9] - p, y[12 + j] - s * rate - y[21] + r * turn)
            b[tip] += c * rate**2 - p * turn**2
            b[tip + 1] = position(y[j + 1] + s - y[10] - r, y[13 + j] + c * rate - y[22] - p * turn)
            b[tip + 1] += s * rate**2 - r * turn**2
        return D, b

    @njit
    def position(psi, rate):
        return -(BAUMGARTE**2) * psi - 2 * BAUMGARTE * rate

    @njit
    def multipliers(G, b):
        """Return multipliers of least norm near singular configurations, else of rows chosen by pivots: forces are equal."""
        n = len(b)
        A, order, x = G.copy(), np.arange(n), np.zeros(n)
        rank, first = n, 0.0
        for k in range(n):
            best = k
            for i in range(k + 1, n):
                if A[i, i] > A[best, best]:
                    best = i
            first = max(first, A[best, best])
            if A[best, best] < ZERO * first:
                rank = k
                break
            if A[best, best] < PIVOT * first:
                return by_eigenvalues(G, b)
            if best != k:
                order[k], order[best] = order[best], order[k]
                for i in range(n):
                    A[k, i], A[best, i] = A[best, i], A[k, i]
                for i in range(n):
                    A[i, k], A[i, best] = A[i, best], A[i, k]
            A[k, k] = np.sqrt(A[k, k])
            for i in range(k + 1, n):
                A[i, k] /= A[k, k]
            for i in range(k + 1, n):
                for j in range(k + 1, i + 1):
                    A[i, j] -= A[i, k] * A[j, k]
                    A[j, i] = A[i, j]
        for k in range(rank):
            total = b[order[k]]
            for j in range(k):
                total -= A[k, j] * x[order[j]]
            x[order[k]] = total / A[k, k]
        for k in range(rank - 1, -1, -1):
            total = x[order[k]]
            for j in range(k + 1, rank):
                total -= A[j, k] * x[order[j]]
            x[order[k]] = total / A[k, k]
        return x

    @njit
    def by_eigenvalues(G, b):
        values, vectors = np.linalg.eigh(G)
        x = np.zeros(len(b))
        for k in range(len(b)):
            if values[k] > RANK**2 * values[-1]:
                x += (vectors[:, k] @ b) / values[k] * vectors[:, k]
        return x

    @njit
    def rhs(t, y):
        D, b = matrices(y)
        x = multipliers(D @ D.T, b)
        out = np.empty(24)
        for j in range(12):
            out[j] = y[12 + j]
            total = 0.0
            for i in range(12):
                total += D[i, j] * x[i]
            out[12 + j] = ROOT[j] * total - (GRAVITY if j % 3 == 1 else 0.0)
        return out

    return rhs


def by_odeint(problem: Problem) -> Run:
    """Integrate by LSODA through `odeint`, whose loop is compiled: it only calls back for y'."""
    rhs = right_hand_side()
    y0 = np.concatenate([problem.q0, np.zeros(12)])

    def run(tol: float) -> Coordinates:
        return odeint(rhs, y0, problem.ts, rtol=tol, atol=tol, tfirst=True, mxstep=100_000)[:, :12]

    return run


PEERS = (Peer("numba LSODA", "numba", "tolerance", TOLERANCES, by_odeint),)
