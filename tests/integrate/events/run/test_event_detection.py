"""No crossing is missed: conditions that vary quickly, late, in pairs, or with jumps. If one might be, the run says so."""

# pyright: reportOptionalMemberAccess=false
# All of these runs have events.
import warnings
from itertools import product
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import erf

import udkjax as udk
from tests.calls import calls_of
from tests.integrate.events.event_scenes import Level
from udkjax.integrate.events.run.host_run import PlainForm
from udkjax.integrate.events.run.phase_code import PhaseCode

POINT = udk.Mechanism({"b": udk.Body(1.0, 0.1, velocity=[1.0, 0])}, gravity=[0, 0])  # x = t


def wave(xp, numbers, x):
    f, power, other, offset = numbers
    return xp.sin(f * x**power + 0.1) * xp.sin(other * x + 1.0) + offset


class Wave(eqx.Module):
    """A condition that depends on the position of the body and on four numbers."""

    numbers: jax.Array

    def __call__(self, t, at):
        return wave(jnp, self.numbers, at["b"].x)


def crossings(function, end=1.0):
    t = np.linspace(0, end, 100001)
    y = np.asarray(function(t))
    return np.array([brentq(lambda s: float(function(s)), *t[k : k + 2], xtol=1e-15) for k in np.flatnonzero(y[1:] * y[:-1] < 0)])


def positions(sol):
    return np.asarray(sol.events.q_before)[:, 0, 0]


def test_no_crossing_is_lost_at_any_frequency():
    """One compiled run for all: slow, fast and late fast conditions, products, and dips of a depth of 1e-6."""
    waves = np.array(
        [
            [3, 1, 0, 0],
            [200, 1, 0, 0],
            [1000, 1, 0, 0.3],
            [300, 6, 0, 0],
            [200, 1, 171, 0],
            [40, 1, 0, np.sin(1.0) - 1e-6],
            [0, 1, 0, 1],
        ]
    )
    run = jax.jit(
        lambda numbers: udk.simulate(POINT, [0.0, 1.0], events=udk.Event(Wave(numbers), udk.Log(), name="wave"), max_events=400)
    )
    for numbers in waves:
        sol, expected = run(numbers), crossings(lambda x, numbers=numbers: wave(np, numbers, x))
        count = int(sol.events.count)
        assert sol.code == udk.Result.successful and count == len(expected), numbers
        assert np.abs(positions(sol)[:count] - expected).max(initial=0) < 1e-9
        assert np.isinf(sol.events.unresolved).all()
    assert int(sol.stats["steps"]) < 10  # where nothing happens it is one run of the integrator, whatever the condition


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "jax"])
@pytest.mark.parametrize("f", [200, 500, 1000, 2000])
@pytest.mark.parametrize("outputs", [2, 50])
def test_conditions_of_position_velocity_and_time(f, engine, outputs):
    """A body falls, v = 1 - g t, and all conditions cross at the expected times."""
    fall = udk.Mechanism({"b": udk.Body(1.0, 0.1, velocity=[1.0, 1.0])})
    conditions = {
        "x": (lambda t, at: jnp.sin(f * at["b"].x + 0.1), lambda t: np.sin(f * t + 0.1)),
        "vy": (lambda t, at: jnp.sin(f / 10 * at["b"].vy + 0.1), lambda t: np.sin(f / 10 * (1 - 9.81 * t) + 0.1)),
        "t": (lambda t, at: jnp.sin(f * t + 0.2), lambda t: np.sin(f * t + 0.2)),
    }
    events = [udk.Event(condition, udk.Log(), name=name) for name, (condition, _) in conditions.items()]
    sol = udk.simulate(fall, np.linspace(0, 0.5, outputs), events=events, max_events=2000, engine=engine)
    for name, (_, exact) in conditions.items():
        found, expected = np.asarray(sol.events.of(name)), crossings(exact, 0.5)
        assert len(found) == len(expected) and np.abs(found - expected).max() < 1e-8


