import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.ten_times import multiplied
from udkjax.equations.elimination.dense_pseudoinverse import (
    FactoredPseudoinverse,
    TruncatedPseudoinverse,
    dense_pseudoinverse,
)

TOL = 1e-4


def matrix(m: int, n: int, values: list[float], seed: int = 0) -> np.ndarray:
    """Return a matrix (m, n) with these singular values, and zeros."""
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(k, len(values))))[0] for k in (m, n))
    return u @ np.diag(values) @ v.T


# full rank, redundant rows, more rows than columns, one row, clear and hardly clear
CASES = [
    (8, 9, np.geomspace(1, 0.1, 8)),
    (12, 12, np.geomspace(3, 0.1, 11)),
    (9, 4, np.ones(3)),
    (1, 6, [2.0]),
    (70, 90, np.ones(60)),
]


@pytest.mark.parametrize(("m", "n", "values"), CASES)
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_factored_pseudoinverse_is_that_of_singular_values(m, n, values, scale):
    D = scale * matrix(m, n, list(values))
    plus, expected = FactoredPseudoinverse.of(D, TOL, with_null_space=True), np.linalg.pinv(D, TOL)
    assert plus is not None and plus.rank == len(values)
    rng = np.random.default_rng(1)
    b, many, x = rng.normal(size=m), rng.normal(size=(m, 3)), rng.normal(size=n)
    size = 1e-12 * np.abs(expected).max()
    assert_allclose(plus @ b, expected @ b, rtol=1e-11, atol=size)
    assert_allclose(plus @ many, expected @ many, rtol=1e-11, atol=size)
    assert_allclose(plus.transposed_times(x), expected.T @ x, rtol=1e-11, atol=size)
    N = plus.null_space(n - len(values))
    assert N.shape == (n, n - len(values))
    assert_allclose(N.T @ N, np.eye(n - len(values)), atol=1e-13)
    assert_allclose(D @ N, 0.0, atol=1e-13 * scale * max(values))
    alone = FactoredPseudoinverse.of(D, TOL)
    assert alone is not None
    assert_allclose(alone @ b, plus @ b, rtol=1e-11, atol=size)


@pytest.mark.parametrize("least", [3e-4, 1.1e-4, 0.9e-4, 1e-7, 1e-12])
def test_singular_values_near_the_tolerance_are_left_to_their_decomposition(least):
    """A rank that a bound does not determine, and rows that are nearly dependent, which count as dependent."""
    D = matrix(6, 8, [1.0, 0.9, 0.8, 0.7, 0.6, least])
    if least < TOL:
        assert FactoredPseudoinverse.of(D, TOL) is None
    b = np.arange(6.0)
    plus = FactoredPseudoinverse.of(D, TOL) or TruncatedPseudoinverse.of(D, TOL)
    assert_allclose(plus @ b, np.linalg.pinv(D, TOL) @ b, rtol=1e-9)
    assert plus.rank == 6 - (least < TOL)


def test_without_numbers_to_factor():
    assert FactoredPseudoinverse.of(np.full((30, 40), np.nan), TOL) is None
    assert FactoredPseudoinverse.of(np.zeros((30, 40)), TOL) is None
    assert FactoredPseudoinverse.of(np.zeros((0, 4)), TOL) is None
    assert isinstance(dense_pseudoinverse(np.full((30, 40), np.nan), TOL), TruncatedPseudoinverse)
    assert isinstance(dense_pseudoinverse(matrix(40, 50, [1.0] * 30), TOL), FactoredPseudoinverse)


def test_equilibrium_of_a_long_chain_is_that_by_singular_values():
    chain, found = udk.library.chain(20, angle=0.1), []
    for factor in (10**6, 1):
        with multiplied(factor, "equations.elimination.dense_pseudoinverse.FEW_ROWS"):
            found.append(udk.equilibrium(chain.with_parameters({})))
    slow, fast = found
    assert slow.balanced and fast.balanced
    assert_allclose(fast.q, slow.q, atol=1e-12)
    assert_allclose(fast.omega2, slow.omega2, rtol=1e-9)
    assert_allclose(fast.multipliers, slow.multipliers, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("build", [lambda: udk.library.chain(14), lambda: udk.library.n_four_bar(6)], ids=["chain", "loops"])
def test_reactions_of_large_scenes_are_those_by_singular_values(build):
    mechanism, found = build(), []
    solution = udk.simulate(mechanism, np.linspace(0.0, 0.02, 4))
    for factor in (10**6, 1):
        with multiplied(factor, "equations.elimination.dense_pseudoinverse.FEW_ROWS"):
            found.append(udk.reactions(mechanism, solution))
    slow, fast = map(jax.tree.leaves, found)
    for a, b in zip(slow, fast, strict=True):
        assert_allclose(b, a, rtol=1e-8, atol=1e-9 * np.nanmax(np.abs(a), initial=0.0))
