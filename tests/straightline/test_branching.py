"""What XLA compiles into one function, and what it starts when."""

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.straightline import after


def test_what_comes_after_something_keeps_its_value_and_its_derivative():
    """Whatever that is."""
    tree = {"a": jnp.array([1.0, -2.0]), "k": jnp.arange(3), "b": jnp.array(False)}
    for x in (0.0, -0.0, -1.5, jnp.inf, -jnp.inf, jnp.nan):
        jax.tree.map(np.testing.assert_array_equal, jax.jit(after)(jnp.asarray(x), tree), tree)
        slope = jax.jit(jax.grad(lambda x, a: (after(x, a) ** 2).sum(), (0, 1)))(jnp.asarray(x), tree["a"])
        jax.tree.map(np.testing.assert_array_equal, slope, (0.0, 2 * tree["a"]))
    text = jax.jit(lambda x, y: after(jnp.sort(x)[0], jnp.zeros(3)) + y).lower(jnp.ones(3), 1.0).compile().as_text() or ""
    assert " sort(" in text