def test_stop_stops_at_the_first_crossing_and_jumps_and_kinks_count_once():
    """The fast condition is constant up to 0.99 m, and ends the run at its first crossing."""
    events = [
        udk.Event(lambda t, at: jnp.sin(1000 * jnp.maximum(at["b"].x - 0.99, 0) + 0.1), name="end"),
        udk.Event(lambda t, at: jnp.where(at["b"].x > 0.4137, -1.0, 1.0), udk.Log(), name="jump"),
        udk.Event(lambda t, at: jnp.abs(jnp.sin(20 * at["b"].x)) - 0.01, udk.Log(), name="kink"),
    ]
    sol = udk.simulate(POINT, [0, 3.0], events=events)
    assert sol.result == udk.Result.event_stop and abs(float(sol.time) - (0.99 + (np.pi - 0.1) / 1000)) < 1e-12
    kinks = np.arange(0, 7) * np.pi / 20
    expected = np.sort(np.concatenate([kinks + np.arcsin(0.01) / 20, kinks[1:] - np.arcsin(0.01) / 20]))
    assert np.abs(sol.events.of("jump") - 0.4137).max() < 1e-12 and len(sol.events.of("jump")) == 1
    assert len(sol.events.of("kink")) == len(expected) and np.abs(sol.events.of("kink") - expected).max() < 1e-12


def test_a_condition_costs_no_step_and_an_event_few():
    """A pendulum logs where it passes and where it turns. Machine code runs once for each event."""
    pendulum = udk.Mechanism(
        {"link": udk.Body(1.0, 0.1, position=(0.5, 0.0))}, {"A": udk.Revolute(("ground", "link"), [[0, 0], [-0.5, 0]])}
    )
    events, ts = (lambda t, at: at["link"].x, lambda t, at: at["link"].omega), np.linspace(0, 8, 40)
    with calls_of(PhaseCode.run, PlainForm.__call__) as runs:
        found = udk.simulate(pendulum, ts, events=[udk.Event(condition, udk.Log()) for condition in events], max_events=60)
        assert found.events.count == 16 and [run.function for run in runs] == [PhaseCode.run] * 17
        never = udk.simulate(pendulum, ts, events=udk.Event(lambda t, at: at["link"].y - 3.0))
    plain = udk.simulate(pendulum, ts)
    assert len(runs) == 18 and np.array_equal(never.q, plain.q) and never.stats["steps"] == plain.stats["steps"]
    work = [int(sol.stats["right_hand_sides"]) for sol in (plain, never, found)]
    assert work[1] == work[0] and work[2] < work[0] + 16 * 60  # a step to the event, and the first ones behind it


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_events_at_nearly_the_same_time_all_happen(engine):
    """Six coordinates of a double pendulum pass their values at a time of the motion, together or each alone."""
    mechanism, ts = udk.library.double_pendulum(), np.linspace(0.2, 3.9, 25 if engine == "native" else 3)
    accurate = udk.simulate(mechanism, [0.0, *ts, 4.0], rtol=1e-9, atol=1e-9)
    names = [(body, coordinate) for body in mechanism.body_names for coordinate in ("x", "y", "angle")]

    def run(levels, chosen, engine: Any = "native"):
        events = [udk.Event(Level(levels[k], *names[k]), udk.Log()) for k in chosen]
        found = udk.simulate(mechanism, [0.0, 4.0], events=events, rtol=1e-7, atol=1e-7, engine=engine).events
        return jnp.sum(found.index[:, None] == np.arange(len(chosen)), axis=0)

    levels = accurate.q[1:-1].reshape(len(ts), -1)
    together = jax.vmap(lambda x: run(x, range(6), engine))(levels)
    for k in range(6):
        alone = jax.vmap(lambda x, k=k: run(x, [k]))(levels)[:, 0]
        np.testing.assert_array_equal(together[:, k], alone)


