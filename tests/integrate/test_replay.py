"""Reverse mode by walking back the steps of a run: the same numbers as forward mode, and as diffrax's checkpoints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.integrate import by_native, record

PENDULUM = udk.library.compound_pendulum()
ROD = PENDULUM.body_names[0]
TS = jnp.linspace(0.0, 2.0, 9)
# With the first step left to the integrator the second depends on rounding errors: two programs would take other steps.
# Elimination has no steps to take with care, which would take twice as long to compile.
CHOICES = {"rtol": 1e-9, "atol": 1e-9, "dt0": 0.03, "method": udk.Elimination(), "throw": False}
X = (jnp.array([0.1, 9.81]), jnp.array(0.3), TS)


def angles(x, mechanism=PENDULUM, **choices):
    """The angle and its rate at the output times, as a function of inertia and gravity, the initial rate and these times."""
    (inertia, gravity), rate, ts = x
    m = mechanism.with_parameters({f"body.{ROD}.inertia": inertia, "gravity": jnp.stack([0.0 * gravity, -gravity])})
    arm = mechanism.q0[0, :2]
    v = rate * jnp.array([[-arm[1], arm[0], 1.0]])
    solution = udk.simulate(m, ts, udk.State(mechanism.q0, v), **{**CHOICES, **choices})
    return jnp.stack([solution.q[:, 0, 2], solution.v[:, 0, 2]])


def total(x, **choices):
    found = angles(x, **choices)
    return jnp.sum(jnp.cos(jnp.arange(found.size)).reshape(found.shape) * found)


@pytest.fixture(scope="module")
def gradient():
    return jax.jit(jax.grad(total))


def assert_same(found, expected, tol):
    """Each derivative, relative to the largest of its kind."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(a, b, rtol=0, atol=tol * np.abs(b).max())


def test_reverse_mode_is_forward_mode(gradient):
    """To rounding: along parameters, along the start, and along the output times, on which the last step's size depends too.

    With vectors of 512 bits they were 1.2e-13 of the largest derivative apart.
    """
    from diffrax import ForwardMode

    forward = jax.jit(jax.jacfwd(lambda x: total(x, adjoint=ForwardMode())))(X)
    assert np.all(np.abs(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(forward)])) > 1e-3)
    assert_same(gradient(X), forward, 1e-12)


@pytest.mark.slow
def test_reverse_mode_by_checkpoints(gradient):
    from diffrax import RecursiveCheckpointAdjoint

    twin = jax.jit(jax.grad(lambda x: total(x, adjoint=RecursiveCheckpointAdjoint(), max_steps=256)))(X)
    assert_same(gradient(X), twin, 1e-6)


@pytest.mark.parametrize("kept", [8, pytest.param(1, marks=pytest.mark.slow)])
def test_steps_that_were_not_kept_are_taken_again(gradient, monkeypatch, kept):
    monkeypatch.setattr(record, "KEPT", kept)
    assert udk.simulate(PENDULUM, TS, **CHOICES).stats["accepted"] > 2 * kept
    found = jax.jit(jax.grad(lambda x: total(x, max_steps=1000 + kept)))(X)
    assert_same(found, gradient(X), 1e-12)


def test_members_of_a_batch_are_walked_back_each_by_itself(gradient):
    """Of a sum over a batch, with numbers of each member and numbers of all."""
    inertias, gravity = jnp.array([0.1, 0.2, 0.4]), jnp.array(9.81)

    def batch(inertias, gravity):
        members = jax.vmap(lambda i, weight: weight * total((jnp.stack([i, gravity]), *X[1:])))
        return jnp.sum(members(inertias, jnp.arange(1.0, 4.0)))

    of_each, of_all = jax.jit(jax.grad(batch, (0, 1)))(inertias, gravity)
    alone = jnp.stack(
        [w * gradient((jnp.stack([i, gravity]), *X[1:]))[0] for i, w in zip(inertias, (1.0, 2.0, 3.0), strict=True)]
    )
    assert_allclose(of_each, alone[:, 0], rtol=1e-11)
    assert_allclose(of_all, alone[:, 1].sum(), rtol=1e-11)


