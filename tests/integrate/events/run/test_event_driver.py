"""Batches with events by machine code, compared with their plain form and the textbook equations."""

# pyright: reportOptionalMemberAccess=false
# All of these runs have events.
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.events.event_scenes import BALL, CATCH, CAUGHT, PENDULUM, G
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.states.textbook import prepare
from udkjax.integrate.compiled_mechanism import compile_concrete
from udkjax.integrate.events import simulate_events
from udkjax.integrate.events.instant.impacts import contact_rows, rows_of_directions
from udkjax.integrate.events.instant.runs import RunState
from udkjax.integrate.events.law.actions import Action
from udkjax.integrate.events.law.conditions import frames_of
from udkjax.integrate.events.law.event import expand_events
from udkjax.integrate.events.law.phases import phases_of
from udkjax.integrate.events.run.condition_program import watched_conditions
from udkjax.integrate.events.run.host_run import concrete_plan, event_arrays
from udkjax.integrate.events.run.phase_code import PhaseCode
from udkjax.integrate.prepare import Choices, prepare_run
from udkjax.integrate.projection import Projection
from udkjax.pinv import SVD

BOX = udk.Mechanism({"box": udk.Body(1.0, 0.1, position=(0.1, 0.6), angle=0.2)})
FEET = [udk.Contact("box", point=[x, -0.2], restitution=0.3, name=f"foot{x}") for x in (-0.5, 0.5)]
LIMITS = [
    udk.JointLimit("A", lower=-2.5, restitution=0.6, name="limit"),
    udk.Event(lambda t, at: at["link"].omega, udk.Log(), name="turn"),
    udk.Event(lambda t, at: at["link"].x - 0.2, udk.Log(), 1, name="passes"),
]
LOCKS = [
    udk.Event(lambda t, at: at["link"].angle + 1.0, udk.Lock("A"), -1, name="lock"),
    udk.Event(lambda t, at: t - 0.9, udk.Release("A.lock"), name="free"),
    udk.Contact("link", point=[0.5, 0], through=[0, -0.9], restitution=0.5, name="floor"),
]


class ChangeEnds(Action):
    """Pin the free end of the pendulum where it is at the vertical, and release its other pin."""

    adds = True

    @property
    def removed(self):
        return frozenset(["A"])

    def addition(self, mechanism, where):
        return "B", udk.Revolute(("ground", "link"), [[0, -1], [0.5, 0]])


CHANGE = [udk.Event(lambda t, at: at["link"].angle + np.pi / 2, ChangeEnds(), -1, name="change")]
FIVE_BAR = udk.library.parallelogram()
STOPS = [udk.JointLimit(next(iter(FIVE_BAR.joints)), lower=-2.0, restitution=0.6)]


@pytest.mark.parametrize(
    ("mechanism", "events", "end"),
    [
        pytest.param(PENDULUM, LIMITS, 2.0, id="limits", marks=pytest.mark.slow),
        pytest.param(CATCH, CAUGHT, 0.8, id="catch", marks=pytest.mark.slow),
        pytest.param(BOX, FEET, 0.41, id="box", marks=pytest.mark.slow),
        pytest.param(PENDULUM, [*CHANGE, *LIMITS[1:]], 0.8, id="change"),
        pytest.param(PENDULUM, LOCKS, 1.5, id="locks", marks=pytest.mark.slow),
        pytest.param(FIVE_BAR, STOPS, 3.0, id="redundant", marks=pytest.mark.slow),
    ],
)
def test_machine_code_does_what_the_plain_form_does(mechanism, events, end, monkeypatch):
    ts = np.linspace(0.0, end, 9)
    fast = udk.simulate(mechanism, ts, events=events, rtol=1e-10, atol=1e-10, max_events=60)
    monkeypatch.setattr(simulate_events, "watched_conditions", lambda *given: None)
    plain = udk.simulate(mechanism, ts, events=events, rtol=1e-10, atol=1e-10, max_events=60)
    assert fast.events.count == plain.events.count > 1 and (fast.events.index == plain.events.index).all()
    assert np.abs(fast.events.time - plain.events.time).max() < 1e-8
    assert np.abs(fast.events.v_after - plain.events.v_after).max() < 1e-6
    assert fast.result == plain.result and np.abs(fast.q - plain.q).max() < 1e-7


