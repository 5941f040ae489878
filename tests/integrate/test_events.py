"""Events: times and states against closed forms, jumps against their identities, derivatives against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

import udkjax as udk
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.textbook import prepare
from udkjax.integrate.impact import jump

G = 9.81
ROOM = 24  # events of a run
BALL = udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=(0.0, 1.0))})
PENDULUM = udk.Mechanism(
    {"link": udk.Body(1.0, 0.1, position=(0.5, 0.0))}, {"A": udk.Revolute(("ground", "link"), [[0, 0], [-0.5, 0]])}
)
SWING = G * 0.5 / (0.1 + 0.25)  # the square of its small frequency


def floor(restitution, **more):
    return udk.Contact("ball", restitution=restitution, name="floor", **more)


def bounce(restitution, ts, height=1.0, speed=0.0, inertia=0.1, **more):
    """A ball above the floor, with velocity `speed` upwards."""
    numbers = {"position": [0.0, height], "velocity": [0.0, speed], "inertia": inertia}
    ball = BALL.with_parameters({f"body.ball.{name}": x for name, x in numbers.items()})
    return udk.simulate(ball, ts, events=floor(restitution), max_events=ROOM, throw=False, **more)


def exact_bounces(restitution, count, height=1.0):
    """The times of impacts, and the speeds with which they end."""
    v = np.sqrt(2 * G * height) * restitution ** np.arange(1, count + 1)
    first = np.sqrt(2 * height / G)
    return first + np.append(0.0, np.cumsum(2 * v[:-1] / G)), v


TS = np.linspace(0.0, 8.0, 40)


def test_ball_bounces_at_its_exact_times():
    sol = bounce(0.95, TS)
    times, speeds = exact_bounces(0.95, 40)
    count = int(sol.events.count)
    assert sol.result == udk.Result.successful and sol.settings["engine"] == "native"
    assert count == np.sum(times < TS[-1]) and sol.events.names[0] == "floor"
    assert np.abs(sol.events.time - times[:count]).max() < 1e-11
    assert np.abs(sol.events.q_before[:, 0, 1]).max() < 1e-12
    assert np.abs(sol.events.v_after[:, 0, 1] - speeds[:count]).max() < 1e-10
    k = np.searchsorted(times, TS) - 1
    d = TS - times[k]
    height = np.where(k < 0, 1 - G / 2 * TS**2, speeds[k] * d - G / 2 * d**2)
    assert np.abs(sol.q[:, 0, 1] - height).max() < 1e-10


def test_endless_bounces_come_to_rest():
    sol = bounce(0.5, TS)
    v = np.sqrt(2 * G)
    assert sol.result == udk.Result.successful
    assert sol.events.counts["floor rests"] == 1 and sol.events.counts["floor lets go"] == 0
    assert abs(float(sol.events.time[-1]) - (v / G + 2 * v / G * 0.5 / (1 - 0.5))) < 1e-4
    assert np.abs(sol.q[-1]).max() < 1e-12 and np.abs(sol.v[-1]).max() < 1e-12


def test_too_many_events_are_a_code():
    sol = bounce(0.9, TS)
    assert sol.result == udk.Result.event_limit and sol.events.count == ROOM
    assert np.isnan(sol.q[-1]).all() and float(sol.time) < 8.0
    with pytest.raises(udk.SimulationError, match="max_events"):
        udk.simulate(BALL, TS, events=floor(0.9), max_events=ROOM)


def test_start_on_an_event():
    down, rest, up, below = (bounce(0.5, TS, h, v) for h, v in ((0.0, -1.0), (0.0, 0.0), (0.0, 1.0), (-0.1, 0.0)))
    assert float(down.events.time[0]) == 0.0 and np.allclose(down.events.v_after[0, 0], [0, 0.5, 0], atol=1e-15)
    assert float(rest.events.time[0]) == 0.0 and rest.events.counts["floor rests"] == 1 and rest.events.count == 1
    assert abs(float(up.events.time[0]) - 2 / G) < 1e-12
    assert below.result == udk.Result.beyond_contact and below.time == 0.0


def test_micrometres_bounce_alike():
    large, small = bounce(0.5, TS), bounce(0.5, TS * 1e-3, 1e-6, inertia=0.1e-12)
    assert small.events.count == large.events.count
    assert np.abs(small.events.time[:8] * 1e3 - large.events.time[:8]).max() < 1e-10


def test_pendulum_bounces_off_a_stop_as_elliptic_integrals_say():
    e, w = 0.95, np.sqrt(2 * SWING)
    sol = udk.simulate(
        PENDULUM, TS * 2.4, rtol=1e-11, atol=1e-11, events=udk.JointLimit("A", lower=-np.pi / 2, restitution=e), max_events=ROOM
    )
    speeds = w * e ** np.arange(1, ROOM)  # after each impact; away and back takes half a period
    times = ellipk(0.5) / np.sqrt(SWING) + np.append(0.0, np.cumsum(2 * ellipk(speeds**2 / (4 * SWING)) / np.sqrt(SWING)))
    count = int(sol.events.count)
    assert count >= 20
    assert np.abs(sol.events.time - times[:count]).max() < 1e-10
    assert np.abs(sol.events.v_after[:, 0, 2] - speeds[:count]).max() < 1e-9
    assert np.abs(sol.events.q_before[:, 0, 2] + np.pi / 2).max() < 1e-12


@pytest.mark.parametrize("name", ["parallelogram", "four_bar", "n_four_bar"])
def test_jump_keeps_constraints_and_energy(name):
    """Of redundant mechanisms, too: the jump is D^+ of the constraints' rows with the contact's appended."""
    mech = getattr(udk.library, name)()
    q, n = udk.assemble(mech).q.ravel(), len(mech.body_names) * 3
    equations = prepare(mech, udk.SVD())
    _, v = equations.project(0.0, q, jnp.arange(1.0, n + 1))
    normal = jnp.zeros(n).at[2].set(1.0)
    rate, e = normal @ v, 0.6
    found = jump(equations, 0.0, q, normal, rate)
    dv = (1 + e) * found.dv
    D, root = uk.D(mech, 0.0, q, equations.weights), uk.root(mech)
    appended = jnp.concatenate([D, (root * normal)[None]])
    assert found.free
    assert np.abs(dv - root * (udk.SVD(1e-4)(appended) @ jnp.zeros(len(appended)).at[-1].set(-(1 + e) * rate))).max() < 1e-10
    assert np.abs(D @ (dv / root)).max() < 1e-10 * np.abs(dv / root).max()
    assert abs(normal @ (v + dv) + e * rate) < 1e-11 * abs(rate)
    mass = 1 / root**2
    null = jnp.eye(n) - udk.SVD(1e-4)(D) @ D
    effective = (root * normal) @ null @ (root * normal)
    lost = (mass @ (v + dv) ** 2 - mass @ v**2) / 2
    assert abs(lost + (1 - e**2) / 2 * rate**2 / effective) < 1e-10 * abs(lost)


def test_an_impact_that_the_constraints_block_says_so():
    equations = prepare(PENDULUM, udk.SVD())
    along = jnp.array([1.0, 0.0, 0.0])  # the pin takes it
    assert not jump(equations, 0.0, PENDULUM.q0.ravel(), along, -1.0).free


def test_gradients_of_a_bouncing_ball():
    """Forward, of the end, an output and an impact's time, by restitution, height and gravity."""
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
    assert np.abs(run(x) - exact(x)).max() < 1e-11
    assert np.abs(jax.jacfwd(run)(x) - jax.jacfwd(exact)(x)).max() < 1e-10


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (udk.JointLimit("B", lower=0.0), 'no joint named "B"'),
        (udk.JointLimit("A"), "give `lower` or `upper`"),
        (udk.Contact("lnik"), 'no body named "lnik"; did you mean "link"'),
        (udk.Event(lambda t, at: at["lnik"].x), 'event "event1": no body named "lnik"; did you mean "link"'),
        (udk.Event(lambda t, at: at["link"].omega, udk.Impact(0.5)), "must depend on positions alone"),
        (udk.Event(lambda t, at: at["link"].x, udk.Impact(1.5)), "restitution must be from 0 to 1, is 1.5"),
        (udk.Event(lambda t, at: at["link"].x, udk.Release("C")), 'no joint or driver named "C"'),
        (udk.Event(lambda t, at: jnp.ones(2)), r"must return one number, not an array of shape \(2,\)"),
        ([udk.Contact("link"), udk.Contact("link")], "two events have this name"),
        ([], "the list is empty"),
        ([1.0], r"events\[0\]: must be an Event"),
    ],
)
def test_mistakes_are_named(events, message):
    with pytest.raises(ValueError, match=message):
        udk.simulate(PENDULUM, TS, events=events)
