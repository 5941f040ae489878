"""Designs by gradient: known mechanisms are found again, limits hold, and the result moves as it should."""

import json
from pathlib import Path

import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast
from udkjax.arrays import solve_each
from udkjax.synthesis.design_problem import MARGIN_WEIGHT
from udkjax.synthesis.search import loss_of
from udkjax.synthesis.trials import Trials

DATA = json.loads((Path(__file__).parents[1] / "data" / "path_synthesis.json").read_text())["cases"]
FOUR_BAR = udk.Drawing(
    pins={"O": (0, 0), "A": (3, 4), "B": (12, 9), "P": (6, 12), "C": (10, 0)},
    links={"crank": {"pins": ["O", "A"], "mass": 1.0}, "coupler": {"pins": ["A", "B", "P"], "mass": 1.0}}
    | {"rocker": {"pins": ["C", "B"], "mass": 1.0}},
    ground=["O", "C"],
    motors={"motor": {"pin": "O", "speed": 1.0}},
)
SLIDER_CRANK = udk.Drawing(
    pins={"O": (0, 0), "A": (1, 1), "B": (4, 0), "P": (2, 2)},
    links={"crank": {"pins": ["O", "A"], "mass": 1.0}, "rod": {"pins": ["A", "B", "P"], "mass": 1.0}},
    ground=["O"],
    slots=[{"pin": "B", "direction": 0.3}],
    motors={"motor": {"pin": "O", "speed": 1.0}},
)
SCENES = Path(__file__).parents[2] / "examples"
SIX_BAR = udk.load(SCENES / "six_bar.toml")
GEARED = udk.Drawing(
    pins={"O": (0, 0), "A": (1, 1.5), "B": (4, 5), "C": (8, 1.5), "D": (6, 0), "P": (4.5, 7)},
    links={"first": {"pins": ["O", "A"], "mass": 1.0}, "one": {"pins": ["A", "B", "P"], "mass": 1.0}}
    | {"other": {"pins": ["C", "B"], "mass": 1.0}, "second": {"pins": ["D", "C"], "mass": 1.0}},
    ground=["O", "D"],
    motors={"motor": {"pin": "O", "speed": 1.0}},
    gears=[{"links": ["first", "second"], "teeth": [20, 40]}],
)
PARALLELOGRAM = udk.Drawing(
    pins={"O": (0, 0), "A": (1, 2), "B": (5, 2), "C": (4, 0), "D": (2, -1), "E": (3, 1), "P": (3, 4)},
    links={"crank": {"pins": ["O", "A"], "mass": 1.0}, "coupler": {"pins": ["A", "E", "B", "P"], "mass": 1.0}}
    | {"first": {"pins": ["C", "B"], "mass": 1.0}, "second": {"pins": ["D", "E"], "mass": 1.0}},
    ground=["O", "C", "D"],
    motors={"motor": {"pin": "O", "speed": 1.0}},
)


def motion(mechanism, count, span=1.8):
    """Values of the first driver, starting from the drawn one, and the motion for these values."""
    from udkjax.positions.following.drive import drive

    name = mechanism.driver_names[0]
    values = float(drive(mechanism, name).value(mechanism.q0)) + np.linspace(0.1, span, count)
    return values, udk.kinematics(mechanism, name, values)


def path_errors(found, point, targets):
    """Return by how much the point of a design misses its targets in a motion computed separately."""
    moved = udk.kinematics(found.mechanism, found.driver, found.values)
    assert np.all(moved.reached)
    return np.linalg.norm(np.asarray(udk.path(found.mechanism, moved, point)) - targets, axis=1)


def search(number):
    """One of the five classic cases, with its additional conditions."""
    case = DATA[number]
    targets, most, area = np.array(case["targets"]), case["bounds"]["r"][1], case["bounds"]["others"][1]
    angles = np.deg2rad(case["crank_angles_deg"]) if number in (1, 3) else None
    goals = {1: {"values": angles}, 2: {"values": np.deg2rad(20.0) * np.arange(len(targets)), "start": "free"}}
    goals[3] = {"values": angles, "line": ("O", "C")}
    lengths = dict.fromkeys([("O", "A"), ("A", "B"), ("C", "B"), ("O", "C"), ("A", "P")], (0.0, float(most)))
    free = ["pin.A", "pin.B", "pin.P", "pin.C[0]"] if number == 1 else None
    bounds = None if number == 1 else {"pin.O": (-area, area)}
    return case, udk.DesignSearch(FOUR_BAR, udk.PathGoal("P", targets, **goals.get(number, {})), free, bounds, lengths)


