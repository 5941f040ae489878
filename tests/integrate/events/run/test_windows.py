"""Runs whose conditions machine code cannot resolve between crossings go on window by window, by machine code and NumPy."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false
# All of these runs have events.
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from experiments.parts.random_scenes import build, random_scene, state_of
from tests.calls import Call, calls_of
from tests.choices import fast
from tests.integrate.events.instant.test_sticking import Bumper, belt, block, oscillator, sticking
from tests.integrate.motions.test_redundant_friction import doubled
from udkjax.integrate.events.run.host_run import PlainForm
from udkjax.integrate.events.run.machine_system import MachineSystem
from udkjax.integrate.events.run.plain_system import run_plain

TOL: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-10}


@pytest.fixture
def windows() -> Iterator[list[Call]]:
    """Note the windows of a run, which may not take the plain form."""
    with calls_of(MachineSystem._advance_window, PlainForm.__call__, run_plain) as calls:
        yield calls
    assert all(call.function is MachineSystem._advance_window for call in calls), "the run has left machine code"


@pytest.fixture
def from_the_start(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function after whose call all runs go by windows from their start."""

    def change():
        begin = MachineSystem.__init__

        def begin_by_windows(system: MachineSystem, *given: Any):
            begin(system, *given)
            system.go_on_by_windows(np.arange(len(system.ts)), system.ts[:, 0])

        monkeypatch.setattr(MachineSystem, "__init__", begin_by_windows)

    return change


def noise(t: Any, at: Any) -> Any:
    """Return a condition that changes its sign from each floating-point number to the next."""
    return jnp.sin(1e13 * at["b"].x + 1.0) + 2 * jnp.sin(3e12 * at["b"].x)


def test_a_condition_that_is_too_fast_does_not_leave_machine_code(windows):
    point = udk.Mechanism({"b": udk.Body(1.0, 0.1, velocity=[1.0, 0])}, gravity=[0, 0])
    events = udk.Event(noise, udk.Log(), name="noise")

    def run(mechanism: udk.Mechanism) -> udk.Solution:
        return udk.simulate(mechanism, [0, 0.5, 1.0], events=events, max_events=5, throw=False)

    in_jit = eqx.filter_jit(run)(point)
    with pytest.warns(UserWarning, match='"noise" from 0 s'):
        found = run(point)
    assert windows and found.result == in_jit.result == udk.Result.successful
    assert in_jit.events.count == found.events.count
    np.testing.assert_array_equal(in_jit.q, found.q)


@pytest.mark.parametrize("coefficient", [0.2, 0.5])
def test_pins_that_chatter_at_a_stiff_bumper_do_not_leave_machine_code(windows, coefficient):
    """Weak pins may stick and slip faster than time resolves, until the bumper has come to rest with the rod on it.

    Rounding decides whether they do, and so whether there are windows; other tests force them.
    """
    along = np.sqrt(1 - 0.2**2)
    bodies = {
        "rod": udk.Body(1.0, 1 / 12, position=[0.5 * along, -0.1], angle=np.arcsin(-0.2)),
        "tip": udk.Body(0.5, 0.01, position=[along, -0.2]),
    }
    joints = {
        "A": udk.Revolute(["ground", "rod"], [[0.0, 0.0], [-0.5, 0.0]]),
        "B": udk.Revolute(["rod", "tip"], [[0.5, 0.0], [0.0, 0.0]]),
    }
    rubs = {name: udk.Friction(name, coefficient=coefficient, radius=0.3, law="set-valued") for name in joints}
    bumper = Bumper(["tip"], 1e7, jnp.asarray(1e3))
    run = udk.simulate(udk.Mechanism(bodies, joints, forces={**rubs, "bumper": bumper}), [0.0, 4.0])
    assert run.settings["engine"] == "native" and all(call.arguments["runs"].t.max() <= 4.0 for call in windows)
    assert run.sticking["A"][-1] and run.sticking["B"][-1] and np.abs(run.v[-1]).max() < 1e-9
    # About the pin, with the arm sqrt(1 - 0.3^2) m of the bumper: its force less the weights, at most mu r |R|.
    force, weight, arm = 1e7 * max(-0.3 - run.q[-1, 1, 1], 0.0), 9.81 * 1.5, np.cos(run.q[-1, 0, 2])
    assert abs(arm * (force - 9.81 * 1.0)) <= coefficient * 0.3 * abs(weight - force) * (1 + 1e-3)


SCENES = {
    "oscillator": lambda: (oscillator(0.4), {}),
    "redundant": lambda: (doubled(oscillator(0.4)), {}),
    "block": lambda: (block(0.3, 1.0, coefficient=0.5), {}),
    "belt": lambda: (belt(0.4, 0.3, 100.0, 1.0, 0.2), {}),
    "four-bar": lambda: (sticking(udk.library.four_bar()), {}),
    "bounces": lambda: (
        udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=[0.0, 0.3], velocity=[0.4, 0.0])}),
        {"events": udk.Contact("ball", restitution=0.6)},
    ),
}