class Pulse(udk.ForceElement):
    """A force of the size a on a body near x = c, over a width w."""

    c: jax.Array
    a: float = eqx.field(static=True)
    w: float = eqx.field(static=True)

    def loads(self, t, *frames):
        return [(0.0, self.a * jnp.exp(-(((frames[0].x - self.c) / self.w) ** 2)), 0.0)]


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_crossing_is_exact_where_the_next_steps_are_short(engine):
    """A body moves with x = t towards a narrow pulse, and y = t before it crosses a line just before, within or after the pulse.

    With s = (t - c) / w and y'' = a exp(-s^2): y = t + a w^2 / 2 (sqrt(pi) s (1 + erf(s)) + exp(-s^2)).
    """
    a, w, line = -30.0, 0.01, 0.5
    body = udk.Body(1.0, 0.1, velocity=[1.0, 1.0])
    event = udk.Event(lambda t, at: at["b"].y - line, udk.Log(), 1)

    def run(c):
        scene = udk.Mechanism({"b": body}, forces={"pulse": Pulse(["b"], c, a, w)}, gravity=[0, 0])
        return udk.simulate(scene, [0.0, 0.8], events=event, rtol=1e-10, atol=1e-10, engine=engine).events

    def exact(c):
        def height(t):
            s = (t - c) / w
            return t + a * w**2 / 2 * (np.sqrt(np.pi) * s * (1 + erf(s)) + np.exp(-(s**2))) - line

        return brentq(height, 0.0, 0.8, xtol=1e-15)

    c = np.linspace(line - 2 * w, line + 15 * w, 101 if engine == "native" else 7)
    found = jax.vmap(run)(jnp.asarray(c))
    assert np.all(found.count == 1)
    np.testing.assert_allclose(found.q_before[:, 0, 0, 1], line, rtol=0, atol=1e-14)
    if engine == "native":  # a first long step of the other passes the whole pulse, and misses a part of it
        np.testing.assert_allclose(found.time[:, 0], [exact(x) for x in c], rtol=0, atol=1e-9)


def test_a_stiff_run_goes_on_implicitly_up_to_a_crossing():
    """An arm falls slowly against a strong damper: c angle' = -m g l cos(angle) / 2, sin(angle) = -tanh(m g l t / 2 c)."""
    mass, length, gravity, damping = 2.0, 1.0, 9.81, 1e6
    rod = udk.Body(mass, mass * length**2 / 12, position=[length / 2, 0.0])
    pin = udk.Revolute(["ground", "rod"], points=[[0.0, 0.0], [-length / 2, 0.0]])
    damper = udk.TorsionSpring(["ground", "rod"], 0.0, damping=damping)
    arm = udk.Mechanism({"rod": rod}, {"pin": pin}, forces={"damper": damper}, gravity=[0.0, -gravity])
    rate, aim = mass * gravity * length / (2 * damping), -0.05
    event = udk.Event(lambda t, body: body["rod"].angle - aim, udk.Stop(), name="e")
    end = np.arctanh(-np.sin(aim)) / rate
    run = udk.simulate(arm, [0.0, 2 * end], events=event, rtol=1e-7, atol=1e-9)
    without = udk.simulate(arm, [0.0, end], rtol=1e-7, atol=1e-9)
    assert float(run.time) == pytest.approx(end, rel=1e-6)
    assert without.stats["implicit"] > 10 and run.stats["steps"] <= without.stats["steps"] + 10


def test_what_is_too_fast_is_said():
    """A condition that changes its sign from each floating-point number to the next."""
    noise = udk.Event(lambda t, at: jnp.sin(1e13 * at["b"].x + 1.0) + 2 * jnp.sin(3e12 * at["b"].x), udk.Log(), name="noise")
    with pytest.warns(
        UserWarning, match='vary too quickly for the shortest window, 1e-9 T; crossings may be missed: "noise" from 0 s'
    ):
        sol = udk.simulate(POINT, [0, 1.0], events=noise, max_events=5, throw=False)
    assert sol.events.unresolved[0] < 1e-6


class RootOf(eqx.Module):
    """The condition 1 + sqrt(end - x), which is NaN for x > end."""

    end: jax.Array

    def __call__(self, t, at):
        return 1 + jnp.sqrt(self.end - at["b"].x)


def quarter(t, at):
    return at["b"].x - 0.25


