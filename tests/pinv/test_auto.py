"""`Auto` for matrices in which some rows are known to depend on others."""

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.pinv import AutoOfRows

WIDE = np.random.default_rng(3).normal(size=(4, 6))
DEPENDENT = np.vstack([WIDE, 2.0 * WIDE[0] - WIDE[3]])  # the last row depends on the others
METHOD = AutoOfRows(dispensable=(4,))


def nearly_dependent(share):
    """The matrix with its second row turned towards the first; at 1 they are parallel."""
    D = np.array(DEPENDENT)
    D[1] += share * (D[0] - D[1])
    return D


def test_auto_of_rows_leaves_out_known_rows():
    b = DEPENDENT @ np.arange(6.0)  # consistent: every solution method has the same answer
    found = METHOD.solve(DEPENDENT, b)
    np.testing.assert_allclose(found.x, np.linalg.pinv(DEPENDENT) @ b, rtol=1e-13)
    assert int(found.rank) == 4 and np.all(np.asarray(METHOD(DEPENDENT))[:, 4] == 0.0)


def test_auto_of_rows_takes_singular_values_near_dependence():
    """Some members of a batch need singular values of all rows. Each member equals its result alone."""
    Ds = np.stack([nearly_dependent(share) for share in (0.0, 0.5, 1.0)])
    inverses, ranks = jax.jit(jax.vmap(lambda D: (METHOD(D), METHOD.rank(D))))(Ds)
    assert list(map(int, ranks)) == [4, 4, 3]
    for D, inverse in zip(Ds, inverses, strict=True):
        np.testing.assert_allclose(inverse, METHOD(D), atol=1e-13)
    np.testing.assert_allclose(inverses[2], np.linalg.pinv(Ds[2], rcond=1e-9), atol=1e-12)


def test_singular_values_of_a_batch_are_computed_only_when_needed():
    """XLA moves invariant code out of a loop; singular values would then be computed for every matrix."""
    text = str(jax.jit(jax.vmap(METHOD)).lower(DEPENDENT[None]).compile().as_text())
    entry = text[text.index("\nENTRY") :]
    assert "gesdd" in text and "gesdd" not in entry[: entry.index("\n}")]


def test_derivatives_of_auto_of_rows():
    def f(x):
        D = jnp.asarray(DEPENDENT).at[:4].add(jnp.sin(x * jnp.arange(24.0).reshape(4, 6)))
        D = D.at[4].set(2.0 * D[0] - D[3])
        return jnp.sum(METHOD.solve(D, D @ jnp.arange(6.0)).x ** 2)

    first = (f(0.3 + 1e-6) - f(0.3 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(f)(0.3), first, rtol=1e-7)
    second = (jax.grad(f)(0.3 + 1e-6) - jax.grad(f)(0.3 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.hessian(f)(0.3), second, rtol=1e-6)
