"""Linear complementarity problems of dependent contacts: whatever b, a solution is found wherever there is one."""

import jax
import numpy as np
import pytest
from scipy.optimize import linprog

from udkjax.complementarity.linear import solve_complementarity

PLACES = np.array([-0.5, -0.1, 0.4, 0.5])  # of four feet of a body


def has_solution(W, b):
    """Return whether there is an x >= 0 with W x + b >= 0: then the quadratic x W x / 2 + b x has a minimum."""
    return linprog(np.zeros(len(b)), A_ub=-W, b_ub=b, bounds=[(0, None)] * len(b)).status == 0


def require_solved(W, b, x, y):
    size = np.sqrt(np.diag(W))
    largest = np.abs(b / size).max()
    assert (x >= -1e-9 * np.abs(x).max()).all() and (y / size >= -1e-8 * largest).all()
    assert (np.abs(x * y) <= 1e-7 * np.abs(x).max() * np.abs(b).max()).all()


@pytest.mark.parametrize("restitution", [(0.5, 0.5, 0.5, 0.5), (0.5, 0.0, 0.5, 0.0), (0.0, 0.9, 0.1, 0.3)])
def test_feet_with_different_restitution(restitution):
    W, b = 1.0 + np.outer(PLACES, PLACES) / 0.1, -(1.0 + np.array(restitution))
    for found in (
        solve_complementarity(W, b, np.ones(4, bool), np.full(4, 1e-12), np),
        jax.jit(solve_complementarity)(W, b, np.ones(4, bool), np.full(4, 1e-12)),
    ):
        require_solved(W, b, np.asarray(found.x), np.asarray(found.y))


def test_random_problems_with_dependent_rows():
    random, solved = np.random.default_rng(0), 0
    for _ in range(2000):
        n = random.integers(1, 9)
        rank = random.integers(1, n + 1)
        rows = random.standard_normal((n, rank)) * 10.0 ** random.uniform(-2, 2, (n, 1))
        W, b = rows @ rows.T, random.standard_normal(n) * 10.0 ** random.uniform(-3, 3)
        if random.random() < 0.5:
            b = rows @ random.standard_normal(rank)
        found = solve_complementarity(W, b, np.ones(n, bool), np.full(n, 1e-12 * np.abs(b).max()), np)
        size = np.sqrt(np.diag(W))
        if (found.y / size >= -1e-8 * np.abs(b / size).max()).all():
            require_solved(W, b, found.x, found.y)
            solved += 1
        else:
            assert not has_solution(W / size[:, None], b / size)
    assert solved > 1000
