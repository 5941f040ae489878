"""The default method notices stiffness and goes on implicitly; where nothing is stiff, it is what it was."""

from dataclasses import replace
from importlib import import_module

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.choices import fast
from tests.native.test_implicit_stages import TS, assert_motion_is_that_by_radau, by_radau, damped
from tests.ten_times import multiplied


def run(mechanism, tol=1e-6, ts=TS, **choices):
    return udk.simulate(mechanism, ts, rtol=tol, atol=tol, **choices)


@pytest.mark.parametrize("damping", fast([1e5, 1e9], [10.0, 1e5, 1e7, 1e9]))
def test_stiff_dampers(damping):
    """Explicitly, 1e5 would take ten thousand steps, and 1e9 end at the limit of steps."""
    solution = run(damped(damping))
    assert_motion_is_that_by_radau(solution, damping)
    assert solution.settings["solver"] == "Dopri8" and solution.settings["stiff_solver"] == "Kvaerno5"
    assert int(solution.stats["steps"]) < 120
    assert (int(solution.stats["implicit"]) > 3) == (damping > 100)


class Bushing(udk.ForceElement):
    """A spring (N/m) and a damper (N s/m) between the coupler of a parallelogram and the end of a link."""

    stiffness: jax.Array
    damping: jax.Array

    def loads(self, t, *frames):
        ends = [frame.point(p) for frame, p in zip(frames, ((-1.0, 0.0), (0.5, 0.0)), strict=True)]
        rates = [frame.velocity(p) for frame, p in zip(frames, ((-1.0, 0.0), (0.5, 0.0)), strict=True)]
        arms = [frame.vector(p) for frame, p in zip(frames, ((-1.0, 0.0), (0.5, 0.0)), strict=True)]
        x = self.stiffness * (ends[0].x - ends[1].x) + self.damping * (rates[0].x - rates[1].x)
        y = self.stiffness * (ends[0].y - ends[1].y) + self.damping * (rates[0].y - rates[1].y)
        return [(s * x, s * y, s * (arm.x * y - arm.y * x)) for s, arm in zip((-1, 1), arms, strict=True)]


@pytest.mark.parametrize("damping", [0.0, pytest.param(10.0, marks=pytest.mark.slow), pytest.param(1e4, marks=pytest.mark.slow)])
def test_a_stiff_spring_in_place_of_a_pin(damping):
    """Its vibration, which an explicit method leaves at the size of the tolerance, does not keep the run from going on."""
    scene, ts = udk.library.parallelogram(), np.linspace(0.0, 2.0, 3)
    joints = {name: joint for name, joint in scene.joints.items() if name != "B1"}
    spring = Bushing(["coupler", "link1"], jnp.array(1e9), jnp.array(damping))
    mechanism = udk.Mechanism(scene.bodies, joints, forces={"spring": spring}, gravity=scene.gravity)
    solution, pinned = run(mechanism, 1e-4, ts), run(scene, 1e-8, ts)
    assert int(solution.stats["steps"]) < 300 and int(solution.stats["implicit"]) > 50
    assert_allclose(solution.q, pinned.q, atol=3e-4)


def test_a_run_with_events_goes_on_implicitly():
    """Each stretch between two events decides anew; `implicit` counts the steps of all."""
    mechanism, ts = damped(100.0), np.linspace(0.0, 5.0, 6)
    plain = run(mechanism, ts=ts)
    middle = float(plain.q[0, 0, 2] + plain.q[-1, 0, 2]) / 2
    half = udk.Event(lambda t, at: at[mechanism.body_names[0]].angle - middle, udk.Log(), name="half")
    solution = run(mechanism, ts=ts, events=half)
    assert int(solution.stats["events"]) == 1 and int(solution.stats["implicit"]) > 3
    assert_allclose(solution.q, plain.q, atol=3e-6)


class Relaxing(udk.ForceElement):
    """A torque against the rotation of a body that is stiff for half a second and weak afterwards."""

    def loads(self, t, body):
        return [(0.0, 0.0, -(1e5 * 0.5 * (1 + jnp.tanh(40 * (0.5 - t))) + 0.01) * body.omega)]


@pytest.mark.slow
def test_a_run_returns_to_the_explicit_method():
    """Where the implicit one does not pay: a damper is soft again, and the pendulum swings."""
    scene = udk.library.compound_pendulum()
    mechanism = udk.Mechanism(scene.bodies, scene.joints, forces={"damper": Relaxing(["rod"])})
    ts = np.linspace(0.0, 6.0, 13)
    solution = run(mechanism, 1e-9, ts)
    _, v = by_radau(mechanism, ts)
    assert_allclose(solution.v, v, atol=3e-6)
    assert 10 < int(solution.stats["implicit"]) < int(solution.stats["accepted"]) - 60


@pytest.mark.slow
def test_members_in_lanes_are_those_alone():
    """Bit for bit, whether they go on implicitly sooner, later or never."""
    mechanism, ts = damped(1.0), np.linspace(0.0, 1.0, 5)
    analysis, state = udk.analyse(mechanism), udk.assemble(mechanism)

    def motion(damping):
        moved = mechanism.with_parameters({"force.damper.damping": damping})
        found = run(moved, ts=ts, state=state, analysis=analysis, throw=False)
        return found.q, found.v, found.stats["steps"], found.stats["implicit"]

    dampings = np.geomspace(0.1, 1e9, 11)
    together = jax.jit(jax.vmap(motion))(dampings)
    assert (together[3] > 0).any() and (together[3] == 0).any()
    for k, damping in enumerate(dampings):
        for x, y in zip(together, motion(damping), strict=True):
            np.testing.assert_array_equal(x[k], y)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [1e4, 1e7])