def test_an_action_of_ones_own_is_a_class():
    """When the pendulum changes ends, it keeps its angular momentum about the new pin: (0.1 - 0.25) w = (0.1 + 0.25) w'."""
    found = udk.simulate(PENDULUM, np.linspace(0.0, 0.6, 4), events=CHANGE, rtol=1e-10, atol=1e-10)
    before, after = found.events.v_before[0, 0], found.events.v_after[0, 0]
    assert found.events.count == 1 and np.abs(before[2] + np.sqrt(G / 0.35)) < 1e-8
    assert np.abs(after[2] + 0.15 / 0.35 * before[2]) < 1e-8
    tip = found.q[-1, 0, :2] + 0.5 * np.array([np.cos(found.q[-1, 0, 2]), np.sin(found.q[-1, 0, 2])])
    assert np.abs(tip - np.array([0.0, -1.0])).max() < 1e-9


class Bumper(Action):
    """An impact on a rubber pad: its restitution is that of the material, to the power 1 + thickness."""

    material: jax.Array = eqx.field(converter=jnp.asarray)
    thickness: jax.Array = eqx.field(converter=jnp.asarray)

    is_impact = True
    needs_joints = False

    @property
    def rebound(self):
        return self.material ** (1 + self.thickness)


@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_an_action_of_ones_own_has_numbers(jacobian):
    """A ball dropped from 1 m meets the floor at t = (2/g)^(1/2), and leaves it with e times its speed; so do its derivatives."""

    def height(numbers):
        bumper = udk.Event(lambda t, at: at["ball"].y, Bumper(*numbers), name="bumper")
        return udk.simulate(BALL, np.array([0.0, 0.6]), events=bumper, rtol=1e-11, atol=1e-11).q[-1, 0, 1]

    def exact(numbers):
        meets = np.sqrt(2 / G)
        return numbers[0] ** (1 + numbers[1]) * G * meets * (0.6 - meets) - G * (0.6 - meets) ** 2 / 2

    numbers = jnp.array([0.8, 0.5])
    assert_allclose(height(numbers), exact(numbers), atol=1e-9)
    assert_allclose(jacobian(height)(numbers), jax.jacfwd(exact)(numbers), atol=1e-8)


@pytest.mark.slow
def test_members_of_a_batch_run_as_they_do_alone():
    """Some balls come to rest after a few bounces, others do not, and one starts below the floor."""
    ts, given = np.linspace(0, 2.0, 9), np.array([[0.2, 1.0], [0.9, 1.0], [0.5, 0.3], [0.5, -1.0], [1.2, 1.0]])

    def run(x):
        ball = BALL.with_parameters({"body.ball.position": jnp.stack([jnp.zeros(()), x[1]])})
        return udk.simulate(ball, ts, events=udk.Contact("ball", restitution=x[0]), throw=False, max_events=20)

    together = jax.jit(jax.vmap(run))(given)
    codes = [udk.Result.successful] * 3 + [udk.Result.beyond_contact, udk.Result.invalid_argument]
    assert (np.asarray(together.code) == codes).all()
    for k, x in enumerate(given[:4]):
        alone = jax.jit(run)(x)
        assert together.events.count[k] == alone.events.count and (together.events.index[k] == alone.events.index).all()
        for one, other in (
            (together.q[k], alone.q),
            (together.events.time[k], alone.events.time),
            (together.time[k], alone.time),
        ):
            np.testing.assert_allclose(one, other, atol=1e-9)


def phase_codes(mechanism, events):
    """The machine code of all phases of a mechanism with events, for single runs and for a batch of masses."""
    with jax.ensure_compile_time_eval():
        listed = expand_events(events, mechanism)
        phases = phases_of(mechanism, listed, analyse(mechanism))
        choices = Choices(1e-8, 1e-8, 1e-6, None, udk.Auto(), Projection())
        scenes = zip(phases.mechanisms, phases.analyses, strict=True)
        compiled = [compile_concrete(m, a, *choices.of_mechanism) for m, a in scenes]
        state = udk.State(mechanism.q0, mechanism.v0)
        run = prepare_run(compiled[0], phases.analyses[0], np.array([0.0, 1.0]), state, None, choices, np)
        conditions = watched_conditions(listed, mechanism)
        assert conditions is not None
        plan = concrete_plan(phases, conditions, 1000, 10, *listed, *compiled)
        problems = [replace(run.problem, compiled=x) for x in compiled]
        arrays = event_arrays(plan, listed, phases, problems, np.zeros(()), np.asarray(1e-6), np)
    numbers, inverse_mass, rest, codes = arrays[5], arrays[7], arrays[9:], []
    widths = [*(len(joint.program.outputs) for joint in plan.added), plan.events.side_count]
    joints = np.full((3, sum(widths)), np.nan)
    for of_phase in plan.phases:
        codes.append(PhaseCode(of_phase, phases.switches, rest[: of_phase.count], numbers, inverse_mass, joints, widths))
        rest = rest[of_phase.count :]
    return codes, inverse_mass


