"""Linear programs of a few variables beside those of SciPy: bounded, unbounded, degenerate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from udkjax.complementarity.linear_program import maximize


@pytest.mark.parametrize(("rows", "n"), [(12, 5), *(pytest.param(*x, marks=pytest.mark.slow) for x in ((4, 2), (24, 9)))])
def test_maxima_are_those_of_scipy(rows, n):
    """Random programs in one batch, a third of them with right-hand sides of zero, where many rows meet in the start."""
    random = np.random.default_rng(rows)
    G, c = random.standard_normal((60, rows, n)), random.standard_normal((60, n))
    h = np.abs(random.standard_normal((60, rows)))
    h[::3, : rows // 2] = 0.0
    found = jax.jit(jax.vmap(lambda c, G, h: maximize(c, G, h, jnp.abs(G))))(c, G, h)
    bounded = 0
    for k in range(60):
        exact = linprog(-c[k], G[k], h[k], bounds=(None, None), method="highs")
        assert bool(found.endless[k]) is (exact.status == 3), k
        if exact.status == 0:
            bounded += 1
            assert bool(found.solved[k]), k
            np.testing.assert_allclose(c[k] @ found.x[k], -exact.fun, rtol=1e-9, atol=1e-9)
            assert np.all(G[k] @ found.x[k] <= h[k] + 1e-9)
            np.testing.assert_allclose(G[k].T @ found.y[k], c[k], atol=1e-9)  # the multipliers
            assert np.all(np.asarray(found.y[k]) >= -1e-9)
            np.testing.assert_allclose(found.y[k] @ h[k], -exact.fun, rtol=1e-8, atol=1e-8)
    assert bounded > 10


def test_terms_that_cancel_do_not_bound():
    """A row whose coefficient is a rounding error of its terms does not block."""
    row, terms = jnp.array([[1.0 - (1.0 - 1e-13)]]), jnp.array([[2.0]])
    assert maximize(jnp.ones(1), row, jnp.ones(1), terms).endless
    assert not maximize(jnp.ones(1), 1e-6 * jnp.ones((1, 1)), jnp.ones(1), terms).endless
