"""A value and its changes along directions: one combined operation if no transformation follows, otherwise its parts."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.transforms.split_jvp import split_jvp


def parts(x, direction):
    (x,), (dx,) = x, direction
    return [jnp.sin(x)], [jnp.cos(x) * dx]


def marked(x, direction):
    """Return the same function with a mark by which tests distinguish the combined operation from its parts."""
    value, (change,) = parts(x, direction)
    return value, [change + 10.0]


def shapes(x):
    shape = jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x))
    return [shape], [shape]


@jax.custom_jvp
def sine(x):
    return jnp.sin(x)


@sine.defjvp
def _(primals, tangents):
    (value,), (change,) = split_jvp(parts, marked, list(primals), list(tangents), shapes(primals[0]))
    return value, change


X = jnp.array([0.3, 0.9])


def test_a_derivative_runs_at_once():
    value, change = jax.jit(lambda x, dx: jax.jvp(sine, (x,), (dx,)))(X, jnp.ones(2))
    np.testing.assert_allclose(value, np.sin(X))
    np.testing.assert_allclose(change, np.cos(X) + 10.0)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_batch_of_directions_runs_at_once(axis):
    directions = jnp.moveaxis(jnp.arange(1.0, 7.0).reshape(3, 2), 0, axis)
    changes = jax.jit(jax.vmap(lambda dx: jax.jvp(sine, (X,), (dx,)), axis, (None, axis)))
    value, change = changes(directions)  # the value is not batched
    np.testing.assert_allclose(value, np.sin(X))
    np.testing.assert_allclose(np.moveaxis(change, axis, 0), np.cos(X) * jnp.moveaxis(directions, axis, 0) + 10.0)


def test_a_batch_of_places_runs_at_once():
    places, directions = jnp.arange(6.0).reshape(3, 2), jnp.ones((3, 2))
    value, change = jax.jit(jax.vmap(lambda x, dx: jax.jvp(sine, (x,), (dx,))))(places, directions)
    np.testing.assert_allclose(value, np.sin(places))
    np.testing.assert_allclose(change, np.cos(places) + 10.0)


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
    def named(at, direction):
        assert at["name"] == "sine"
        return parts([at["x"]], direction)

    (value,), (change,) = jax.jit(lambda x, dx: split_jvp(named, named, {"name": "sine", "x": x}, [dx], shapes(x)))(
        X, jnp.ones(2)
    )
    np.testing.assert_allclose([value, change], [np.sin(X), np.cos(X)])
