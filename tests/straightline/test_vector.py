"""Scalars as one vector: the same numbers and derivatives in either form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.straightline.vector import in_one_kernel, vector


def parts(x, y):
    return [x * y, y, x - 2.0, jnp.sin(x)]


def of(join):
    return lambda x, y: join(parts(x, y))


X = jnp.array([0.3, -0.7, 1.1])


@pytest.mark.parametrize(
    "use",
    [
        lambda f: f(0.3, 0.5),
        lambda f: jax.jit(f)(0.3, 0.5),
        lambda f: jax.vmap(f)(X, 2.0 * X),
        lambda f: jax.vmap(f, (None, 0))(0.3, X),
        lambda f: jax.vmap(jax.vmap(f, (0, None)), (None, 0))(X, X),
        lambda f: jax.jacfwd(f, (0, 1))(0.3, 0.5),
        lambda f: jax.jacrev(f, (0, 1))(0.3, 0.5),
        lambda f: jax.hessian(lambda x: f(x, 0.5) @ f(x, x))(0.3),
        lambda f: jax.vmap(jax.grad(lambda x: f(x, 0.5)[0]))(X),
    ],
    ids=["eager", "jit", "vmap", "vmap of one", "twice", "forward", "reverse", "second", "vmap of grad"],
)
def test_both_forms_are_the_same(use):
    for found, expected in zip(jax.tree.leaves(use(of(in_one_kernel))), jax.tree.leaves(use(of(jnp.stack))), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-15)


def test_single_results_are_selected_on_the_cpu_alone():
    def lowered(f, *arguments, platform="cpu"):
        return jax.jit(f).trace(*arguments).lower(lowering_platforms=(platform,)).as_text()

    f = of(in_one_kernel)
    assert lowered(f, 0.3, 0.5).count("stablehlo.compare") == 4 and "concatenate" not in lowered(f, 0.3, 0.5)
    assert "concatenate" in lowered(f, 0.3, 0.5, platform="cuda")
    assert "concatenate" in lowered(jax.vmap(f), X, X)


@pytest.mark.parametrize(("version", "selected"), [((0, 10, 2), True), ((0, 12, 0), False)])
def test_the_version_decides(monkeypatch, version, selected):
    monkeypatch.setattr(jax, "__version_info__", version)
    assert ("compare" in jax.jit(of(vector)).lower(0.3, 0.5).as_text()) == selected
    np.testing.assert_allclose(vector([X, 2.0 * X]), [X, 2.0 * X])
    assert vector([]).shape == (0,)
