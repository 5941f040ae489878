"""Goals about the motion: measures compared with inverse dynamics, reactions and modes; derivatives; designs."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.synthesis import goal_file

LINKS = {
    name: {"pins": list(pins), "mass": mass}
    for name, pins, mass in (("crank", "OA", 1.0), ("coupler", "ABP", 2.0), ("rocker", "CB", 1.5))
}
FOUR_BAR = udk.Drawing(
    pins={"O": (0, 0), "A": (3, 4), "B": (12, 9), "P": (6, 12), "C": (10, 0), "S": (20, 0)},
    links=LINKS,
    ground=["O", "C", "S"],
    motors={"motor": {"pin": "O", "speed": 3.0}},
    springs={"spring": {"between": ["P", "S"], "stiffness": 30.0, "length": 4.0}},
)
PATH = udk.PathGoal("P", [[6, 12], [4, 10], [2, 8]])
TERMS = [
    udk.TorqueGoal(most=50.0, samples=6),
    udk.LoadGoal("A", most=20.0, samples=6),
    udk.EnergyGoal(most=50.0, samples=6),
    udk.FrequencyGoal(least=0.9, samples=6),
    udk.ToleranceGoal("P", {"pin.A": 0.1, "pin.C": 0.2}, most=1e-3, samples=6),
    udk.MotionGoal(lambda at: at.v[1] @ at.v[1], most=10.0, samples=6),
]
FREE = [*(f"pin.{name}" for name in "OABPCS"), "link.coupler.mass", "spring.spring.stiffness", "gravity"]


@pytest.fixture(scope="module")
def problem():
    return udk.DesignSearch(FOUR_BAR, [PATH, *TERMS], FREE).problem


def motion_of(problem, term):
    """The motion of the motor from the drawn position, at the sample times of a term."""
    mechanism, n = FOUR_BAR.mechanism(), term.goal.samples
    step, start = 2 * np.pi / n, np.arctan2(4, 3)
    ts = (step * (np.ceil(start / step) + np.arange(n)) - start) / 3.0
    return mechanism, ts, udk.kinematics(mechanism, None, ts)


@pytest.mark.slow
def test_measures_are_those_of_inverse_dynamics_and_reactions(problem):
    x = problem.free.vector[None]
    found = [term.measures(x) for term in problem.terms]
    assert all(there.all() for *_, there in found)
    mechanism, ts, motion = motion_of(problem, problem.terms[0])
    torque = np.abs(np.asarray(udk.inverse_dynamics(mechanism, ts, motion).efforts["motor"]))
    np.testing.assert_allclose(found[0][0][0], torque, rtol=1e-9)
    load = np.asarray(udk.pin_reactions(mechanism, motion)["A"]["crank"])
    np.testing.assert_allclose(found[1][0][0], np.hypot(load[:, 0], load[:, 1]), rtol=1e-9)
    for term, (values, *_) in zip(problem.terms, found, strict=True):
        np.testing.assert_allclose(values[0], term.measure_motion(mechanism, x[0], 0.0), rtol=1e-9)


@pytest.mark.slow
def test_the_loss_moves_when_any_number_does_by_every_goal_about_the_motion(problem):
    x = problem.free.vector[None]
    h = 1e-6 * np.maximum(np.abs(x[0]), 1.0)
    moves = np.zeros(x.shape[1], bool)
    for term in problem.terms:
        exact = term(x)
        assert np.any(exact.r != 0), type(term.goal)
        slopes = (term(x + np.diag(h)).r - term(x - np.diag(h)).r).T / (2 * h)
        np.testing.assert_allclose(exact.by_unknowns[0], slopes, atol=2e-8 * max(1.0, np.max(np.abs(slopes))), rtol=1e-6)
        moved = np.abs(2.0 * exact.r[0] @ exact.by_unknowns[0]) > 0
        needed = {
            "TorqueGoal": "",
            "FrequencyGoal": "",
            "LoadGoal": "",
            "EnergyGoal": "CS",
            "ToleranceGoal": "S",
            "MotionGoal": "S",
        }
        still = needed[type(term.goal).__name__]
        entries = problem.free.entries()
        kinematic = [k for k, name in enumerate(entries) if name.startswith("pin.") and name[4] not in still]
        assert moved[kinematic].all(), (type(term.goal), [entries[k] for k in kinematic if not moved[k]])
        moves |= moved
    assert moves.all()


def test_the_frequency_is_that_of_the_mode_at_rest():
    drawing = udk.Drawing(pins={"O": (0, 0), "A": (0, -1)}, links={"rod": {"pins": ["O", "A"], "mass": 2.0}}, ground=["O"])
    goals = [udk.PathGoal("A", [[0, -1], [0.1, -1]]), udk.FrequencyGoal(least=1.0, speed=1.0, samples=4)]
    (term,) = udk.DesignSearch(drawing, goals, ["pin.A"], driver="body.rod.angle").problem.terms
    found, _, there = term.measures(np.array([[0.0, -1.0]]))
    assert there.all()
    np.testing.assert_allclose(found[0, 0], udk.modes(drawing.mechanism()).frequencies[0] / (2 * np.pi), rtol=1e-9)
    np.testing.assert_allclose(found[0, 2], -found[0, 0], rtol=1e-9)  # upside down it is unstable


@pytest.mark.slow
def test_the_torque_of_a_design_stays_below_what_is_given():
    lengths = {("O", "C"): (5.0, 20.0), ("O", "A"): (2.0, 20.0)}
    found = udk.design(
        FOUR_BAR, [PATH, udk.TorqueGoal(most=200.0)], [f"pin.{name}" for name in "OABPC"], lengths=lengths, starts=60
    )
    best = found[0]
    assert best.loss < 1e-20 and best.turns and "measures" in str(best)
    moved = udk.kinematics(best.mechanism, "motor", best.values)
    np.testing.assert_allclose(udk.path(best.mechanism, moved, "P"), PATH.targets, atol=1e-9)
    ts = 2 * np.pi / 3.0 * np.linspace(0.0, 1.0, 73)
    effort = np.abs(np.asarray(udk.inverse_dynamics(best.mechanism, ts).efforts["motor"]))
    assert np.max(effort) < 205.0  # between the samples it may be a little more


def test_mistakes_are_named():
    with pytest.raises(udk.SceneError, match='no joint named "Q"'):
        udk.DesignSearch(FOUR_BAR, [PATH, udk.LoadGoal("Q", most=1.0)])
    with pytest.raises(udk.SceneError, match="tolerance and is not free"):
        udk.DesignSearch(FOUR_BAR, [PATH, udk.ToleranceGoal("P", {"pin.A": 0.1}, most=1.0)], ["pin.B"])
    with pytest.raises(udk.SceneError, match="over a whole turn or over values"):
        udk.DesignSearch(FOUR_BAR, [PATH, udk.TorqueGoal(most=1.0)], rotation=False)
    with pytest.raises(ValueError, match="give most, least, or both"):
        udk.TorqueGoal()
    with pytest.raises(ValueError, match="one of them and any motion goals"):
        udk.design(FOUR_BAR, [udk.TorqueGoal(most=1.0)])


def test_limits_and_speeds_of_goal_files_have_units():
    problems = []

    def read(**given):
        return goal_file._read_motion("motion[0]", udk.library.four_bar(), None, given, Units({"length": "mm"}), problems)

    found = read(kind="torque", most="2 N mm", least="1 N mm", speed="60 rpm")
    assert found is not None
    assert (found.most, found.least, found.speed) == pytest.approx((2e-3, 1e-3, 2 * np.pi), rel=1e-12, abs=0.0)
    force = read(kind="load", joint="A", most="3 kN")
    assert force is not None and force.most == pytest.approx(3e3, rel=1e-12, abs=0.0)
    assert problems == []
    assert read(kind="torque", most="2 kg", speed="60 rpm") is None and "motion[0].most" in problems[0]