@pytest.mark.slow
def test_a_jacobian_of_each_member():
    """Cotangents in a batch within members in a batch."""
    from diffrax import ForwardMode

    members = jnp.array([0.1, 0.2])

    def jacobian(mode, **choices):
        return jax.jit(jax.vmap(mode(lambda i: angles((jnp.stack([i, 9.81 + 0.0 * i]), *X[1:]), **choices))))(members)

    found, expected = jacobian(jax.jacrev), jacobian(jax.jacfwd, adjoint=ForwardMode())
    assert found.shape == (2, 2, 9)
    assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_second_derivatives(gradient):
    """Forward over reverse, against differences of the gradient."""
    along, h = (jnp.array([1.0, 20.0]), jnp.array(2.0), jnp.zeros(9)), 1e-4
    second = jax.jit(lambda x, d: jax.jvp(jax.grad(total), (x,), (d,))[1])(X, along)
    moved = [gradient(jax.tree.map(lambda x, d: x + sign * h * d, X, along)) for sign in (1, -1)]  # noqa: B023
    assert_same(second, jax.tree.map(lambda a, b: (a - b) / (2 * h), *moved), 1e-5)


def test_a_run_that_stops(gradient):
    """What was reached has its derivatives; what was not has none."""
    few = lambda x: angles(x, max_steps=15)  # noqa: E731
    value, back = jax.vjp(jax.jit(few), X)
    reached = int(np.isfinite(value[0]).sum())
    assert 2 < reached < len(TS)
    whole, again = jax.vjp(jax.jit(angles), X)
    weights = jnp.cos(jnp.arange(18.0)).reshape(2, 9)
    assert_allclose(value[:, :reached], whole[:, :reached], rtol=1e-12)
    assert_same(back(weights), again(weights.at[:, reached:].set(0.0)), 1e-12)


def test_only_what_depends_on_the_parameters_is_differentiated(monkeypatch):
    seen, moving = [], by_native._moving
    monkeypatch.setattr(by_native, "_moving", lambda *given: seen.append(moving(*given)) or seen[-1])
    inertia = lambda x: total(((x, X[0][1]), *X[1:]), max_steps=997)  # noqa: E731
    jax.jit(jax.grad(inertia)).lower(0.1)
    assert seen and all(0 < sum(flags) < len(flags) / 2 for flags in seen)


def test_gradients_along_different_numbers_do_not_mix():
    """JAX keeps what it has traced: along all numbers, along one, and again along all, where only a part is traced anew."""
    along_one = lambda inertia: total(((inertia, X[0][1]), *X[1:]), max_steps=998)  # noqa: E731
    again = jax.jit(lambda x: angles(x, max_steps=998))
    for function, x in ((lambda x: total(x, max_steps=998), X), (along_one, 0.1), (lambda x: again(x)[0, 1], X)):
        assert jax.make_jaxpr(jax.grad(function))(x).out_avals


# --- other scenes and methods


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["Tsit5", "Bosh3", "Verner65"])
def test_other_methods(solver):
    """Also those whose last stage no step makes use of."""
    from diffrax import ForwardMode

    from udkjax.integrate.solvers import solver_named

    choices = {"solver": solver_named(solver), "rtol": 1e-6, "atol": 1e-6}
    forward = jax.jit(jax.jacfwd(lambda x: total(x, adjoint=ForwardMode(), **choices)))(X)
    assert_same(jax.jit(jax.grad(lambda x: total(x, **choices)))(X), forward, 1e-12)


@pytest.mark.slow
def test_steps_taken_with_care():
    """Released from rest where all links of the linkage are in line: the first steps take singular values."""
    from diffrax import ForwardMode

    linkage = udk.library.parallelogram(0.0)

    def end(x, **choices):
        angle, gravity = x
        along = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        links = [jnp.append(jnp.array([x0, 0.0]) + along / 2, angle) for x0 in (0.0, 1.0, 2.0)]
        q = jnp.stack([*links, jnp.append(jnp.array([1.0, 0.0]) + along, 0.0)])
        m = linkage.with_parameters({"gravity": jnp.stack([0.0 * gravity, -gravity])})
        solution = udk.simulate(m, [0.0, 0.5, 1.0], udk.State(q, jnp.zeros((4, 3))), dt0=0.03, throw=False, **choices)
        return jnp.stack([solution.q[1:, 0, 2], solution.v[1:, 0, 2]])

    x = (jnp.array(0.0), jnp.array(9.81))
    forward = jax.jit(jax.jacfwd(lambda x: end(x, adjoint=ForwardMode())))(x)
    assert_same(jax.jit(jax.jacrev(end))(x), forward, 1e-8)
