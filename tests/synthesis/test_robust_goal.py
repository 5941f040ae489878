"""Robust goals: mean and deviation against pieces that are moved one by one, derivatives, and the yield of designs."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.positions import gap_in_position
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.synthesis import goal_file
from udkjax.synthesis.ranges.second_order import quadratic
from udkjax.synthesis.robust_goal import RobustTerm

LINKS = {"crank": ("OA", 10), "coupler": ("ABP", None), "rocker": ("CB", 10)}
DRAWING = udk.Drawing(
    pins={"O": (0, 0), "A": (30, 40), "B": (120, 90), "P": (60, 120), "C": (100, 0)},
    links={name: udk.Link(list(pins), mass=1.0, width=width and 1e-3 * width) for name, (pins, width) in LINKS.items()},
    ground=["O", "C"],
    motors={"motor": {"pin": "O", "speed": "60 rpm"}},
    units={"length": "mm"},
)
TARGETS = np.column_stack([np.linspace(0.06, 0.02, 4), np.full(4, 0.12)])
PATH = udk.PathGoal("P", TARGETS, values=np.linspace(0.9, 1.3, 4))
TOLERANCES = {"length(crank)": "1 mm", "joint.C.points[0]": udk.Tolerance(0.5, "mm", "uniform")}


def robust(measures, sigmas):
    """Return mean plus deviations of the quadratic function of the deviations of the crank and of C."""
    model = quadratic(measures, 3)
    own, pairs = model.parts(np.array([3.0, 1.8, 1.8]))
    return model.mean + sigmas * np.sqrt(own.sum(1) + pairs.sum((1, 2)) / 2)


def piece(mechanism, u):
    moved = udk.with_length(mechanism, "crank", 0.05 + 1e-3 / 3 * u[0])
    points = np.array(moved.parameters()["joint.C.points"])
    points[0] += 0.5e-3 / 3**0.5 * u[1:]
    return moved.with_parameters({"joint.C.points": points})


@pytest.mark.slow
@pytest.mark.parametrize("goal", ["path", "gap"])
def test_the_measure_is_that_of_pieces_moved_one_by_one_and_its_derivatives_are_exact(goal):
    if goal == "path":
        robust_goal = udk.RobustGoal(PATH, TOLERANCES, 2.0, most=1e-3)
    else:
        robust_goal = udk.RobustGoal(udk.GapGoal("crank", "rocker", least=0.05, samples=4), TOLERANCES, 2.0)
    rotation = None if goal == "gap" else False
    (term,) = (search := udk.DesignSearch(DRAWING, [PATH, robust_goal], ["pin.A", "pin.B"], rotation=rotation)).problem.terms
    assert isinstance(term, RobustTerm)
    x, mechanism = search.problem.free.vector[None], DRAWING.mechanism()
    found, slopes, there = term.measures(x)
    assert there.all()
    assert [len(each) for each in term.measures(x[:0])] == [0, 0, 0]  # where no trial of a search is left

    def measured(u):
        rows = []
        for each in u:
            moved = piece(mechanism, each)
            motion = udk.kinematics(moved, "motor", term.values(term._at_points(x))[0])
            if goal == "path":
                rows.append(((np.asarray(udk.path(moved, motion, "P"))[:, :2] - TARGETS) ** 2).sum(1))
            else:
                rows.append([float(gap_in_position(moved, None, ("crank", "rocker"), q)) for q in motion.q])
        return np.array(rows)

    wanted = np.sqrt(robust(measured, 2.0)) if goal == "path" else robust(measured, -2.0)
    np.testing.assert_allclose(found[0], wanted, rtol=1e-9)
    followed = term.measure_motion(mechanism, x[0], 0.0)
    assert followed is not None
    np.testing.assert_allclose(followed, found[0], rtol=1e-9)
    for k in range(x.shape[1]):
        step = 1e-6 * np.eye(x.shape[1])[k]
        difference = (term.measures(x + step)[0] - term.measures(x - step)[0]) / 2e-6
        np.testing.assert_allclose(slopes[..., k], difference, atol=1e-7)


def test_mistakes_are_named():
    def search(goal):
        return udk.DesignSearch(DRAWING, [PATH, goal], ["pin.A"], rotation=False)

    energy = udk.EnergyGoal(most=1.0)
    with pytest.raises(udk.SceneError, match=r"pin.A.: a pin changes all of its links.*joint.C.points\[0\]"):
        search(udk.RobustGoal(energy, {"pin.A": 1e-3}))
    with pytest.raises(udk.SceneError, match=r'no number named "pin\.Q"'):
        search(udk.RobustGoal(energy, {"pin.Q": 1e-3}))
    with pytest.raises(udk.SceneError, match="clearance has no share"):
        search(udk.RobustGoal(energy, {"joint.C.points[0]": udk.PinClearance(1e-3)}))
    with pytest.raises(udk.SceneError, match="none is given"):
        search(udk.RobustGoal(energy, {}))
    with pytest.raises(udk.SceneError, match="not those of the design"):
        search(udk.RobustGoal(udk.PathGoal("P", TARGETS, values=range(4)), TOLERANCES, most=1.0))
    with pytest.raises(ValueError, match="give values"):
        udk.RobustGoal(udk.PathGoal("P", TARGETS), TOLERANCES, most=1.0)
    with pytest.raises(ValueError, match="has its own limits"):
        udk.RobustGoal(energy, TOLERANCES, most=1.0)
    with pytest.raises(ValueError, match="tolerances of its own"):
        udk.RobustGoal(udk.RobustGoal(energy, TOLERANCES), TOLERANCES)
    with pytest.raises(ValueError, match="most or least, not both"):
        udk.RobustGoal(udk.EnergyGoal(most=1.0, least=0.5), TOLERANCES)


def test_robust_goals_of_files_have_units():
    problems = []

    def read(**given):
        mechanism = udk.library.four_bar()
        return goal_file._read_motion("motion[0]", mechanism, PATH, given, Units({"length": "mm"}), problems)

    found = read(kind="robust", tolerances={"length(crank)": 0.3, "length(rocker)": "h9"}, sigmas=4, most=0.5)
    assert isinstance(found, udk.RobustGoal) and found.goal is PATH
    assert (found.most, found.sigmas, found.tolerances) == (5e-4, 4.0, {"length(crank)": 3e-4, "length(rocker)": "h9"})
    torque = read(kind="robust", tolerances={"length(crank)": 0.3}, goal={"kind": "torque", "most": "2 N mm", "speed": "1 rad/s"})
    assert isinstance(torque, udk.RobustGoal) and isinstance(torque.goal, udk.TorqueGoal)
    assert torque.goal.most == torque.most == pytest.approx(2e-3)
    assert problems == []
    assert read(kind="robust", most=0.5, tolerance={}) is None
    assert "motion[0].tolerance" in problems[0] and "motion[0].tolerances: missing" in problems[1]