@pytest.fixture(scope="module")
def classic():
    return search(1)


def published(case):
    return min(value for value in case["published_errors"].values())


def within_its_bounds(case, found):
    """Check lengths and coordinates in the parametrization of the publication, and whether the crank turns."""
    ground, A, B, P, C = (np.asarray(found.pins[name]) for name in "OABPC")
    r, others = case["bounds"]["r"][1], case["bounds"]["others"][1]
    lengths = [np.linalg.norm(b - a) for a, b in ((ground, C), (ground, A), (A, B), (C, B))]
    along = (B - A) / lengths[2]
    local = [(P - A) @ along, along[0] * (P - A)[1] - along[1] * (P - A)[0]]
    ordered = sorted(lengths)
    turns = lengths[1] == ordered[0] and ordered[0] + ordered[3] <= ordered[1] + ordered[2]
    return max(lengths) <= r * (1 + 1e-6) and np.all(np.abs([*local, *ground]) <= others * (1 + 1e-6)), turns


@pytest.mark.slow
def test_a_classic_case_is_solved_better_than_published(classic):
    case, problem = classic
    found = problem(starts=150, seed=0, results=1)
    assert found[0].loss < published(case)
    np.testing.assert_allclose(found[0].loss, case["best_known"], rtol=1e-4)
    errors = path_errors(found[0], "P", np.array(case["targets"]))
    np.testing.assert_allclose(np.sum(errors**2), found[0].loss, rtol=1e-6)
    angles = np.asarray(udk.kinematics(found[0].mechanism, "motor", found[0].values).q[:, 0, 2])
    np.testing.assert_allclose(np.cos(angles), np.cos(np.deg2rad(case["crank_angles_deg"])), atol=1e-9)
    assert all(within_its_bounds(case, one)[0] and one.turns for one in found)
    assert "loss" in str(found) and "pin.A" in str(found[0])


@pytest.mark.slow
def test_a_search_is_run_for_another_path_with_the_same_programs(classic):
    first, limits = np.array([[0.0, 8.0], [2.0, 12.0], [9.0, 14.0], [12.0, 8.0]]), {("O", "A"): (2.0, 9.0)}
    second = 1.5 * first[:, ::-1] + [4.0, -3.0]
    search = udk.DesignSearch(FOUR_BAR, udk.PathGoal("P", first), lengths=limits)
    other, fresh = search.with_path(second), udk.DesignSearch(FOUR_BAR, udk.PathGoal("P", second), lengths=limits)
    assert other.problem._turn_code is search.problem._turn_code and other.problem._margin is search.problem._margin
    assert [d.loss for d in other(starts=8)] == [d.loss for d in fresh(starts=8)]
    _, with_values = classic
    with pytest.raises(ValueError, match="give one value for each target"):
        with_values.with_path(first)
    pose = udk.DesignSearch(FOUR_BAR, udk.PoseGoal("coupler", [[0, 8, 0], [9, 14, 0.5]]))
    with pytest.raises(ValueError, match="only goal is a PathGoal"):
        pose.with_path(first)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(5))
def test_all_classic_cases_are_solved_at_least_as_well_as_published_from_any_seed(number):
    case, problem = search(number)
    for seed in (0, 1):
        found = problem(starts=300, seed=seed, results=1)
        assert found[0].loss <= published(case) * (1 + 1e-6)  # to the digits that were published
        bounded, turns = within_its_bounds(case, found[0])
        assert bounded and turns


