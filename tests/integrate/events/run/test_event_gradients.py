"""Derivatives of runs with events, compared with closed forms and differences."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# All of these runs have events; wrong arguments are meant.
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.friction import rubbing
from tests.integrate.events.event_scenes import BALL, CATCH, CAUGHT, PENDULUM, ROOM, TS, G, floor
from tests.integrate.motions.exact_motions import Table


def test_gradients_of_a_bouncing_ball():
    """Forward derivatives of the end, an output and an impact's time, with respect to restitution, height and gravity."""
    ts = TS[:9]

    def run(x):
        ball = BALL.with_parameters({"body.ball.position": jnp.stack([0 * x[1], x[1]]), "gravity": jnp.stack([0 * x[2], -x[2]])})
        sol = udk.simulate(ball, ts, events=floor(x[0], at_rest="stop"), max_events=4)
        return jnp.stack([sol.q[-1, 0, 1], sol.v[-1, 0, 1], sol.q[4, 0, 1], sol.events.time[1]])

    def exact(x):
        e, height, g = x
        first, v = jnp.sqrt(2 * height / g), jnp.sqrt(2 * height * g)
        second = first + 2 * e * v / g
        d, one = ts[-1] - second, ts[4] - first
        return jnp.stack([e**2 * v * d - g / 2 * d**2, e**2 * v - g * d, e * v * one - g / 2 * one**2, second])

    x = jnp.array([0.8, 1.0, G])
    found, expected = (jax.jit(jax.jacfwd(lambda x, f=f: (f(x),) * 2, has_aux=True))(x) for f in (run, exact))
    assert np.abs(found[1] - expected[1]).max() < 1e-11
    assert np.abs(found[0] - expected[0]).max() < 1e-10


@pytest.mark.slow
def test_second_derivatives_are_refused():
    end = lambda e: udk.simulate(BALL, TS[:3], events=floor(e, at_rest="stop"), max_events=1).q[-1, 0, 1]  # noqa: E731
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.make_jaxpr(jax.jacfwd(jax.jacfwd(end)))(0.8)


@pytest.mark.slow
def test_gradients_through_catch_and_release():
    """Forward mode agrees with differences, and reverse with forward: a joint is added and another released."""
    ts = np.linspace(0.0, 0.6, 4)

    def run(x):
        speed, m, g = x
        ball = {"position": jnp.stack([-1 + 0 * g, -1 + g / 2 / speed**2]), "velocity": jnp.stack([speed, 0 * speed]), "mass": m}
        numbers = {**{f"body.ball.{name}": value for name, value in ball.items()}, "gravity": jnp.stack([0 * g, -g])}
        sol = udk.simulate(CATCH.with_parameters(numbers), ts, events=CAUGHT, rtol=1e-11, atol=1e-11, max_events=2)
        return jnp.concatenate([sol.events.time, sol.q[-1].ravel(), sol.v[-1].ravel(), sol.q[2].ravel()])

    x, h = jnp.array([6.0, 0.5, G]), 1e-5
    value = jax.jit(run)
    differences = np.stack([(value(x.at[k].add(h)) - value(x.at[k].add(-h))) / (2 * h) for k in range(3)], axis=1)
    forward = jax.jit(jax.jacfwd(run))(x)
    assert np.abs(forward - differences).max() < 1e-6
    w = jnp.linspace(-1.0, 1.0, len(forward))
    assert np.abs(jax.jit(jax.grad(lambda x: run(x) @ w))(x) - w @ forward).max() < 1e-11


@pytest.mark.slow
def test_gradients_of_what_comes_to_rest():
    """A pendulum that has come to rest at its stop depends only on the stop."""

    def end(limit, restitution, speed):
        numbers = {"body.link.velocity": jnp.stack([0 * speed, speed / 2]), "body.link.angular_velocity": speed}
        stop = udk.JointLimit("A", lower=limit, restitution=restitution)
        sol = udk.simulate(PENDULUM.with_parameters(numbers), TS[:20], events=stop, max_events=ROOM)
        return sol.q[-1, 0, 2]

    x = -1.0, 0.3, 0.1
    assert np.abs(np.array(jax.grad(end, (0, 1, 2))(*x)) - np.array([1.0, 0.0, 0.0])).max() < 1e-9


@pytest.mark.slow
def test_gradients_of_a_contact_that_lets_go():
    """A shaking table throws the ball when its acceleration is -g. The time and the end are differentiated by its amplitude."""
    ball = BALL.with_parameters({"body.ball.position": [0.0, 0.0], "body.ball.velocity": [0.0, 1.5]})

    def run(a):
        table = udk.Event(Table(jnp.asarray(a)), udk.Impact(0.0), name="table")
        sol = udk.simulate(ball, np.linspace(0.0, 0.2, 3), events=table, max_events=2)
        return jnp.stack([sol.events.time[1], sol.q[-1, 0, 1]])

    def exact(a):
        t = jnp.arcsin(G / (a * 15**2)) / 15
        later = 0.2 - t
        return jnp.stack([t, a * jnp.sin(15 * t) + a * 15 * jnp.cos(15 * t) * later - G / 2 * later**2])

    (found, slope), (expected, exact_slope) = (jax.jvp(f, (0.1,), (1.0,)) for f in (run, exact))
    assert np.abs(found - expected).max() < 1e-8
    assert np.abs(slope - exact_slope).max() < 1e-6 * np.abs(exact_slope).max()