@pytest.mark.slow
def test_machine_code_knows_of_states_what_the_textbook_does():
    """Accelerations, conditions with their rates and derivatives, and the effect of impulses, at several states."""
    mechanism, events = FIVE_BAR, [*STOPS, udk.Event(lambda t, at: at[FIVE_BAR.body_names[1]].omega * t, udk.Log(), name="turn")]
    (code, *_), inverse_mass = phase_codes(mechanism, events)
    listed, names = expand_events(events, mechanism), mechanism.body_names
    start = udk.assemble(mechanism)
    moved = udk.simulate(mechanism, [0.0, 0.3, 0.7, 1.1], start)
    t, q, v = np.array([0.3, 0.7, 1.1]), np.asarray(moved.q)[1:].reshape(3, -1), np.asarray(moved.v)[1:].reshape(3, -1)
    found = code.at(np.arange(3), RunState(t, q, v, np.zeros((3, 1), bool), []))
    textbook = prepare(mechanism, SVD(), None, analyse(mechanism))

    def conditions(t, q, v):
        frames = frames_of(names, q, v)
        return jnp.stack([jnp.asarray(e.condition(t, frames), float) for e in listed])

    def along(f, t, q, v, a):
        return jax.jvp(f, (t, q, v), (1.0, v, a))[1]

    def rates(t, q, v):
        return along(conditions, t, q, v, jnp.zeros_like(v))

    for k in range(3):
        a = textbook.accelerations(t[k], q[k], v[k])
        assert np.abs(found.a[k] - a).max() < 1e-10
        assert np.abs(found.g[k] - conditions(t[k], q[k], v[k])).max() < 1e-13
        assert np.abs(found.rate[k] - along(conditions, t[k], q[k], v[k], a)).max() < 1e-9
        second = along(rates, t[k], q[k], v[k], a)
        assert abs(found.rate_2[k, 0] - second[0]) < 1e-9 and found.rate_2[k, 1] == 0
        slopes = jax.jacfwd(conditions, (0, 1, 2))(t[k], q[k], v[k])
        for one, other in zip((found.by_t, found.by_q, found.by_v), slopes, strict=True):
            assert np.abs(one[k] - other).max() < 1e-12
        rows = rows_of_directions(found.by_q[k], found.directions[k], inverse_mass[0])
        expected = contact_rows(textbook, t[k], q[k], slopes[1])
        assert abs(rows.W[0, 0] - expected.W[0, 0]) < 1e-12 * expected.W[0, 0] and rows.free[0]
        assert np.abs(rows.directions[0] - expected.directions[0]).max() < 1e-12


def test_the_force_of_a_contact_at_rest_ends_its_rest():
    """A point pushed from the top of a dome leaves it where the contact would have to pull: where g cos = v^2 / r."""
    radius, push = 1.2, 0.3
    ball = udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=(0.0, radius), velocity=(push, 0.0))})
    dome = udk.Event(lambda t, at: jnp.hypot(at["ball"].x, at["ball"].y) - radius, udk.Impact(0.0), name="dome")
    sol = udk.simulate(ball, np.linspace(0, 1.5, 4), events=dome, rtol=1e-11, atol=1e-11)
    assert sol.settings["engine"] == "native" and [int(k) for k in sol.events.index] == [2, 1]  # it rests, and lets go
    x, y = np.asarray(sol.events.q_before)[1, 0, :2]
    speed = np.asarray(sol.events.v_before)[1, 0, :2]
    assert abs(np.hypot(x, y) - radius) < 1e-10 and abs(9.81 * y - speed @ speed) < 1e-7
    assert abs(y / radius - (2 / 3 + push**2 / (3 * 9.81 * radius))) < 1e-8