@pytest.mark.slow
def test_a_slider_crank_is_found_again_from_its_path():
    mechanism = SLIDER_CRANK.mechanism()
    values, moved = motion(mechanism, 8, 5.0)
    targets = np.asarray(udk.path(mechanism, moved, "P"))
    goal = udk.PathGoal("P", targets, values)
    found = udk.design(SLIDER_CRANK, goal, free=["pin.A", "pin.B", "pin.P"], starts=60, results=1)
    assert found[0].loss < 1e-16
    assert np.max(path_errors(found[0], "P", targets)) < 1e-8


@pytest.mark.slow
def test_a_six_bar_goes_through_places_in_their_order():
    targets = np.asarray(udk.path(SIX_BAR, motion(SIX_BAR, 5)[1], "D"))
    found = udk.design(SIX_BAR, udk.PathGoal("D", targets), starts=40, results=1)
    assert found[0].loss < 1e-12 * np.ptp(targets) ** 2
    assert np.max(path_errors(found[0], "D", targets)) < 1e-6 * np.ptp(targets)
    steps = np.diff(found[0].values)
    assert np.all(steps > 0) or np.all(steps < 0)


def test_a_rocker_follows_a_function_of_the_crank():
    values = np.linspace(0.0, 1.2, 7)
    goal = udk.FunctionGoal("body.rocker.angle", values, 0.4 * values**1.5)
    found = udk.design(FOUR_BAR, goal, free=["pin.A", "pin.B"], starts=80, results=1, rotation=False)
    moved = udk.kinematics(found[0].mechanism, "motor", found[0].values)
    np.testing.assert_allclose(np.diff(found[0].values), np.diff(values), atol=1e-12)
    turned = np.asarray(moved.q[:, 2, 2] - moved.q[0, 2, 2])
    assert np.max(np.abs(turned - 0.4 * values**1.5)) < 5e-3  # rad


@pytest.mark.slow
def test_a_coupler_goes_through_three_poses():
    poses = np.array([[0.0, 0.0, 0.0], [4.0, 2.0, 0.3], [7.0, 1.0, 0.8]])
    found = udk.design(FOUR_BAR, udk.PoseGoal("coupler", poses, pin="P"), starts=60, results=1, transmission=np.deg2rad(20.0))
    one = found[0]
    assert one.loss < 1e-20 and one.transmission > np.sin(np.deg2rad(20.0)) * (1 - 1e-6) and one.turns
    moved = udk.kinematics(one.mechanism, "motor", one.values)
    np.testing.assert_allclose(udk.path(one.mechanism, moved, "P"), poses[:, :2], atol=1e-8)
    angles = np.asarray(moved.q[:, 1, 2])
    np.testing.assert_allclose(np.sin(np.diff(angles) - np.diff(poses[:, 2])), 0.0, atol=1e-8)
    turn = np.linspace(one.values[0], one.values[0] + 2 * np.pi, 721)
    sine = np.sin(udk.transmission_angle(one.mechanism, udk.kinematics(one.mechanism, "motor", turn), "B"))
    assert np.min(sine) > np.sin(np.deg2rad(20.0)) - 2e-3


@pytest.mark.slow
def test_the_same_seed_finds_the_same(classic):
    one, two = (classic[1](starts=30, seed=5, results=1, threads=k) for k in (1, 2))
    assert one[0].loss == two[0].loss


