"""Derivatives of functions whose values are undefined for some members."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.programs.undefined import at_each, defined, defined_along, whole


@defined
def roots(x, y):
    """Values with an infinite slope where x < 0, and with none; both are NaN there."""
    return {"root": jnp.sqrt(x) * y, "product": jnp.where(x > 0, x * y, jnp.nan), "name": "roots", "count": jnp.arange(2)}


def masked(x, y):
    found = roots(x, y)
    return sum(jnp.where(jnp.isfinite(found[name]), found[name], 0.0) for name in ("root", "product"))


MODES = pytest.mark.parametrize("mode", [lambda f: f, jax.jit], ids=["eager", "jit"])


@MODES
@pytest.mark.parametrize("name", ["root", "product"])
def test_a_value_that_is_nan_has_the_tangent_nan(mode, name):
    """Left to JAX, the tangent of the second is that of a constant, zero."""
    for argument in (0, 1):
        tangents = [float(k == argument) for k in range(2)]
        value, slope = mode(lambda x, y, t: jax.jvp(lambda x, y: roots(x, y)[name], (x, y), t))(-1.0, 2.0, tuple(tangents))
        assert np.isnan(value) and np.isnan(slope)
    assert np.isnan(mode(jax.grad(lambda x: roots(x, 2.0)[name]))(-1.0))


@MODES
def test_a_cotangent_that_is_zero_contributes_nothing(mode):
    """Left to JAX, zero times an infinite slope is NaN."""
    np.testing.assert_array_equal(mode(jax.grad(masked, (0, 1)))(-1.0, 2.0), (0.0, 0.0))
    np.testing.assert_allclose(mode(jax.grad(masked, (0, 1)))(4.0, 2.0), (2.5, 6.0), rtol=1e-15)
    np.testing.assert_allclose(mode(jax.hessian(masked))(4.0, 2.0), -1 / 16, rtol=1e-15)


@MODES
def test_members_of_a_batch_do_not_touch_each_other(mode):
    """A number that all members share gets the cotangents of those that are defined."""
    xs = jnp.array([-1.0, 4.0, -2.0])
    np.testing.assert_allclose(mode(jax.vmap(jax.grad(masked), (0, None)))(xs, 2.0), [0.0, 2.5, 0.0], rtol=1e-15)
    total = lambda xs, y: jnp.sum(jax.vmap(masked, (0, None))(xs, y))  # noqa: E731
    by_x, by_y = mode(jax.grad(total, (0, 1)))(xs, 2.0)
    np.testing.assert_allclose(by_x, [0.0, 2.5, 0.0], rtol=1e-15)
    np.testing.assert_allclose(by_y, 6.0, rtol=1e-15)
    each = lambda y: at_each(lambda y, x: jnp.sqrt(x) * y, y, xs)  # noqa: E731
    np.testing.assert_allclose(mode(jax.grad(lambda y: jnp.nansum(each(y))))(2.0), 2.0, rtol=1e-15)
    assert np.isnan(mode(jax.grad(lambda y: jnp.sum(each(y))))(2.0))


def test_a_second_derivative_at_a_zero_cotangent_is_right():
    """The first derivative of a square is zero at its root; the second is not."""
    square = lambda x: (roots(x, 2.0)["product"] - 8.0) ** 2  # noqa: E731
    np.testing.assert_allclose([jax.grad(square)(4.0), jax.hessian(square)(4.0)], [0.0, 8.0], atol=1e-15)


def test_tangents_of_a_rule():
    """The rule of a function with its own derivative: its linear map multiplies by an infinite slope where the value is NaN."""

    @jax.custom_jvp
    def inverse(x):
        return jnp.where(x > 0, 1.0 / x, jnp.nan)

    @inverse.defjvp
    def _(primals, tangents):
        (x,), value = primals, inverse(*primals)
        (slope,) = defined_along(lambda dxs: [dxs[0] * jnp.where(x > 0, -1.0 / x**2, jnp.inf)], tangents, [value])
        return value, slope

    gradient = jax.jit(jax.vmap(jax.grad(lambda x: jnp.nan_to_num(inverse(x)))))
    np.testing.assert_allclose(gradient(jnp.array([2.0, -1.0])), [-0.25, 0.0], rtol=1e-15)
    assert np.isnan(jax.grad(inverse)(-1.0)) and np.isnan(jax.jacfwd(inverse)(-1.0))


def test_a_state_is_undefined_as_a_whole():
    q, v = whole(jnp.array([1.0, jnp.nan]), jnp.array([2.0]))
    assert np.isnan(q).all() and np.isnan(v).all()
    np.testing.assert_array_equal(whole(jnp.array([1.0, 2.0]))[0], [1.0, 2.0])


RESULTS = {
    "of no number": lambda y, x: (x * y, jnp.zeros(2)),
    "of no member": lambda y, x: (x * y, jnp.cos(y)),
    "empty": lambda y, x: (x * y, jnp.zeros(0)),
    "a rate of zero": lambda y, x: (x * y, jax.jvp(lambda t: jnp.sin(y), (x,), (1.0,))[1]),
}


@pytest.mark.parametrize("name", RESULTS)
def test_members_have_derivatives_though_a_result_is_the_same_for_all(name):
    """A program is traced before it is differentiated: with `jit`, results must not get the axis of members later."""
    xs = jnp.array([1.0, 2.0, 4.0])
    each = jax.jit(lambda y: at_each(RESULTS[name], y, xs))
    values, slopes = jax.jvp(each, (2.0,), (1.0,))
    others = [RESULTS[name](2.0, x) for x in xs]
    np.testing.assert_array_equal(values[0], 2.0 * xs)
    np.testing.assert_array_equal(values[1], jnp.stack([x[1] for x in others]))
    np.testing.assert_array_equal(slopes[0], xs)
    wanted = -np.sin(2.0) if name == "of no member" else 0.0
    np.testing.assert_allclose(slopes[1], np.full(values[1].shape, wanted), rtol=1e-15)