def test_conditions_do_not_close_over_traced_numbers():
    """Their derivatives would be lost."""

    def end(height):
        event = udk.Event(lambda t, at: at["ball"].y - height, udk.Stop())
        return udk.simulate(BALL, TS, events=event).time

    for function in (jax.grad(end), jax.jit(end)):
        with pytest.raises(ValueError, match="closes over traced numbers"):
            function(0.5)


def rocking_box(p):
    """A box that falls on two feet and rocks between them until it rests."""
    feet = [udk.Contact("box", point=[-0.5, -0.2], name="L"), udk.Contact("box", point=[0.5, -0.2], name="R")]
    box = udk.Body(1.0, 0.3, position=jnp.stack([0.0 * p[0], p[0]]), angle=p[1], angular_velocity=p[2])
    return udk.simulate(udk.Mechanism({"box": box}), [0.0, 1.5], events=feet, rtol=1e-10, atol=1e-10)


def test_times_of_events_never_decrease():
    run = rocking_box(np.array([0.6, 0.0, -1.0]))
    assert np.diff(run.events.time).min() >= 0.0
    np.testing.assert_allclose(run.v[-1], 0.0, atol=1e-12)


@pytest.mark.slow
def test_what_rests_does_not_depend_on_how_it_fell():
    """The event at which the second foot comes to rest counts, however close it is to the previous one."""
    slopes = jax.jacfwd(lambda p: rocking_box(p).v[-1, 0])(jnp.array([0.6, 0.0, -1.0]))
    np.testing.assert_allclose(slopes, 0.0, atol=1e-12)


class Drag(udk.ForceElement):
    """Air resistance -coefficient |v| v, whose law has another branch after a rebound."""

    coefficient: float

    def loads(self, t, *frames):
        v = frames[0].vy
        return [(0.0, -self.coefficient * v * jnp.abs(v), 0.0)]


@pytest.mark.slow
def test_a_condition_that_an_impact_carries_across_zero_moves_with_the_impact():
    """The rate of the ball jumps across zero as it hits the floor: its drag takes the other branch, and `turned` is recorded."""
    events = [floor(0.5), udk.Event(lambda t, at: at["ball"].vy, udk.Log(), name="turned")]

    def run(speed):
        ball = {"ball": udk.Body(1.0, 0.1, position=[0.0, 1.0], velocity=jnp.stack([0 * speed, -speed]))}
        air = {"air": Drag(["ball"], coefficient=0.4)}
        sol = udk.simulate(udk.Mechanism(ball, forces=air, gravity=[0.0, 0.0]), [0.0, 1.0], events=events)
        return jnp.stack([sol.q[-1, 0, 1], sol.v[-1, 0, 1], sol.events.time[1], sol.events.v_before[1, 0, 1]])

    def exact(speed):
        hit = jnp.expm1(0.4) / (0.4 * speed)
        up = 0.5 * speed / (1 + 0.4 * speed * hit)
        slowing = 1 + 0.4 * up * (1.0 - hit)
        return jnp.stack([jnp.log(slowing) / 0.4, up / slowing, hit, up])

    (found, slope), (expected, exact_slope) = (jax.jvp(f, (2.0,), (1.0,)) for f in (run, exact))
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    np.testing.assert_allclose(slope, exact_slope, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "most"), [("sticking joints", 20_000), ("a contact", 11_000)])
def test_the_program_of_derivatives_is_short(scene, most):
    """Its length decides how long a user waits for the first gradient."""

    def final(number):
        if scene == "a contact":
            return udk.simulate(BALL, [0.0, 2.0], events=floor(number)).q[-1, 0, 1]
        linkage = rubbing(udk.library.four_bar(), 1.0, law="set-valued")
        return udk.simulate(linkage.with_parameters({f"force.{linkage.force_names[0]}.coefficient": number}), [0.0, 2.0]).q[
            -1, 0, 2
        ]

    def count(jaxpr):
        inner = [
            x for e in jaxpr.eqns for p in e.params.values() for x in jax.tree.leaves(p, is_leaf=lambda x: hasattr(x, "eqns"))
        ]
        jaxprs = [getattr(x, "jaxpr", x) for x in inner]
        return len(jaxpr.eqns) + sum(count(x) for x in jaxprs if hasattr(x, "eqns"))

    operations = [count(jax.make_jaxpr(derivative(final))(0.15).jaxpr) for derivative in (jax.jacfwd, jax.grad)]
    assert max(operations) < most