KINDS = {
    "pins of a four-bar": (FOUR_BAR.mechanism(), [f"pin.{name}" for name in "OABPC"], "P"),
    "a slot": (SLIDER_CRANK.mechanism(), ["pin.A", "pin.B", "pin.P", "slot.slot1.direction"], "P"),
    "pins of a six-bar": (SIX_BAR, [f"pin.{name}" for name in ("O2", "A", "B", "C", "O4", "D")], "D"),
    "points of joints": (udk.library.four_bar(), ["joint.A.points", "joint.B.points", "joint.D.points[0]"], "C"),
    "pins of a geared five-bar": (GEARED.mechanism(), [f"pin.{name}" for name in "OABCDP"], "P"),
    "radii of a cam": (udk.load(SCENES / "drawings" / "cam_follower.toml"), ["cam.cam1.profile.radius"], "P"),
    "the point of a redundant parallelogram": (PARALLELOGRAM.mechanism(), ["pin.P"], "P"),
}
GOALS = {
    "pins of a four-bar": [
        udk.PoseGoal("coupler", [[6, 12, 0.1], [4, 10, 0.3], [2, 8, 0.2]], pin="P"),
        udk.FunctionGoal("body.rocker.angle", [0.1, 0.2, 0.3], [0.0, 0.1, 0.3]),
    ]
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", fast(["pins of a four-bar", "points of joints", "radii of a cam"], KINDS))
def test_the_loss_moves_when_any_parameter_does(kind):
    mechanism, free, point = KINDS[kind]
    driver = mechanism.driver_names[0] if mechanism.driver_names else "body.crank.angle"
    moved = udk.kinematics(mechanism, driver, start_of(mechanism, driver) + np.array([0.1, 0.2, 0.3]))
    places = np.asarray(udk.path(mechanism, moved, point))
    path = udk.PathGoal(point, places + 0.1 * np.ptp(places) * np.array([[1.0, 0.3], [-0.2, 0.7], [0.5, -1.0]]))
    for goal in (path, *GOALS.get(kind, [])):
        moving = free if goal.has_place else [name for name in free if name != "pin.P"]  # an output does not depend on a point
        problem = udk.DesignSearch(mechanism, goal, moving, driver=driver, rotation=False).problem
        require_slopes(problem, np.asarray(moved.values)[None])


def require_slopes(problem, s):
    """Require that the derivatives of the loss by all unknowns are not zero, and agree with differences."""
    x = np.append(problem.free.vector, np.full(problem.unknown_count - problem.free.count, 0.1))[None]
    q, reached = problem.march(x, s)
    assert reached.all()

    def loss(x):
        found = problem.evaluate(Trials(x, np.repeat(s, len(x), 0), np.repeat(q, len(x), 0)), np.zeros(len(x)))
        return loss_of(found), 2.0 * np.einsum("mjg,mjgp->mp", found.r, found.by_unknowns)

    h = 1e-6 * problem.scale
    steps = h * np.eye(x.shape[1])
    slopes = (loss(x + steps)[0] - loss(x - steps)[0]) / (2 * h)
    exact = loss(x)[1][0]
    np.testing.assert_allclose(exact, slopes, atol=1e-6 * np.max(np.abs(slopes)))
    assert np.all(exact != 0.0), problem.free.entries()


def start_of(mechanism, driver):
    from udkjax.positions.following.drive import drive

    return float(drive(mechanism, driver).value(mechanism.q0))


def test_the_limit_of_a_turn_is_at_its_least_transmission():
    """The row of the limit and its derivatives are those of the minimum of a turn in fine steps, for 20 crank-rockers."""
    crank_rocker = udk.Drawing(
        pins={"O": (0, 0), "A": (0.3, 2), "B": (7, 6), "P": (6, 12), "C": (9, 0)},
        links={"crank": {"pins": ["O", "A"], "mass": 1.0}, "coupler": {"pins": ["A", "B", "P"], "mass": 1.0}}
        | {"rocker": {"pins": ["C", "B"], "mass": 1.0}},
        ground=["O", "C"],
        motors={"motor": {"pin": "O", "speed": 1.0}},
    )
    problem = udk.DesignSearch(crank_rocker, udk.PathGoal("P", [[6, 12], [4, 10], [2, 8]])).problem
    start, pins_only = np.zeros(problem.unknown_count), np.arange(problem.unknown_count) < problem.free.count
    start[pins_only] = problem.free.vector
    x = start + 0.02 * problem.scale * np.random.default_rng(0).standard_normal((20, problem.unknown_count)) * pins_only

    def least(x):  # tau^2, the minimum of a parabola in a turn of 2,000 steps
        square = problem.turn(x, 2000).transmission[:, :-1] ** 2
        worst = square.argmin(1)
        before, lowest, after = (square[np.arange(len(x)), (worst + k) % square.shape[1]] for k in (-1, 0, 1))
        return lowest - (before - after) ** 2 / (8 * (before - 2 * lowest + after))

    unit = MARGIN_WEIGHT * problem.scale
    limit, slopes, turns = problem._turn_limit(x, np.zeros(20), None)
    assert turns.all()
    np.testing.assert_allclose(-limit[:, 0] / unit, least(x), atol=1e-8)
    h = 1e-5 * problem.scale
    by_x = [(least(x + h * to) - least(x - h * to)) / (2 * h) for to in np.eye(problem.unknown_count)[pins_only]]
    np.testing.assert_allclose(-slopes[:, 0, pins_only] / unit, np.transpose(by_x), atol=3e-6)


def test_a_free_start_of_given_values_is_an_unknown():
    """Without values there is no start, and a given start is not sought."""
    targets, values = [[6, 12], [4, 10], [2, 8]], [0.0, 0.5, 1.0]
    goals = [udk.PathGoal("P", targets), udk.PathGoal("P", targets, values), udk.PathGoal("P", targets, values, "free")]
    problems = [udk.DesignSearch(FOUR_BAR, goal, ["pin.P"], rotation=False).problem for goal in goals]
    assert [problem.unknown_count - problem.free.count for problem in problems] == [0, 0, 1]


@pytest.mark.slow
def test_geared_cam_and_redundant_mechanisms_are_designed():
    places = np.array([[0, 0], [2, 1], [3, 3], [1, 4], [-1, 3], [0, 0.0]])
    geared = udk.design(GEARED, udk.PathGoal("P", places), starts=60, results=1)
    assert geared[0].loss < 0.5 and geared[0].turns
    plane = udk.design(PARALLELOGRAM, udk.PathGoal("P", [[3, 4], [2, 5], [1, 4.5], [0.5, 4]]), ["pin.P"], starts=30, results=1)
    radius = np.hypot(1, 2)  # P goes along a circle of the cranks' radius, wherever it is
    moved = udk.kinematics(plane[0].mechanism, "motor", np.linspace(0, 2, 5) + plane[0].values[0])
    path = np.asarray(udk.path(plane[0].mechanism, moved, "P"))
    chord = np.linalg.norm(path[1:] - path[0], axis=1)
    np.testing.assert_allclose(chord, 2 * radius * np.sin(np.linspace(0, 2, 5)[1:] / 2), rtol=1e-9)
    angles = 2 * np.pi * np.arange(12) / 12
    goals = [udk.FunctionGoal("body.follower.y", angles, 0.01 * (1 - np.cos(angles))), udk.TorqueGoal(most=2.0)]
    ends = {"cam.cam1.profile.radius": (0.02, 0.06)}
    cam = udk.design(KINDS["radii of a cam"][0], goals, ["cam.cam1.profile.radius"], bounds=ends, starts=30, results=1)
    assert cam[0].loss < 1e-20 and np.max(cam[0].measures[0]) <= 2.0


@pytest.mark.slow
def test_areas_bounds_and_lengths_hold():
    limits = {"areas": {"O": (-2, -2, 1.5), "C": [[10, 0], [14, 1], [12, 5]]}, "bounds": {"pin.O": (-3.4, -1.9)}}
    goal = udk.PathGoal("P", [[6, 12], [4, 10], [2, 8]])
    found = udk.design(FOUR_BAR, goal, **limits, lengths={("O", "A"): (2.0, 4.0)}, starts=60, results=2)
    assert len(found)
    for one in found:
        ground, joint, place = (np.asarray(one.pins[name]) for name in "OAC")
        assert np.linalg.norm(ground + 2) < 1.5 + 1e-5
        corners = np.array(limits["areas"]["C"], float)
        way = np.roll(corners, -1, 0) - corners
        assert np.all(way[:, 0] * (place - corners)[:, 1] - way[:, 1] * (place - corners)[:, 0] > -1e-4)
        assert np.all(ground <= -1.9 + 1e-6) and 2.0 - 1e-6 <= np.linalg.norm(joint - ground) <= 4.0 + 1e-6
    for bad in ({"Q": (0, 0, 1)}, {"O": (0, 0, -1)}, {"O": [[0, 0], [1, 0], [0.2, 0.2], [0, 1]]}):
        with pytest.raises(udk.SceneError, match="areas"):
            udk.DesignSearch(FOUR_BAR, udk.PathGoal("P", [[0, 0], [1, 1]]), areas=bad)


BY_LENGTHS = udk.Drawing(
    pins={"O": (0, 0), "A": udk.polar("O", 5, 60), "C": (10, 0)}
    | {"B": udk.circles(("A", "C"), (11, 9), "left"), "P": udk.polar("A", 6, 40, line=("A", "B"))},
    links={"crank": {"pins": ["O", "A"], "mass": 1.0}, "coupler": {"pins": ["A", "B", "P"], "mass": 1.0}}
    | {"rocker": {"pins": ["C", "B"], "mass": 1.0}},
    ground=["O", "C"],
    motors={"motor": {"pin": "O", "speed": "1 rad/s"}},
    units={"angle": "deg"},
)


@pytest.mark.slow
def test_limits_of_pins_by_lengths_have_exact_derivatives():
    goal, lengths = udk.PathGoal("P", [[6, 12], [4, 10], [2, 8]]), {("B", "P"): (1.0, 2.0), ("O", "A"): (1.0, np.inf)}
    areas = {"P": (0, 0, 1), "B": [[10, 0], [14, 1], [12, 5]]}
    problem = udk.DesignSearch(BY_LENGTHS, goal, lengths=lengths, areas=areas).problem
    assert problem.free.names == ("pin.O", "pin.A.length", "pin.A.angle", "pin.C", "pin.B.length", "pin.P.length", "pin.P.angle")
    assert np.all(problem.low[[2, 6, 7, 8]] >= 0.0) and problem.low[3] == -np.inf  # lengths are positive
    x = problem.free.vector[None] * [[1.0], [1.01]]
    values, slopes = problem.lengths(x)
    steps = 1e-6 * np.eye(x.shape[1])
    ends = [problem.lengths((x[:, None] + sign * steps).reshape(-1, x.shape[1]))[0] for sign in (1, -1)]
    differences = ((ends[0] - ends[1]) / 2e-6).reshape(2, x.shape[1], -1).swapaxes(1, 2)
    np.testing.assert_allclose(slopes, differences, atol=1e-7)
    pins = BY_LENGTHS.pins
    np.testing.assert_allclose(values[0, :2], [1.0 - (d := np.linalg.norm(pins["B"] - pins["P"])), d - 2.0])


@pytest.mark.slow  # the test above covers the lengths
def test_a_design_over_lengths_finds_the_lengths():
    wanted = {"pin.B.length": (10.0, 10.0), "pin.A.length": 4.0, "pin.P.length": 7.0}
    truth = BY_LENGTHS.mechanism().with_parameters(wanted)
    turn = udk.kinematics(truth, "motor", np.linspace(1.0, 1.0 + 2 * np.pi, 12, endpoint=False))
    goal = udk.PathGoal("P", np.asarray(udk.path(truth, turn, "P")))
    found = udk.design(BY_LENGTHS, goal, list(wanted), lengths={("A", "B"): (9.5, 30.0)}, starts=20, results=1)[0]
    assert found.loss < 1e-20
    for name, value in wanted.items():
        np.testing.assert_allclose(found.mechanism.parameters()[name], value, rtol=1e-9)


@pytest.mark.slow
def test_places_that_are_one_do_not_shrink_the_mechanism_to_a_point():
    found = udk.design(FOUR_BAR, udk.PathGoal("P", [[1, 1], [1, 1]]), starts=20, results=1)
    assert found[0].loss < 1e-20
    assert all(np.linalg.norm(found[0].pins[a] - found[0].pins[b]) > 0.01 for a, b in ("OA", "AB", "CB", "OC"))


def test_mistakes_are_named():
    goal = udk.PathGoal("P", [[0, 0], [1, 1]])
    with pytest.raises(udk.SceneError, match=r'no measure of the goal depends on "link\.crank\.mass"'):
        udk.design(FOUR_BAR, goal, free=["pin.A", "link.crank.mass"])
    with pytest.raises(udk.SceneError, match=r'no number named "pin\.Q"'):
        udk.design(FOUR_BAR, goal, free=["pin.Q"])
    with pytest.raises(udk.SceneError, match="low must not exceed high"):
        udk.design(FOUR_BAR, goal, bounds={"pin.A": (1, 0)})
    with pytest.raises(udk.SceneError, match='no pin named "Q"'):
        udk.design(FOUR_BAR, goal, lengths={("A", "Q"): (0, 1)})
    with pytest.raises(udk.SceneError, match="neither a body nor a pin"):
        udk.design(FOUR_BAR, udk.PathGoal("Q", [[0, 0], [1, 1]]))
    with pytest.raises(ValueError, match="targets must have the shape"):
        udk.PathGoal("P", [0, 1, 2])
    with pytest.raises(ValueError, match="one value for each target"):
        udk.PathGoal("P", [[0, 0], [1, 1]], [0.0])
    with pytest.raises(ValueError, match="start must be"):
        udk.PathGoal("P", [[0, 0]], [0.0], start="fre")
    with pytest.raises(ValueError, match="transmission"):
        udk.design(FOUR_BAR, goal, transmission=2.0)
    with pytest.raises(TypeError, match="drawing must be"):
        udk.design("four_bar.toml", goal)  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_a_curve_that_wants_dead_points_has_designs_and_failures_say_why():
    """The best four-bars for a heart pass dead points. The design stays away from them, as its motion confirms."""
    a = np.linspace(0.0, 2.0 * np.pi, 17)
    heart = np.stack([16 * np.sin(a) ** 3, 13 * np.cos(a) - 5 * np.cos(2 * a) - 2 * np.cos(3 * a) - np.cos(4 * a)], 1)
    found = udk.design(FOUR_BAR, udk.PathGoal("P", heart), starts=60, results=2)
    assert len(found) and not found.reason and found[0].loss < 0.05 * 32.0**2
    path = udk.path(found[0].mechanism, udk.kinematics(found[0].mechanism, "motor", found[0].values), "P")
    np.testing.assert_allclose(np.sum((np.asarray(path) - heart) ** 2), found[0].loss, rtol=1e-6)
    apart = {("O", "A"): (2000.0, 3000.0), ("O", "C"): (1.0, 2.0)}
    none = udk.design(
        FOUR_BAR, udk.PathGoal("P", heart), bounds={"pin.A": (-50.0, 50.0), "pin.O": (-50.0, 50.0)}, lengths=apart, starts=8
    )
    assert not len(none) and "exceeds the length O-A" in none.reason and "nothing was found" in str(none)


def test_a_start_without_a_link_is_no_start():
    """Clipped to a corner of their bounds, two pins coincide: a crank of no length has no derivatives, and no step."""
    pins = {"O": (0, 0), "A": (0.5, 0.5), "B": (2, 1.5), "P": (1, 2), "C": (2, 0)}
    links = {name: {"pins": pair, "mass": 1.0} for name, pair in (("crank", "OA"), ("coupler", "ABP"), ("rocker", "CB"))}
    links = {name: link | {"pins": list(link["pins"])} for name, link in links.items()}
    drawing = udk.Drawing(pins=pins, links=links, ground=["O", "C"], motors={"motor": {"pin": "O", "speed": 6.0}})
    bounds = {f"pin.{name}": ([-4.0, -4.0], [4.0, 4.0]) for name in pins}
    path = udk.PathGoal("P", [[-1, 1], [-0.5, 0], [0, -1], [0.5, 0], [1, 1]])
    found = udk.design(drawing, path, starts=60, results=1, bounds=bounds)
    assert found[0].loss < 1e-20


def test_one_singular_matrix_of_a_batch_is_no_error():
    A = np.array([np.diag([2.0, 4.0]), np.zeros((2, 2)), np.full((2, 2), np.nan), np.eye(2)])
    expected = [[0.5, 0.25], [np.nan] * 2, [np.nan] * 2, [1.0, 1.0]]
    np.testing.assert_array_equal(solve_each(A, np.ones((4, 2))), expected)
    np.testing.assert_array_equal(solve_each(A[::3], np.ones((2, 2))), expected[::3])
