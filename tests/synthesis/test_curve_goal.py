"""The goal of a drawn curve: its distance and derivatives, designs with bounds and gaps, files, and mistakes."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.synthesis.curves.comparison import compare
from udkjax.synthesis.curves.targets import WantedCurve, as_points, chamfer, resampled
from udkjax.synthesis.fit import deviation_of
from udkjax.synthesis.goal_file import read_design
from udkjax.synthesis.search import loss_of
from udkjax.synthesis.starts import find_starts

FOUR_BAR = udk.Drawing(
    pins={"O": (0, 0), "A": (3, 4), "B": (12, 9), "P": (6, 12), "C": (10, 0)},
    links={
        name: udk.Link(list(pins), mass=1.0, width=None if name == "coupler" else 0.4)
        for name, pins in (("crank", "OA"), ("coupler", "ABP"), ("rocker", "CB"))
    },
    ground=["O", "C"],
    motors={"motor": {"pin": "O", "speed": 6.0}},
)
ANGLES = np.linspace(0.0, 2 * np.pi, 60)
BEAN = np.stack([6.0 * np.cos(ANGLES) + np.cos(2 * ANGLES), 3.0 * np.sin(ANGLES)], 1)
CORNER = np.array([[0.0, 6.0], [0.0, 0.0], [4.0, 0.0]])
BOUNDS = {f"pin.{name}": (-25.0, 25.0) for name in "OABPC"}


def random_curves(rng, K, N, is_whole):
    t = np.linspace(0.0, 2 * np.pi if is_whole else 5.0, N, endpoint=not is_whole)
    size, k = rng.normal(size=(6, K, 1)) + 1j * rng.normal(size=(6, K, 1)), np.arange(-2, 4)[:, None, None]
    return (size * np.exp(1j * k * t) / (1 + k * k)).sum(0)


@pytest.mark.parametrize("curve", [BEAN, CORNER])
def test_the_smooth_distance_is_chamfer_and_its_derivatives_are_exact(curve):
    rng, wanted = np.random.default_rng(0), WantedCurve(curve)
    c, target = random_curves(rng, 6, 200, wanted.is_closed), wanted.target(400)
    fine = [chamfer(as_points(resampled(as_points(z), 2000, wanted.is_closed)), wanted.fine) for z in c]
    np.testing.assert_allclose(compare(c, target, wanted.is_closed, 1e-6).distance, fine, rtol=5e-3)
    found = compare(c, target, wanted.is_closed, 0.01)
    np.testing.assert_allclose(found.of_curve.sum(1) + found.of_target.sum(1), found.distance, rtol=1e-12)
    for _ in range(5):
        way = 1e-7 * (rng.normal(size=c.shape) + 1j * rng.normal(size=c.shape))
        change = (
            compare(c + way, target, wanted.is_closed, 0.01).distance - compare(c - way, target, wanted.is_closed, 0.01).distance
        )
        exact = 2.0 * np.real(np.conj(found.pull) * way).sum(1)
        np.testing.assert_allclose(change, exact, atol=1e-5 * np.abs(exact).max())


@pytest.mark.slow
@pytest.mark.parametrize("curve", [BEAN, CORNER])
def test_the_derivatives_of_the_loss_are_exact(curve):
    problem = udk.DesignSearch(FOUR_BAR, udk.CurveGoal("P", curve, samples=24)).problem
    trials = find_starts(problem, 4, 200, np.random.default_rng(0))
    margin = np.full(len(trials.x), 1e-3)
    found = problem.evaluate(trials, margin)
    slopes = 2.0 * np.einsum("mjgp,mjg->mp", found.by_unknowns, found.r)
    for k in range(problem.unknown_count):
        step = 1e-6 * np.eye(problem.unknown_count)[k]
        ends = [trials._replace(x=x, s=problem.values_at(x, trials.s)) for x in (trials.x + step, trials.x - step)]
        above, below = (loss_of(problem.evaluate(end, margin)) for end in ends)
        np.testing.assert_allclose(slopes[:, k], (above - below) / 2e-6, atol=1e-6 * np.abs(slopes).max())


@pytest.mark.slow
def test_a_design_draws_the_curve_within_bounds_and_keeps_a_gap():
    goals = [udk.CurveGoal("P", BEAN), udk.GapGoal("crank", "rocker", least=1.0)]
    found = udk.design(FOUR_BAR, goals, bounds=BOUNDS, starts=60, results=2)
    best, wanted = found[0], WantedCurve(BEAN)
    assert best.turns and all(np.abs(np.asarray(place)).max() < 25.001 for place in best.pins.values())
    np.testing.assert_allclose(np.sum(best.residuals**2), best.loss, rtol=1e-3)
    path = np.asarray(udk.path(best.mechanism, best.motion(2001), "P"))
    error = wanted.error((path @ [1, 1j] - wanted.middle) / wanted.scale)
    assert error < 0.06 and best.measures[0].min() > 1.0 * (1 - 1e-2)
    assert deviation_of(best, goals[0]).is_fit


@pytest.mark.slow
def test_a_part_of_the_turn_draws_an_open_curve():
    goal = udk.CurveGoal("P", CORNER)
    best = udk.design(FOUR_BAR, goal, bounds=BOUNDS, starts=60, results=1)[0]
    assert best.turns and 0.7 <= np.ptp(best.values) < 2 * np.pi
    motion = udk.kinematics(best.mechanism, "motor", np.linspace(best.values[0], best.values[-1], 2001))
    path, wanted = np.asarray(udk.path(best.mechanism, motion, "P")), WantedCurve(CORNER)
    assert wanted.error((path @ [1, 1j] - wanted.middle) / wanted.scale) < 0.05


def test_a_file_gives_a_curve_in_its_unit(tmp_path):
    udk.save(FOUR_BAR.mechanism(), tmp_path / "bar.toml")
    (tmp_path / "curve.csv").write_text("x, y\n0, 6000\n0, 0\n4000, 0\n", encoding="utf-8")
    text = 'mechanism = "bar.toml"\nunits.length = "mm"\n[goal]\nkind = "curve"\npin = "P"\npoints = "curve.csv"\nsamples = 12\n'
    (tmp_path / "goal.toml").write_text(text, encoding="utf-8")
    search = read_design(tmp_path / "goal.toml")
    assert isinstance(search, udk.DesignSearch)
    goal = search.problem.goal
    assert isinstance(goal, udk.CurveGoal)
    np.testing.assert_allclose(goal.points, CORNER)
    assert not goal.is_whole and goal.extras == 1
    (tmp_path / "goal.toml").write_text(text.replace("curve.csv", "bar.toml"), encoding="utf-8")
    with pytest.raises(udk.SceneError, match=r"goal.points: line 1 of bar.toml must be two numbers"):
        read_design(tmp_path / "goal.toml")


@pytest.mark.parametrize(
    ("given", "message"),
    [(([[0, 0], [1, 1]],), "^points must have at least 3 points"), ((CORNER, "half"), "part"), ((CORNER, "free", 2), "samples")],
)
def test_goals_with_mistakes_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        udk.CurveGoal("P", *given)


def test_a_curve_needs_a_known_pin_and_a_driver_that_turns():
    with pytest.raises(udk.SceneError, match=r'"pin\.X" is neither a body nor a pin'):
        udk.DesignSearch(FOUR_BAR, udk.CurveGoal("X", CORNER))
    with pytest.raises(udk.SceneError, match="needs a driver that turns"):
        udk.DesignSearch(FOUR_BAR, udk.CurveGoal("P", CORNER), rotation=False)