def test_first_derivatives(damping):
    """Through the change of the method, forward and reverse, and by differences; also of members in lanes."""
    mechanism = damped(damping)
    analysis, state = udk.analyse(mechanism), udk.assemble(mechanism)

    def end(x):
        moved = mechanism.with_parameters({"force.damper.damping": x})
        found = run(moved, 1e-9, state=state, analysis=analysis, throw=False)
        return found.q[5, 0, 2] + found.v[-1, 0, 2]

    forward = jax.jvp(end, (damping,), (1.0,))[1]
    assert_allclose(jax.grad(end)(damping), forward, rtol=1e-10)
    assert_allclose(forward, (end(damping * 1.01) - end(damping * 0.99)) / (0.02 * damping), rtol=1e-3)


def texts(changes):
    """The text of the default run of a double pendulum, by functions, with or without the implicit method."""
    engine = import_module("udkjax.integrate.compiled_mechanism")
    compiled = engine.compile_concrete(SCENE, udk.analyse(SCENE), udk.Auto(), udk.Projection())
    module = replace(compiled.plan.operation, changes=changes).module(1, 1, 8)
    module.text()
    return {f.name: f.text().count("\n") for f in module.functions}


SCENE = udk.library.double_pendulum()


def test_a_step_that_is_not_stiff_takes_hardly_more_operations():
    """Programs of the scene are the same; the functions of a step have a few more operations, most of them behind a branch."""
    one, other = texts(True), texts(False)
    own = {"attempt", "decide", "differences", "begin", "run", "outputs", "finish_members"}
    assert {name for name in other if one[name] != other[name]} <= own
    assert one["decide"] - other["decide"] < 240 and one["attempt"] - other["attempt"] < 340


def spans(mechanism, count=20):
    """Times of a run of `count` characteristic times."""
    return np.linspace(0.0, count * float(udk.analyse(mechanism).time), 3)


SLOW = ["andrews_squeezer", "n_four_bar", "peaucellier", "planetary_gear", "scissor_lift", "slider_crank", "chain"]


@pytest.mark.parametrize("name", ["parallelogram", "excavator", *(pytest.param(x, marks=pytest.mark.slow) for x in SLOW)])
def test_motions_that_are_not_stiff_take_no_implicit_step(name):
    """They are those by the explicit method, bit for bit, also if longer implicit steps have been tried in vain."""
    mechanism = getattr(udk.library, name)()
    for tol in (1e-3, 1e-6, 1e-9):
        choices = {"tol": tol, "ts": spans(mechanism), "throw": False}
        default, explicit = run(mechanism, **choices), run(mechanism, solver=diffrax.Dopri8(), **choices)
        assert int(default.stats["implicit"]) == 0
        np.testing.assert_array_equal(default.q, explicit.q)
        np.testing.assert_array_equal(default.v, explicit.v)


def test_a_visible_vibration_is_followed_explicitly():
    """The oil of the excavator swings at the limit of stability; implicit steps would have to follow it as well."""
    mechanism, ts = udk.library.excavator(), np.linspace(0.0, 20.0, 3)
    default, explicit = run(mechanism, ts=ts), run(mechanism, ts=ts, solver=diffrax.Dopri8())
    assert int(default.stats["implicit"]) == 0
    assert int(explicit.stats["steps"]) < int(default.stats["steps"]) < int(explicit.stats["steps"]) + 8  # trials
    loose = run(mechanism, 1e-3, ts)  # the vibration has soon decayed below the tolerance
    assert int(loose.stats["implicit"]) > 10
    assert int(loose.stats["steps"]) < 0.6 * int(run(mechanism, 1e-3, ts, solver=diffrax.Dopri8()).stats["steps"])


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_thresholds_matter_little(factor):
    """With counts of steps ten times as large or as small the same runs go on implicitly, to the same motion."""
    scenes = {  # tolerance, whether the run is stiff
        "four_bar": (damped(1e5), 1e-6, True),
        "pendulum": (damped(1e7, scene=udk.library.compound_pendulum()), 1e-6, True),
        "slider_crank": (damped(1e6, scene=udk.library.slider_crank()), 1e-6, True),
        "excavator": (udk.library.excavator(), 1e-6, False),
        "parallelogram": (udk.library.parallelogram(), 1e-3, False),
        "double_pendulum": (udk.library.double_pendulum(), 1e-9, False),
    }

    def runs():
        return {name: run(mechanism, tol, throw=False) for name, (mechanism, tol, _) in scenes.items()}

    usual = runs()
    with multiplied(factor, "native.module.steps.MEASURING_PERIOD", "native.module.steps.UNPAID_STEPS"):
        other = runs()
    for name, (_, tol, is_stiff) in scenes.items():
        assert (int(usual[name].stats["implicit"]) > 0) == (int(other[name].stats["implicit"]) > 0) == is_stiff, name
        assert_allclose(other[name].q, usual[name].q, atol=30 * tol if is_stiff else 0, rtol=0)
