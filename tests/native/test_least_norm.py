"""The least-norm solution is that of NumPy's pseudoinverse with the same threshold."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from udkjax.native import machine
from udkjax.native.least_norm import least_norm


@pytest.fixture(scope="module")
def solve(code):
    run = code(least_norm(machine.lanes()))

    def solved(D, b, tol=1e-9):
        D, b = np.array(D, float), np.array(b, float)
        x, rank = np.full(D.shape[1], np.nan), np.full(1, np.nan)
        run(D.copy(), b, x, *D.shape, 1, float(tol), rank)
        if np.all(np.isfinite(D)):
            assert rank[0] == np.linalg.matrix_rank(D, rtol=tol)
        return x

    return solved


def matrix(m, n, sigma, seed=0):
    """One with these singular values."""
    rng = np.random.default_rng(seed)
    left, right = (np.linalg.qr(rng.standard_normal((k, k)))[0] for k in (m, n))
    return (left[:, : len(sigma)] * sigma) @ right[: len(sigma)]


@pytest.mark.parametrize("m, n", [(1, 1), (1, 6), (3, 3), (5, 9), (12, 12), (9, 5), (7, 1), (20, 30)])
def test_full_rank(solve, m, n):
    sigma = 10.0 ** np.linspace(0, -3, min(m, n))
    D, b = matrix(m, n, sigma), np.random.default_rng(1).standard_normal(m)
    assert_allclose(solve(D, b), np.linalg.pinv(D) @ b, rtol=1e-10, atol=1e-10 / sigma[-1])


@pytest.mark.parametrize("m, n", [(4, 6), (12, 12), (9, 5)])
@pytest.mark.parametrize("rank", [1, 3])
def test_deficient_rank_also_with_right_sides_that_no_x_meets(solve, m, n, rank):
    D, b = matrix(m, n, np.linspace(2, 1, rank)), np.random.default_rng(2).standard_normal(m)
    assert_allclose(solve(D, b), np.linalg.pinv(D, rcond=1e-9) @ b, atol=1e-13)


def test_repeated_rows(solve):
    row = np.array([3.0, -1.0, 2.0])
    assert_allclose(solve([row, row, -2 * row], [1.0, 1.0, -2.0]), row / (row @ row), atol=1e-15)


@pytest.mark.parametrize("tol, kept", [(1e-3, 2), (1e-5, 3), (1e-7, 4)])
def test_singular_values_below_the_threshold_count_as_zero(solve, tol, kept):
    sigma = np.array([1.0, 0.1, 1e-4, 1e-6])
    D, b = matrix(5, 7, sigma), np.random.default_rng(3).standard_normal(5)
    assert np.sum(sigma > tol) == kept
    assert_allclose(solve(D, b, tol), np.linalg.pinv(D, rcond=tol) @ b, rtol=1e-8)


def test_small_singular_values_are_exact_to_many_digits(solve):
    """Of rows of very different lengths, where what is found from D D^T would have none."""
    D = np.diag([1.0, 1e-5, 1e-10]) @ matrix(3, 3, np.array([1.0, 0.9, 0.8]))
    assert_allclose(D @ solve(D, D @ [1.0, 2.0, 3.0], 1e-14), D @ [1.0, 2.0, 3.0], rtol=1e-12)
    assert_allclose(solve(D, D @ [1.0, 2.0, 3.0], 1e-14), [1.0, 2.0, 3.0], rtol=1e-9)


def test_zeros(solve):
    assert_array_equal(solve(np.zeros((3, 4)), np.ones(3)), np.zeros(4))
    D = np.array([[0.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
    assert_allclose(solve(D, [5.0, 1.0, 7.0]), [0.0, 0.5])


def test_what_is_scaled_is_solved_alike(solve):
    D, b = matrix(4, 6, np.array([1.0, 0.5, 0.2])), np.random.default_rng(4).standard_normal(4)
    for scale in (1e-140, 1e140):
        assert_allclose(solve(scale * D, scale * b), solve(D, b), rtol=1e-12)


def test_numbers_that_are_not_finite_come_to_an_end(solve):
    for bad in (np.nan, np.inf):
        D = matrix(4, 6, np.array([1.0, 0.5, 0.2]))
        D[1, 2] = bad
        solve(D, np.ones(4))
    assert np.any(np.isnan(solve(matrix(3, 3, np.ones(3)), [1.0, np.nan, 0.0])))
