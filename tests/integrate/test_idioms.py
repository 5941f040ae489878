"""Runs inside JAX's other idioms give what plain calls give: linear parts, rules of one's own, loops, copies, threads."""

import copy
import pickle
import threading
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

import udkjax as udk
from tests.choices import fast

TS = np.linspace(0.0, 0.5, 6)
PENDULUM = udk.library.double_pendulum()
MASS = "body.upper.mass"


def angle(mass):
    return udk.simulate(PENDULUM.with_parameters({MASS: mass}), TS).q[-1, 0, 2]


def by_linearize():
    linear = jax.linearize(angle, 1.2)[1]
    return linear(2.0) / 2


def by_transposed():
    return jax.linear_transpose(jax.linearize(angle, 1.2)[1], 1.0)(1.0)[0]


def by_checkpoint():
    return jax.jit(jax.grad(jax.checkpoint(angle)))(1.2)


def by_own_rule():
    """A rule that doubles the derivative, halved."""
    own = jax.custom_jvp(angle)
    own.defjvp(lambda primals, tangents: (own(*primals), 2 * jax.jvp(angle, primals, tangents)[1]))
    return jax.vmap(jax.grad(own))(jnp.array([1.2, 1.3]))[0] / 2


def by_branches():
    return jax.grad(lambda mass: jax.lax.cond(mass > 1.0, angle, lambda mass: 0.0 * mass, mass))(1.2)


def by_map():
    return jax.lax.map(jax.grad(angle), jnp.array([1.0, 1.2]))[1]


def by_auxiliary_results():
    def with_run(mass):
        run = udk.simulate(PENDULUM.with_parameters({MASS: mass}), TS)
        return run.q[-1, 0, 2], run

    (_, run), slope = jax.value_and_grad(with_run, has_aux=True)(1.2)
    assert run.result == udk.Result.successful
    return slope


WAYS = {
    way.__name__.removeprefix("by_"): way
    for way in (by_linearize, by_transposed, by_checkpoint, by_own_rule, by_branches, by_map, by_auxiliary_results)
}


@pytest.mark.parametrize("way", fast(["linearize"], WAYS))
def test_a_derivative_is_the_same_by_every_way(way):
    assert_allclose(WAYS[way](), jax.grad(angle)(1.2), rtol=1e-12)


@pytest.mark.slow
def test_runs_in_a_loop_are_one_long_run():
    """Also their derivatives, with respect to the first velocities."""
    start = udk.assemble(PENDULUM)

    def end(factor):
        def on(carry, _):
            run = udk.simulate(PENDULUM, TS, udk.State(*carry), rtol=1e-11, atol=1e-11)
            return (run.q[-1], run.v[-1]), None

        return jax.lax.scan(on, (start.q, start.v + factor), None, length=3)[0][0][0, 2]

    def whole(factor):
        run = udk.simulate(PENDULUM, 3 * TS, udk.State(start.q, start.v + factor), rtol=1e-11, atol=1e-11)
        return run.q[-1, 0, 2]

    assert_allclose(jax.jit(jax.value_and_grad(end))(0.3), jax.value_and_grad(whole)(0.3), rtol=1e-7)


@pytest.mark.slow
def test_arrays_that_are_given_away_are_not_those_of_later_runs():
    """What `assemble` returns is stored, and a function may take its memory."""
    expected = np.asarray(udk.simulate(PENDULUM, TS).q)
    run = jax.jit(lambda q, v: udk.simulate(PENDULUM, TS, udk.State(q, v)).q, donate_argnums=(0, 1))
    start = udk.assemble(PENDULUM)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the memory is of no use for the result
        assert_allclose(run(start.q, start.v), expected, rtol=1e-12)
    assert_allclose(udk.simulate(PENDULUM, TS).q, expected, rtol=1e-12)


def test_copies_run_alike():
    for mechanism in (PENDULUM, udk.library.four_bar()):
        expected = udk.simulate(mechanism, TS)
        for other in (pickle.loads(pickle.dumps(mechanism)), copy.deepcopy(mechanism)):
            assert_allclose(udk.simulate(other, TS).q, expected.q, rtol=0, atol=0)
        assert_allclose(pickle.loads(pickle.dumps(expected)).q, expected.q, rtol=0, atol=0)


@pytest.mark.slow
def test_threads_that_begin_with_the_same_structures():
    """Structures of other tests are known; these are not."""
    found: dict[int, list] = {}

    def run(k):
        found.setdefault(k % 3, []).append(np.asarray(udk.simulate(udk.library.chain(7 + k % 3), TS).q))

    threads = [threading.Thread(target=run, args=(k,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k, runs in found.items():
        assert len(runs) == 2
        for q in runs:
            assert_allclose(q, udk.simulate(udk.library.chain(7 + k), TS).q, rtol=0, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [np.float32, jnp.float32, np.int32, int, jnp.asarray])
def test_numbers_of_other_types(kind):
    assert_allclose(angle(kind(2)), angle(2.0), rtol=0, atol=0)
    assert_allclose(jax.jit(angle)(kind(2)), angle(2.0), rtol=1e-12)
    assert udk.simulate(PENDULUM, TS.astype(np.float32)).q.dtype == float


@pytest.mark.slow
def test_all_leaves_as_one_vector():
    mechanism = udk.library.four_bar()
    x, back = ravel_pytree(eqx.filter(mechanism, eqx.is_inexact_array))

    def end(x):
        return udk.simulate(eqx.combine(back(x), mechanism), TS, rtol=1e-11, atol=1e-11).q[-1, 0, 2]

    slope = np.asarray(jax.grad(end)(x))
    along = np.random.default_rng(0).standard_normal(len(x)) * (slope != 0)
    h = 1e-5
    assert_allclose(slope @ along, (end(x + h * along) - end(x - h * along)) / (2 * h), rtol=1e-6)


def test_a_vector_of_one_number_is_no_number():
    with pytest.raises(ValueError, match=r"must have the shape \(\), not \(1,\)"):
        jax.jit(angle)(jnp.array([1.2]))