def rooted(x, engine: Any = "native"):
    """A run with a condition that is NaN above a value of x."""
    events = [udk.Event(RootOf(x), udk.Log(), name="root"), udk.Event(quarter, udk.Log(), name="quarter")]
    return udk.simulate(POINT, [0, 0.3, 1.0], events=events, max_events=4, throw=False, engine=engine)


def test_a_condition_that_is_not_a_number_is_named():
    cause = 'undefined condition at t = 0.5 s: the condition of event "root" is not a number'
    assert rooted(0.5).cause.startswith(cause) and rooted(2.0).result == udk.Result.successful


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "jax"])
def test_a_condition_that_is_not_a_number_is_data_in_a_batch(engine):
    where = np.array([0.5, 2.0, -0.1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sol = jax.jit(jax.vmap(lambda x: rooted(x, engine)))(where)
    codes = [udk.Result.undefined_condition, udk.Result.successful, udk.Result.undefined_condition]
    assert (np.asarray(sol.code) == codes).all() and np.abs(sol.time - np.array([0.5, 1.0, 0.0])).max() < 1e-8
    assert (np.asarray(sol.events.count) == [1, 1, 0]).all() and (
        np.asarray(sol.events.undefined) == [[1, 0], [0, 0], [1, 0]]
    ).all()
    assert np.isfinite(sol.q[0, :2]).all() and np.isnan(sol.q[0, 2]).all()


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_an_event_at_a_sample_or_an_output_happens_once(engine):
    """Its root is found to machine precision. From a state just before it, the condition would cross again."""
    held = udk.Held(np.random.default_rng(0).normal(size=(4, 2)), 0.25)
    body = udk.Mechanism({"b": udk.Body(1.0, 0.1)}, forces={"u": udk.Force("b", held)})
    for output in ([], [0.5]):
        clock = udk.Event(lambda t, at: t - 0.5, udk.Log(), 1, name="clock")
        found = udk.simulate(body, [0.0, *output, 1.0], events=[clock], engine=engine).events
        assert np.asarray(found.time).tolist() == pytest.approx([0.5], abs=1e-15)


def test_a_wall_at_a_sample_is_hit_once():
    held = udk.Held(np.arange(4.0)[:, None] * [0.0, 1.0], 0.25)
    body = udk.Mechanism({"b": udk.Body(1.0, 0.1, velocity=[1.0, 0.0])}, forces={"u": udk.Force("b", held)})
    wall = udk.Event(lambda t, at: 0.25 - at["b"].x, udk.Impact(1.0), name="wall")
    run = udk.simulate(body, [0.0, 0.5], events=[wall])
    assert int(run.events.count) == 1
    np.testing.assert_allclose(run.q[-1, 0, 0], 0.0, atol=1e-14)


def test_an_event_just_before_a_sample_happens_with_the_force_before_it():
    """The step that ends at the event must not take the next row of samples."""
    held = udk.Held(np.array([1.0, -20.0])[:, None] * [1.0, 0.0], 0.25)
    body = udk.Mechanism({"b": udk.Body(1.0, 0.1)}, forces={"u": udk.Force("b", held)})
    for time in (0.2, 0.249, 0.25 - 1e-9):
        place = udk.Event(lambda t, at, x=0.5 * time**2: at["b"].x - x, udk.Stop(), name="place")
        assert float(udk.simulate(body, [0.0, 0.5], events=[place]).time) == pytest.approx(time, abs=1e-13)


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_events_within_a_step_that_reaches_a_sample(engine):
    """Just after the start or another event, the first step may reach it; at 1 s, the last step ends there."""
    held = udk.Held(np.array([1.0, -5.0, 0.5])[:, None] * [1.0, 0.0], 0.5)
    body = udk.Mechanism({"b": udk.Body(1.0, 0.1)}, forces={"u": udk.Force("b", held)}, gravity=[0.0, 0.0])
    stops = udk.Event(lambda t, at: at["b"].vx, udk.Log(), name="stops")

    def times(velocity, start, end):
        state = udk.State(jnp.zeros((1, 3)), jnp.zeros((1, 3)).at[0, 0].set(velocity))
        run = udk.simulate(body, jnp.stack([start, end]), state, events=stops, max_events=3, engine=engine)
        return run.events.time, run.stats["rejected"]

    rates = jax.jit(jax.jacfwd(lambda *x: times(*x)[0][:2]))
    for start, before in ((0.0, 0.25), (0.25, 0.125), (0.4375, 0.03125), (0.499, 0.0004), (0.4999999, 1e-9)):
        for end in (0.625, 1.0, 1.375):
            found, rejected = times(-before, start, end)
            expected = [start + before, 0.5 + (0.5 - start - before) / 5.0]
            np.testing.assert_allclose(
                found, expected, rtol=0.0, atol=1e-13
            )  # rounding of interpolation: 1e-14 on some processors
            assert int(rejected) == 0
            np.testing.assert_allclose(rates(-before, start, end), [-1.0, 0.2], atol=1e-12)


def test_a_run_that_ends_before_a_sample():
    """No step may end a little before another sample: interpolation through close points would amplify rounding errors."""
    values, dt, velocity = np.array([1.82, 7.62, -2.68]), 0.25, -0.217
    held = udk.Held(values[:, None] * [1.0, 0.0], dt)
    body = udk.Mechanism({"b": udk.Body(1.0, 0.1)}, forces={"u": udk.Force("b", held)}, gravity=[0.0, 0.0])
    state = udk.State(np.zeros((1, 3)), [[velocity, 0.0, 0.0]])
    slow = udk.Event(lambda t, at: at["b"].vx + 0.306, udk.Log(), name="slow")
    for before, dt0 in product((1e-3, 1e-4, 1e-5), (0.006, 0.04, 0.07, 0.2)):  # these lead to such steps
        run = udk.simulate(body, [0.0, 0.75 - before], state, rtol=1e-10, atol=1e-10, dt0=dt0, events=slow)
        assert int(run.events.count) == 0
        np.testing.assert_allclose(run.v[-1, 0, 0], velocity + values @ [dt, dt, dt - before], rtol=1e-12)


def test_events_just_before_the_end_happen_once():
    """In a step of a nanosecond, velocities follow from velocities and accelerations: positions are rounded too coarsely."""
    body = udk.Mechanism({"b": udk.Body(1.0, 0.1)}, forces={"u": udk.Force("b", [1.0, 0.0])}, gravity=[0.0, 0.0])
    stops = udk.Event(lambda t, at: at["b"].vx, udk.Log(), name="stops")

    def times(place, velocity, rest):
        state = udk.State(jnp.zeros((1, 3)).at[0, 0].set(place), jnp.zeros((1, 3)).at[0, 0].set(velocity))
        run = udk.simulate(body, jnp.stack([0.0, -jax.lax.stop_gradient(velocity) + rest]), state, events=stops, max_events=3)
        return run.events.time, run.events.count

    run = jax.jit(times)
    for place in (0.0, 0.7, -1.3):
        for velocity in (-0.3, -0.6, -1.1):
            for rest in (1e-7, 1e-9, 1e-11):
                found, count = run(place, velocity, rest)
                assert int(count) == 1
                np.testing.assert_allclose(found[0], -velocity, rtol=0.0, atol=1e-14)


def test_an_event_just_after_a_start_at_a_sample():
    """The first node is at the state behind the sample, or an event in the first interval would be bisected."""
    held = udk.Held(np.array([9.0, 1.0, 5.0])[:, None] * [1.0, 0.0], 0.5)
    guide = udk.Prismatic(["ground", "b"], [[0.0, 0.0], [0.0, 0.0]], axis=0.0)
    rub, g, mu = udk.Friction("guide", coefficient=0.25, law="set-valued"), 9.81, 0.25
    forces = {"u": udk.Force("b", held), "f": rub}
    block = udk.Mechanism({"b": udk.Body(1.0, 0.1)}, {"guide": guide}, forces=forces, gravity=[0.0, -g])
    rest = udk.State(np.zeros((1, 3)), np.zeros((1, 3)))
    for time in (0.5001, 0.51, 0.53):
        tick = udk.Event(lambda t, at, time=time: t - time, udk.Log(), name="tick")
        run = udk.simulate(block, [0.5, 1.5], rest, events=tick)
        np.testing.assert_allclose(run.events.time, [time, 1.0], rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(run.v[-1, 0, 0], (5.0 - mu * g) * 0.5, rtol=1e-12)
        assert int(run.stats["steps"]) < 30


class Step(udk.ForceElement):
    """A force that jumps at x = 0."""

    def loads(self, t, *frames):
        return [(jnp.where(frames[0].x > 0.0, -3.0, 0.0), 0.0, 0.0)]


def test_a_jump_of_a_force_just_after_a_start_at_a_sample():
    held = udk.Held(np.array([9.0, 1.0, 5.0])[:, None] * [1.0, 0.0], 0.5)
    body = udk.Mechanism({"b": udk.Body(1.0, 0.1)}, forces={"u": udk.Force("b", held), "s": Step("b")}, gravity=[0.0, 0.0])
    for time in (1e-4, 1e-2, 5e-2):
        place = -(2.0 * time + 0.5 * time**2)
        run = udk.simulate(body, [0.5, 1.0], udk.State([[place, 0.0, 0.0]], [[2.0, 0.0, 0.0]]))
        np.testing.assert_allclose(run.v[-1, 0, 0], 2.0 + time - 2.0 * (0.5 - time), rtol=1e-12)
        assert np.isinf(run.unlocated) and int(run.stats["rejected"]) == 0


class Lift(udk.ForceElement):
    """A force that grows with time, and jumps at x = 0.2 m."""

    def loads(self, t, *frames):
        return [(jnp.where(frames[0].x > 0.2, -0.5, 0.0), 20.0 * t, 0.0)]


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_contact_opens_in_a_scene_with_a_jump(engine):
    """The opening of a contact is no event of the list: it turns no side of a comparison."""
    body = udk.Mechanism({"b": udk.Body(1.0, 0.1, velocity=[1.0, -0.1])}, forces={"lift": Lift("b")}, gravity=[0.0, -10.0])
    run = udk.simulate(body, [0.0, 1.0], events=udk.Contact("b"), engine=engine)
    np.testing.assert_allclose(run.q[-1, 0, :2], [1.0 - 0.25 * 0.8**2, 10 / 3 * 0.5**3], rtol=1e-9)


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_contact_opens_at_a_sample_with_a_constant_force(engine):
    """Two bars turn together at the limit of their joint until the torque on it ends: the force of the limit jumps through zero.

    It is then constant up to rounding, which must not count as too quick a change: energy is kept from there on, in few steps.
    """
    ends = {"a": (0.5, 0.0), "b": (-0.5, 0.0)}
    q = np.array([[0.0, 0.0, 0.3], [0.5 * (np.cos(0.3) + np.cos(0.7)), 0.5 * (np.sin(0.3) + np.sin(0.7)), 0.7]])
    v = 1.5 * np.stack([-q[:, 1], q[:, 0], np.ones(2)], axis=1)
    bars = udk.Mechanism(
        {name: udk.Body(1.0, 0.1) for name in ends},
        {"h": udk.Revolute(("a", "b"), list(ends.values()))},
        forces={"u": udk.Torque(("a", "b"), udk.Held(np.array([2.0, 0.0]), 0.2))},
        gravity=[0.0, 0.0],
    )
    limit = udk.JointLimit("h", upper=0.4)
    run = udk.simulate(bars, [0.0, 0.19, 0.4], udk.State(q, v), rtol=1e-10, atol=1e-10, events=limit, engine=engine)
    np.testing.assert_allclose(run.events.time[1], 0.2, rtol=1e-12)
    energy = np.sum(np.array([1.0, 1.0, 0.1]) * np.asarray(run.v) ** 2, axis=(1, 2)) / 2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)
    assert np.diff(run.q[:, :, 2])[-1, 0] < 0.37
    assert engine == "jax" or (int(run.stats["steps"]) < 40 and int(run.stats["projections"]) < 60)