@pytest.mark.parametrize("name", fast(["block", "bounces"], SCENES))
def test_runs_by_windows_are_those_between_crossings(name, windows, from_the_start):
    (mechanism, more), ts = SCENES[name](), np.linspace(0.0, 2.0, 41)
    expected = udk.simulate(mechanism, ts, **TOL, **more)
    assert not windows and len(expected.events.time)
    from_the_start()
    found = udk.simulate(mechanism, ts, **TOL, **more)
    assert windows
    np.testing.assert_allclose(found.q, expected.q, atol=1e-7)
    for joint, sticks in (expected.sticking or {}).items():
        np.testing.assert_array_equal(found.sticking[joint], sticks)
    np.testing.assert_allclose(found.events.time, expected.events.time, atol=1e-7)


def test_a_crossing_within_rounding_errors_is_found_once(windows, from_the_start):
    """The angular velocity of a body falls through the level so slowly that rounding hides the crossing."""
    scene = random_scene(23, 72, 0, bodies=(2, 5))
    mechanism, (q, v), end = build(scene.table), state_of(scene.table), 6 * float(scene.time)
    body = mechanism.body_names[0]
    event = udk.Event(lambda t, at: at[body].omega + 0.014683922117060901, udk.Log())

    def run() -> udk.Solution:
        return udk.simulate(mechanism, [0.0, end], udk.State(q, v), events=event, rtol=1e-7, atol=1e-7, max_steps=3000)

    expected = run()
    from_the_start()
    found = run()
    assert windows and found.events.count == expected.events.count == 2
    np.testing.assert_allclose(found.events.time, expected.events.time, rtol=0, atol=1e-7 * end)


def test_contacts_at_rest_beside_stiff_dampers_need_no_windows(windows: list[Call]):
    """Velocities within the tolerance times a damping of 2e7 N m s are torques much larger than the force of the contact."""
    bodies = {
        "lower": udk.Body(1.56, 0.166, (0.10615263197169834, 0.5132920240034046), 1.3822542012872183),
        "middle": udk.Body(0.744, 0.143, (0.21319123686581543, 1.0437507751312538), 1.606283282431972),
        "upper": udk.Body(0.833, 0.0218, (0.7372926695745062, 1.4257170881110792), 0.0),
    }
    joints = {
        "foot": udk.Revolute(("ground", "lower"), ((0.0, 0.0), (-0.524, 0.008))),
        "knee": udk.Revolute(("lower", "middle"), ((0.363, -0.133), (-0.202, -0.085))),
        "hip": udk.Revolute(("middle", "upper"), ((0.28, -0.067), (-0.467, -0.101))),
    }
    forces = {
        "spring": udk.Spring(("ground", "lower"), ((1.345, -1.026), (-0.023, -0.285)), stiffness=270.0, length=0.22),
        "damper": udk.TorsionSpring(("ground", "upper"), stiffness=0.0, damping=2e7),
    }
    wall = udk.Contact("lower", (-0.16, 0.073), (0.0, 0.158), (0.0, 1.0), restitution=0.0)
    mechanism = udk.Mechanism(bodies, joints, forces=forces)
    run, exact = (
        udk.simulate(mechanism, [0.0, 0.2, 0.4], rtol=tol, atol=tol, events=[wall], max_steps=2000) for tol in (1e-6, 1e-10)
    )
    assert [run.events.count, exact.events.count, windows] == [2, 2, []]
    assert np.abs(run.q - exact.q).max() < 1e-4


@pytest.mark.parametrize(("rtol", "atol"), [(1e-8, 1e-8), (1e-11, 1e-11), (0.0, 1e-8)])
def test_tolerances_beside_stiff_dampers_are_tightened_as_far_as_rounding_allows(rtol: float, atol: float, windows: list[Call]):
    """A joint at its limit beside a damper of 7.7e7 N m s holds at tolerances of 1e-12, and seemed to let go at 1e-11."""
    bodies = {
        "lower": udk.Body(0.321, 0.143, (-0.222, 0.373), 2.2617, (-0.19, -0.113), 0.509),
        "middle": udk.Body(1.861, 0.164, (-0.765, 0.792), 2.9428, (-0.381, -0.023), -0.368),
        "upper": udk.Body(1.579, 0.191, (-0.92, 0.799), -0.0232, (-0.346, 0.131), 0.129),
    }
    joints = {
        "foot": udk.Revolute(("ground", "lower"), ((0.0, 0.0), (-0.429, 0.067))),
        "knee": udk.Revolute(("lower", "middle"), ((0.383, -0.154), (-0.414, -0.058))),
        "hip": udk.Revolute(("middle", "upper"), ((0.359, -0.003), (-0.198, 0.063))),
    }
    damper = udk.TorsionSpring(("lower", "middle"), stiffness=5.0, angle=0.681, damping=7.7e7)
    mechanism = udk.Mechanism(bodies, joints, forces={"damper": damper})
    limit = udk.JointLimit("foot", lower=1.463, upper=2.768, restitution=0.0)
    run = udk.simulate(mechanism, [0.0, 0.8], rtol=rtol, atol=atol, events=[limit], max_steps=2000)
    assert [run.events.count, windows] == [2, []]
