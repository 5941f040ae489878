"""Derivatives of runs across the knots of a cam, where the derivatives of the accelerations jump."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk

ANGLES, RADII = 2 * np.pi * np.arange(6) / 6, 1 + 0.2 * np.array([0.0, 1.0, -1.0, 0.5, 0.0, -0.5])
CHANGE, START, FIXED = np.array([0.1, -0.05, 0.03, 0.12, 0.06, -0.15]), 0.2, np.zeros((2, 2))


class TimedCam(udk.Cam):
    """A cam whose profile turns."""

    def residual(self, t, *frames):
        d = self._arm(*frames)
        return [d.norm() - self.profile(jnp.arctan2(d.y, d.x) - 0.1 * t)]

    def piece(self, t, *frames):
        d = self._arm(*frames)
        return self.profile.piece(jnp.arctan2(d.y, d.x) - 0.1 * t)


def at_end(x, kind=udk.Cam, tol=1e-10, **choices):
    """A sum of states of a bead that slides along a fixed cam, by its first speed, a change of the profile, and gravity."""
    speed, change, gravity = x
    profile = udk.Profile(ANGLES, RADII + change * CHANGE)
    scene = udk.Mechanism(
        {"bead": udk.Body(1.0, 0.1)}, {"contact": kind(["ground", "bead"], FIXED, profile)}, gravity=[0.0, -gravity]
    )
    radius, slope = jax.jvp(profile, (START,), (1.0,))
    along, across = jnp.array([np.cos(START), np.sin(START)]), jnp.array([-np.sin(START), np.cos(START)])
    v = speed / radius * (slope * along + radius * across)
    state = udk.State(jnp.append(radius * along, 0.0)[None], jnp.append(v, 0.0)[None])
    run = udk.simulate(scene, [0.0, 0.25, 0.5], state, rtol=tol, atol=tol, throw=False, method=udk.Elimination(), **choices)
    return run.q[1:].sum() + 0.3 * run.v[1:].sum()


X = np.array([-6.0, 0.1, 3.0])


def differences(function, xs, h):
    return np.stack([(np.asarray(function(xs + h * e)) - np.asarray(function(xs - h * e))) / (2 * h) for e in np.eye(3)], 1)


def along(function, direction=(1.0, 1.0, 1.0)):
    """The derivative of a function along a direction."""
    return lambda x: jax.jvp(function, (x,), (jnp.asarray(direction),))[1]


@pytest.fixture(scope="module")
def run():
    """Values and gradients without projection, of many x, by a tolerance."""
    by_tol = jax.value_and_grad(lambda x, tol: at_end(x, tol=tol, stabilization=None))
    return jax.jit(jax.vmap(by_tol, (0, None)))


@pytest.mark.slow
def test_gradients_of_runs_without_projection(run):
    """A stage of a step that ends at a knot is not beyond it, where derivatives are others: gradients were off by 0.2."""
    rng = np.random.default_rng(0)
    xs = X + rng.uniform(-1, 1, (64, 3)) * [1.0, 0.1, 1.0]
    assert_allclose(run(xs, 1e-8)[1], differences(lambda x: run(x, 1e-12)[0], xs, 1e-5), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_second_derivatives_without_projection(run):
    """Without the jumps at the knots they are off by 1.3."""
    found = jax.jit(along(along(lambda x: at_end(x, stabilization=None))))(X)
    expected = differences(lambda x: run(x, 1e-10)[1], X[None], 3e-4)
    assert_allclose(found, expected.sum(), rtol=0, atol=1e-5)


@pytest.mark.slow
def test_second_derivatives_with_baumgarte():
    function = lambda x: at_end(x, stabilization=udk.Baumgarte(5.0, 5.0))  # noqa: E731
    found, gradient = jax.hessian(function)(jnp.asarray(X)), jax.jit(jax.vmap(jax.grad(function)))
    assert_allclose(found, differences(gradient, X[None], 3e-4)[0], rtol=0, atol=2e-6)
    assert_allclose(found, found.T, rtol=0, atol=2e-7)


@pytest.mark.slow
def test_all_orders_of_modes_have_the_same_second_derivatives():
    x = jnp.asarray(X)
    function = lambda x: at_end(x, stabilization=None)  # noqa: E731
    expected = jax.hessian(function)(x)
    for outer, inner in ((jax.jacfwd, jax.jacfwd), (jax.jacrev, jax.jacfwd), (jax.jacrev, jax.jacrev)):
        assert_allclose(outer(inner(function))(x), expected, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_derivatives_that_would_lack_jumps_are_refused():
    def by_diffrax(x):
        return at_end(x, engine="diffrax", max_steps=100, stabilization=None)

    def timed(x):
        return at_end(x, TimedCam)

    for function, reason in (
        (along(along(by_diffrax)), r"order 2 by diffrax lack the jumps .* take differences"),
        (along(along(along(at_end))), "order 3 by diffrax"),
        (along(along(timed)), "pieces that depend on time"),
    ):
        with pytest.raises(NotImplementedError, match=reason):
            jax.jit(function).lower(X)


@pytest.mark.slow
def test_a_condition_costs_no_step_at_the_end_of_a_piece():
    """Conditions are watched up to it before the tiny step across it: polynomials through that step amplify rounding errors."""
    bead = udk.Body(1.0, 0.1, position=[0.00603544, 0.98807494], velocity=[4.78021985, 2.41470853])
    contact = udk.Cam(["ground", "bead"], FIXED, udk.Profile(ANGLES, RADII))
    scene = udk.Mechanism({"bead": bead}, {"contact": contact}, gravity=[0.0, -3.0])
    never = udk.Event(lambda t, at: at["bead"].vx + 99.0, udk.Log(), name="never")
    with_event, without = (udk.simulate(scene, [0.0, 0.4], rtol=1e-10, atol=1e-10, events=e) for e in (never, None))
    assert int(with_event.stats["steps"]) == int(without.stats["steps"])
    assert int(with_event.stats["projections"]) < 2 * int(without.stats["projections"])
    np.testing.assert_array_equal(with_event.q, without.q)


@pytest.mark.parametrize("shift", [0.0, 0.1, 0.3])
def test_a_stiff_damper_lets_a_body_slide_along_a_cam(shift):
    """A body whose turning is damped ever more slides along a cam as one that may not turn, from a knot and from between two.

    States and stages at a knot are on either side by rounding and by errors below the tolerance, which must not end steps.
    Explicit steps that are far too long lead from any state to other pieces.
    """
    angles = 2 * np.pi * np.arange(7) / 7
    body = udk.Body(2.7, 0.09, position=[0.85, 0.0])
    cam = udk.Cam(["ground", "a"], [[0, 0], [-0.3, 0]], udk.Profile(angles + shift, 0.5 + 0.05 * np.cos(2 * angles)))
    spring = udk.TorsionSpring(["ground", "a"], stiffness=5.0, damping=1.0)
    scene = udk.Mechanism({"a": body}, {"cam": cam}, forces={"spring": spring})
    start = udk.assemble(scene)
    held = udk.Mechanism(
        {"a": body}, {"cam": cam}, {"hold": udk.Driver(["ground", "a"], "angle", udk.Polynomial([start.q[0, 2]]))}
    )
    wanted = udk.simulate(held, [0.0, 1.0], start, rtol=1e-10, atol=1e-10).q[-1]

    def error(damping, tol):
        damped = scene.with_parameters({"force.spring.damping": damping})
        run = udk.simulate(damped, [0.0, 1.0], start, rtol=tol, atol=tol, throw=False)
        return jnp.where(run.result == 0, abs(run.q[-1] - wanted).max(), jnp.nan)

    dampings, tolerances = np.logspace(6, 10, 5), np.logspace(-4, -9, 6)
    errors = jax.jit(jax.vmap(jax.vmap(error, (None, 0)), (0, None)))(dampings, tolerances)
    assert (errors < 10 / dampings[:, None] + 200 * tolerances).all()  # the angle changes in proportion to 1 / damping
