"""Questions about a small mechanism, asked again, take few calls of functions; a call of Python takes 0.1 us or more.

Calls are counted, as times depend on what else the machine does.
"""

import gc
import itertools
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.calls import calls_of as noted_calls
from tests.ten_times import multiplied
from udkjax.equations.programs.scene_arrays import SceneArrays
from udkjax.positions.following.drive import without_drivers

TIMES = np.linspace(0.0, 1.0, 11)
ANGLES = 1.0 + 0.2 * TIMES
LINKAGE = udk.library.parallelogram(np.deg2rad(45.0))
LOADED = udk.Mechanism(
    dict(LINKAGE.bodies),
    dict(LINKAGE.joints),
    forces={"spring": udk.TorsionSpring(["ground", "link1"], stiffness=3.0, damping=0.2)},
)


def sprung_four_bar() -> udk.Mechanism:
    four_bar = udk.library.four_bar()
    spring = udk.TorsionSpring(["ground", "crank"], stiffness=3.0, damping=0.2)
    return udk.Mechanism(dict(four_bar.bodies), dict(four_bar.joints), forces={"spring": spring})


def calls_of(question):
    """Return how many functions are called when a question is asked for the 100th time, or one of the next two times.

    One of the three may generate a function, which pays off by now.
    """
    for _ in range(99):
        question()
    return min(_calls_now(question) for _ in range(3))


def _calls_now(question):
    count = 0

    def listen(frame, event, argument):
        nonlocal count
        is_inlined = event == "call" and frame.f_code.co_name in ("<listcomp>", "<setcomp>", "<dictcomp>")  # since Python 3.12
        count += event in ("call", "c_call") and not is_inlined

    gc.disable()  # what is collected meanwhile calls functions, too: caches forget it
    sys.setprofile(listen)
    try:
        question()
    finally:
        sys.setprofile(None)
        gc.enable()
    return count


def test_calls_of_kinematics_and_inverse_dynamics():
    crank = udk.library.slider_crank()
    motion = udk.kinematics(crank, None, TIMES)
    four_bar = udk.library.four_bar()
    assert calls_of(lambda: udk.kinematics(crank, None, TIMES)) < 620
    assert calls_of(lambda: udk.kinematics(four_bar, "body.crank.angle", ANGLES)) < 950  # 779 in a process of its own
    assert calls_of(lambda: udk.inverse_dynamics(crank, TIMES, motion)) < 640
    assert calls_of(lambda: udk.inverse_dynamics(crank, TIMES)) < 1_280
    assert calls_of(lambda: udk.reactions(crank, motion)) < 1_150


def test_calls_of_a_position_of_rest():
    """The programs of the scene are one function each, as is a correction of a position."""
    pendulum, linkage = udk.library.double_pendulum(), sprung_four_bar()
    assert calls_of(lambda: udk.equilibrium(pendulum)) < 3_300  # 22 positions: stretched out, it goes downhill first
    assert calls_of(lambda: udk.equilibrium(linkage)) < 1_130
    state = udk.equilibrium(linkage).state
    assert calls_of(lambda: udk.modes(linkage, state)) < 1_350


def test_calls_of_diagnosis_and_derivation():
    """A path of a hundred positions, and the symbols of one state, each computed once."""
    four_bar = udk.library.four_bar()
    assert calls_of(lambda: udk.diagnose(four_bar)) < 40_000
    assert calls_of(lambda: udk.explain(four_bar)) < 6_300
    assert calls_of(lambda: udk.travel(four_bar, "body.crank.angle")) < 20_500  # one whole turn, as it leads back
    assert calls_of(lambda: udk.holding_efforts(four_bar, "body.crank.angle", ANGLES)) < 4_100


WORTH_ELIMINATING = "equations.programs.eliminated_steps.USES_BEFORE_ELIMINATION"


@pytest.mark.parametrize("mechanism", [udk.library.four_bar, udk.library.slider_crank, lambda: LINKAGE, udk.library.peaucellier])
def test_a_diagnosis_by_elimination_is_that_by_singular_values(mechanism):
    """Also across the singular positions of redundant rows, where branches meet."""
    scene, found = mechanism(), []
    name = f"body.{scene.body_names[0]}.mass"
    for factor in (1e4, 0.0):
        with multiplied(factor, WORTH_ELIMINATING):
            found.append(udk.diagnose(scene.with_parameters({name: 1.1})))
    slow, fast = found
    assert str(slow) == str(fast)
    assert_allclose(fast.clearance.searched, slow.clearance.searched, rtol=1e-12)
    assert (slow.clearance.nearest is None) == (fast.clearance.nearest is None)
    if slow.clearance.nearest is not None:
        assert_allclose(fast.clearance.nearest.q, slow.clearance.nearest.q, atol=1e-9)


