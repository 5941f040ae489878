"""Thresholds, data types, errors, and D^+ as an operator."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.pinv.methods import entries
from udkjax.pinv import SVD, GramSchmidt, Greville, Varga


def test_absolute_and_relative_thresholds():
    a = 10 * jnp.diag(jnp.array([1.0, 1e-3, 1e-6]))
    assert SVD(1e-4).rank(a) == 2
    assert SVD(1e-2).rank(a) == 1
    assert SVD.absolute(1e-4).rank(a) == 2
    assert SVD.absolute(1e-2).rank(a) == 1
    assert SVD.absolute(1e-1).rank(a) == 1
    assert SVD().rank(a) == 3
    assert GramSchmidt.absolute(1e-2, twice=False).rank(a) == 1
    with pytest.raises(ValueError, match="absolute rank threshold has no default"):
        SVD(relative=False)


@pytest.mark.parametrize("entry", entries("SVD", "Greville", "Elimination"), indirect=True)
def test_absolute_threshold_is_in_the_units_of_the_matrix(entry):
    a, scales = np.diag([1.0, 1e-3]), np.array([1.0, 1e-2, 1e-4, 1e-7])
    ranks = jax.jit(jax.vmap(lambda scale: entry.make(1e-6, relative=False).rank(scale * a)))(scales)
    assert ranks.tolist() == [2, 2, 1, 0]


def test_rank_tol_is_a_leaf():
    compilations = 0

    @eqx.filter_jit
    def rank(method, a):
        nonlocal compilations
        compilations += 1
        return method.rank(a)

    a = jnp.diag(jnp.array([1.0, 1e-3, 1e-6]))
    assert [int(rank(Varga(tol), a)) for tol in (1e-8, 1e-4, 1e-2)] == [3, 2, 1]
    assert compilations == 1
    assert jax.grad(lambda tol: SVD(tol)(a).sum())(1e-4) == 0


@pytest.mark.parametrize("entry", entries("SVD", "Greville", "Elimination"), indirect=True)
def test_an_invalid_matrix_gives_nan_not_a_plausible_answer(entry):
    a = np.eye(3)
    a[1, 2] = np.nan
    assert np.isnan(jax.jit(lambda a, b: entry.make(1e-4).solve(a, b).x)(a, np.ones(3))).any()


def test_plus_is_an_operator_factorized_once():
    a = np.random.default_rng(0).normal(size=(3, 5))
    plus = SVD().plus(a)
    expected = np.linalg.pinv(a)
    b, c = np.arange(3.0), np.arange(5.0)
    np.testing.assert_allclose(plus @ jnp.asarray(b), expected @ b, rtol=1e-13)
    np.testing.assert_allclose(plus.T @ jnp.asarray(c), expected.T @ c, rtol=1e-13)
    np.testing.assert_allclose(plus.T.T @ jnp.eye(3), expected, rtol=1e-13)
    assert plus.rank == plus.T.rank == 3


@pytest.mark.slow
def test_integers_and_mixed_precision():
    np.testing.assert_allclose(SVD()([[1, 2], [3, 4], [5, 6]]), np.linalg.pinv([[1, 2], [3, 4], [5, 6]]), rtol=1e-13)
    a = jnp.array([[1.0, 2.0], [0.0, 1.0]], jnp.float32)
    assert SVD()(a).dtype == jnp.float32
    x, vjp = jax.vjp(lambda a, b: Varga(1e-4).solve(a, b).x, a, jnp.ones(2, jnp.float64))
    assert x.dtype == jnp.float64
    assert [ct.dtype for ct in vjp(x)] == [jnp.float32, jnp.float64]


def test_errors_name_what_is_wrong():
    with pytest.raises(ValueError, match=r"Greville takes one matrix .* not shape \(2, 3, 3\)"):
        Greville()(jnp.ones((2, 3, 3)))
    with pytest.raises(ValueError, match=r"not shape \(0, 3\)"):
        SVD()(jnp.ones((0, 3)))
    with pytest.raises(TypeError, match="real matrix"):
        SVD()(jnp.ones((3, 3), complex))
    with pytest.raises(ValueError, match=r"applies to \(3,\) or \(3, k\), not to shape \(2,\)"):
        SVD().solve(jnp.ones((3, 2)), jnp.ones(2))
