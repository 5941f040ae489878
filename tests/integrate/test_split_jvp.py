"""A value and its changes along directions: one form where nothing transforms it any more, the parts for every transformation."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.integrate.split_jvp import split_jvp

FEW = 3


def parts(x, *directions):
    (x,) = x
    return [jnp.sin(x)], *([jnp.cos(x) * dx] for (dx,) in directions)


def marked(x, *directions):
    """The same, and how many directions it went along at once: a form that tests tell from the parts."""
    value, *changes = parts(x, *directions)
    return value, *([change + 10.0 * len(directions)] for (change,) in changes)


@jax.custom_jvp
def sine(x):
    return jnp.sin(x)


@sine.defjvp
def _(primals, tangents):
    (value,), (change,) = split_jvp(parts, marked, list(primals), list(tangents), FEW)
    return value, change


X = jnp.array([0.3, 0.9])


def test_a_derivative_runs_at_once():
    value, change = jax.jit(lambda x, dx: jax.jvp(sine, (x,), (dx,)))(X, jnp.ones(2))
    np.testing.assert_allclose(value, np.sin(X))
    np.testing.assert_allclose(change, np.cos(X) + 10.0)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_a_batch_of_few_directions_is_so_many_directions(size, axis):
    directions = jnp.moveaxis(jnp.arange(1.0, 2 * size + 1).reshape(size, 2), 0, axis)

    @jax.jit
    def changes(directions):
        return jax.vmap(lambda dx: jax.jvp(sine, (X,), (dx,)), axis, (None, axis))(directions)

    value, change = changes(directions)  # the value is not batched
    np.testing.assert_allclose(value, np.sin(X))
    expected = np.cos(X) * jnp.moveaxis(directions, axis, 0) + (10.0 * size if size <= FEW else 0.0)
    np.testing.assert_allclose(np.moveaxis(change, axis, 0), expected)


def test_a_batch_of_batches_is_as_many_directions():
    directions = jnp.arange(6.0).reshape(3, 1, 2)
    jvp = lambda dx: jax.jvp(sine, (X,), (dx,))[1]  # noqa: E731
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.vmap(jvp)))(directions), np.cos(X) * directions + 30.0)
    directions = jnp.arange(8.0).reshape(2, 2, 2)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.vmap(jvp)))(directions), np.cos(X) * directions)


def test_a_batch_of_places_is_one_of_the_parts():
    places, directions = jnp.arange(6.0).reshape(3, 2), jnp.ones((3, 2))
    value, change = jax.jit(jax.vmap(lambda x, dx: jax.jvp(sine, (x,), (dx,))))(places, directions)
    np.testing.assert_allclose(value, np.sin(places))
    np.testing.assert_allclose(change, np.cos(places))


def test_a_linearization_sees_the_parts_also_within_loops():
    @partial(jax.jit, static_argnums=1)
    def linear(x, within):
        def looped(x):
            return jax.lax.while_loop(lambda c: c[0] < 1, lambda c: (c[0] + 1, sine(c[1])), (0, x))[1]

        value, push = jax.linearize(looped if within else sine, x)
        return value, push(jnp.ones(2)), jax.jit(push)(jnp.ones(2))

    value, change, again = linear(X, False)
    np.testing.assert_allclose(value, np.sin(X))
    np.testing.assert_allclose(change, np.cos(X))
    np.testing.assert_allclose(again, np.cos(X))
    value, change, _ = linear(X, True)  # its tangents are found in a loop of their own, where both are
    np.testing.assert_allclose(value, np.sin(X))
    np.testing.assert_allclose(change, np.cos(X) + 10.0)
    np.testing.assert_allclose(jax.grad(lambda x: sine(x).sum())(X), np.cos(X))


def test_a_second_derivative_is_that_of_the_parts():
    second = jax.jit(jax.jacfwd(jax.jacfwd(lambda x: sine(x).sum())))(X)
    np.testing.assert_allclose(second, -np.diag(np.sin(X)), atol=1e-15)
    np.testing.assert_allclose(jax.jit(jax.hessian(lambda x: sine(x).sum()))(X), -np.diag(np.sin(X)), atol=1e-15)


def test_what_is_no_array_is_handed_on():
    def named(at, *directions):
        assert at["name"] == "sine"
        return parts([at["x"]], *directions)

    (value,), (change,) = jax.jit(lambda x, dx: split_jvp(named, named, {"name": "sine", "x": x}, [dx]))(X, jnp.ones(2))
    np.testing.assert_allclose([value, change], [np.sin(X), np.cos(X)])