@pytest.mark.parametrize("mechanism", [sprung_four_bar, lambda: LOADED], ids=["four_bar", "redundant rows"])
def test_a_position_of_rest_by_elimination_is_that_by_singular_values(mechanism):
    """The shortest corrections in units of the scene are the same by both, up to rounding, also of redundant rows."""
    scene, found = mechanism(), []
    for factor in (1e4, 0.0):
        with multiplied(factor, WORTH_ELIMINATING), noted_calls(SceneArrays.newton_step, SceneArrays.linearization) as calls:
            found.append(udk.equilibrium(scene.with_parameters({"force.spring.stiffness": 2.9})))
        used = {call.function for call in calls}
        assert (SceneArrays.newton_step in used) == (factor == 0.0)
        assert (SceneArrays.linearization in used) == (factor == 0.0 and not udk.analyse(scene).redundant)
    slow, fast = found
    assert slow.balanced and fast.balanced
    assert_allclose(fast.q, slow.q, atol=1e-13)
    assert_allclose(fast.omega2, slow.omega2, rtol=1e-11)
    assert_allclose(fast.multipliers, slow.multipliers, rtol=1e-11, atol=1e-11)
    damped = [udk.modes(scene, x.state) for x in found]
    assert_allclose(damped[1].s, damped[0].s, rtol=1e-10)


def test_efforts_of_one_freedom_follow_from_powers(monkeypatch):
    """Also of several drivers; where nothing moves, from the rows of the joints; the compiled function is another method."""
    inverted, inverse = [], np.linalg.inv
    monkeypatch.setattr(np.linalg, "inv", lambda A: inverted.append(len(A)) or inverse(A))
    crank, times = udk.library.slider_crank(), np.linspace(0.0, 1.0, 300)
    found = udk.inverse_dynamics(crank, times)
    assert inverted == []
    assert np.max(np.asarray(found.residual)) < 1e-12

    linkage, rates = sprung_four_bar(), np.where(np.arange(len(ANGLES)) % 3 == 0, 0.0, 2.0)
    motion = udk.kinematics(linkage, "body.crank.angle", ANGLES, rate=rates, acceleration=0.3)
    drivers, weights = ["body.crank.angle", "body.rocker.angle"], {"body.rocker.angle": 3.0}
    found = udk.inverse_dynamics(linkage, ANGLES, motion, drivers, weights)
    assert inverted == []  # two drivers of one degree of freedom are no square system: singular values
    udk.inverse_dynamics(linkage, ANGLES, motion, drivers[:1])
    assert inverted == [np.count_nonzero(rates == 0.0)]


def test_no_effort_where_the_motion_ends():
    rocker = udk.library.four_bar()
    motion = udk.kinematics(rocker, "body.rocker.angle", np.linspace(1.6, 4.0, 9))
    found = udk.inverse_dynamics(rocker, motion.values, motion, ["body.rocker.angle"])
    ended = ~np.asarray(motion.reached)
    assert ended.any() and not ended.all()
    assert_allclose(np.isnan(np.asarray(found.efforts["body.rocker.angle"])), ended)


@pytest.mark.slow
def test_distant_values_are_followed_by_values_between_them():
    """A whole turn in five steps equals the same in a hundred, at the five."""
    four_bar = udk.library.four_bar()
    few, many = (udk.kinematics(four_bar, "body.crank.angle", 1.0 + np.linspace(0.0, 2 * np.pi, n)) for n in (6, 101))
    for name in ("q", "v", "a"):
        assert_allclose(getattr(few, name), getattr(many, name)[::20], rtol=1e-9, atol=1e-9)


def test_a_mechanism_without_its_drivers_is_not_checked_again():
    """Its elements are those of a mechanism that was checked, whose numbers a question may change each time."""
    crank = udk.library.slider_crank()
    first = calls_of(lambda: without_drivers(crank.with_parameters({})))
    assert first - calls_of(lambda: crank.with_parameters({}).bodies) < 1500


def test_only_elements_that_differ_are_checked():
    """A mechanism of valid elements stays valid where they stay the same objects."""
    four_bar = udk.library.four_bar()
    drawn = udk.load("examples/four_bar.toml")
    assert calls_of(lambda: four_bar.with_parameters({"body.coupler.mass": 2.0})) < 940
    assert calls_of(lambda: drawn.with_parameters({"body.coupler.mass": 2.0})) < 940


def changed(mechanism):
    """Return a function that returns the mechanism with another mass at each call."""
    name = f"body.{mechanism.body_names[1]}.mass"
    masses = itertools.count(1)
    return lambda: mechanism.with_parameters({name: 1.0 + 1e-3 * next(masses)})


def test_calls_with_changed_numbers():
    """A loop over a number makes a new mechanism each time, whose structure is known."""
    crank, four_bar, linkage = map(changed, (udk.library.slider_crank(), udk.library.four_bar(), sprung_four_bar()))
    motion = udk.kinematics(four_bar(), "body.crank.angle", ANGLES)
    assert calls_of(lambda: udk.equilibrium(linkage())) < 6_000
    assert calls_of(lambda: udk.kinematics(four_bar(), "body.crank.angle", ANGLES)) < 13_600
    assert calls_of(lambda: udk.inverse_dynamics(four_bar(), TIMES, motion, ["body.crank.angle"])) < 6_100
    assert calls_of(lambda: udk.inverse_dynamics(crank(), TIMES)) < 12_300
