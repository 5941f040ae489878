"""Verner's pair: its order conditions, and the polynomial between its steps."""

import math
from collections import Counter

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.integrate.solvers.verner import DENSE_WEIGHTS, TABLEAU

STAGES = len(TABLEAU.b_sol)
A = np.vstack([np.zeros(STAGES)] + [np.pad(row, (0, STAGES - len(row))) for row in TABLEAU.a_lower])


def trees(order):
    """Return rooted trees; each is the tuple of the subtrees at its root."""
    if order == 1:
        return [()]

    def forests(left):
        if left == 0:
            return [()]
        return [(tree, *rest) for size in range(1, left + 1) for tree in trees(size) for rest in forests(left - size)]

    return sorted({tuple(sorted(forest, key=repr)) for forest in forests(order - 1)}, key=repr)


def size(tree):
    return 1 + sum(map(size, tree))


def density(tree):
    return size(tree) * math.prod(map(density, tree))


def symmetry(tree):
    return math.prod(math.factorial(n) for n in Counter(tree).values()) * math.prod(map(symmetry, tree))


def weight(tree):
    """The stage weights of a tree's order condition: b . weight = 1 / density."""
    return math.prod((A @ weight(branch) for branch in tree), start=np.ones(STAGES))


def residuals(b, order, s=1.0):
    return [(b @ weight(tree) - s**order / density(tree)) / symmetry(tree) for tree in trees(order)]


def test_number_of_trees():
    assert [len(trees(n)) for n in range(1, 8)] == [1, 1, 2, 4, 9, 20, 48]


@pytest.mark.parametrize(("b", "order"), [(TABLEAU.b_sol, 6), (TABLEAU.b_sol - TABLEAU.b_error, 5)])
def test_conditions_of_order(b, order):
    for n in range(1, order + 1):
        np.testing.assert_allclose(residuals(b, n), 0, atol=2e-15)
    assert np.linalg.norm(residuals(b, order + 1)) > 1e-4


def test_nodes():
    np.testing.assert_allclose(TABLEAU.c, [1 / 6, 4 / 15, 2 / 3, 5 / 6, 1, 1 / 15, 1], rtol=1e-15)
    np.testing.assert_allclose(A.sum(axis=1)[1:], TABLEAU.c, rtol=0, atol=1e-14)


def test_dense_output():
    powers = np.arange(1, DENSE_WEIGHTS.shape[1] + 1)
    for s in np.linspace(0.0, 1.0, 11):
        b = DENSE_WEIGHTS @ s**powers
        for n in range(1, 5):
            np.testing.assert_allclose(residuals(b, n, s), 0, atol=3e-15)
        assert np.linalg.norm(residuals(b, 5, s)) < 1e-3  # what is left of order 5 is small
    np.testing.assert_allclose(DENSE_WEIGHTS.sum(axis=1), TABLEAU.b_sol, atol=3e-15)
    np.testing.assert_array_equal(DENSE_WEIGHTS[:, 0], np.eye(STAGES)[0])


@pytest.fixture(scope="module")
def decay():
    """y' = -y^2 over 2 s: errors at many times, and the number of calls of f."""
    calls = []

    def f(t, y, args):
        jax.debug.callback(lambda: calls.append(None))
        return -(y**2)

    ts = jnp.linspace(0.0, 2.0, 42)

    @jax.jit
    def solve(step):
        times = diffrax.SaveAt(ts=ts)
        return diffrax.diffeqsolve(diffrax.ODETerm(f), udk.Verner65(), 0.0, 2.0, step, jnp.array([1.0]), saveat=times)

    def run(step):
        calls.clear()
        found = solve(step)
        jax.effects_barrier()
        return np.abs(found.ys[:, 0] - 1 / (1 + ts)), len(calls)

    return run


def test_order_of_convergence(decay):
    coarse, fine = (decay(step)[0] for step in (0.1, 0.05))
    assert np.log2(coarse[-1] / fine[-1]) == pytest.approx(6, abs=0.4)
    assert np.log2(coarse.max() / fine.max()) > 3.9  # between the steps the error of one step alone is of order 5


def test_calls(decay):
    for steps in (20, 40):
        assert decay(2.0 / steps)[1] == STAGES * steps
