"""The goal of a gap between links: its measure against `gaps`, its derivatives, and a design that keeps it."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.positions.gaps.arithmetic import signed_distance_of
from udkjax.positions.gaps.convex import signed_distance
from udkjax.positions.gaps.shapes import hull

PINS = {"O": [0.0, 0.0], "A": [0.03, 0.04], "B": [0.16, 0.11], "C": [0.18, 0.0], "P": [0.1, 0.15]}
LINKS = {"crank": (["O", "A"], 0.01), "coupler": (["A", "B", "P"], None), "rocker": (["B", "C"], 0.015)}
DRAWING = udk.Drawing(
    pins=PINS,
    links={name: udk.Link(pins, mass=1.0, width=width) for name, (pins, width) in LINKS.items()},
    ground=["O", "C"],
    motors={"motor": {"pin": "O", "speed": 1.0}},
)
PATH = udk.PathGoal("P", [[0.1, 0.15], [0.09, 0.151], [0.08, 0.15]])


@pytest.mark.parametrize("counts", [(1, 1), (1, 2), (2, 2), (2, 4), (3, 5), (4, 1)])
def test_distances_by_arithmetic_are_those_of_arrays(counts):
    rng = np.random.default_rng(sum(counts))
    overlaps = 0
    for _ in range(20):
        figures = []
        for count in counts:
            while len(corners := hull(points := rng.normal(size=(count, 2)))) < count:
                pass
            figures.append(points[corners] + 0.5 * rng.normal(size=2))
        wanted = float(signed_distance(*(x[..., None] for x in figures))[0])
        assert float(signed_distance_of(*figures)) == pytest.approx(wanted, abs=1e-14)
        overlaps += wanted < 0
    assert overlaps > 0 or min(counts) == 1


def test_the_measure_is_the_gap_of_each_position_and_its_derivatives_are_exact():
    goal = udk.GapGoal("crank", "rocker", least=0.1, samples=40)
    search = udk.DesignSearch(DRAWING, [PATH, goal], ["pin.A", "pin.B", "link.rocker.width"])
    (term,), x = search.problem.terms, search.problem.free.vector[None]
    found, slopes, there = term.measures(x)
    assert there.all()
    least = udk.gaps(DRAWING.mechanism(), pairs=[("crank", "rocker")]).least
    assert least.distance <= found.min() <= least.distance + 1e-3
    for k in range(x.shape[1]):
        step = 1e-6 * np.eye(x.shape[1])[k]
        difference = (term.measures(x + step)[0] - term.measures(x - step)[0]) / 2e-6
        np.testing.assert_allclose(slopes[..., k], difference, atol=1e-8)


def test_a_design_keeps_the_gap():
    goal = udk.GapGoal("crank", "rocker", least=0.1)
    assert udk.gaps(DRAWING.mechanism()).least.distance < 0.09
    lengths = {("O", "A"): (0.02, 0.2), ("O", "C"): (0.05, 0.4)}
    best = udk.design(DRAWING, [PATH, goal], ["pin.O", "pin.A", "pin.B", "pin.C"], lengths=lengths, starts=10)[0]
    proven = udk.gaps(best.mechanism, "motor", pairs=[("crank", "rocker")]).least
    assert best.loss < 1e-12 and proven.bound > 0.1 * (1 - 1e-3)


def test_wrong_names_and_missing_shapes_are_named():
    with pytest.raises(udk.SceneError, match='no link named "roker"; did you mean "rocker"'):
        udk.DesignSearch(DRAWING, [PATH, udk.GapGoal("crank", "roker", least=0.1)], ["pin.A"])
    with pytest.raises(udk.SceneError, match="the ground has no outline"):
        udk.DesignSearch(DRAWING, [PATH, udk.GapGoal("crank", "ground", least=0.1)], ["pin.A"])
    floor = {"ground": [[-1.0, -0.3], [-1.0, -0.4], [1.0, -0.4], [1.0, -0.3]]}
    goal = udk.GapGoal("crank", "ground", floor, least=0.01, samples=4)
    (term,) = udk.DesignSearch(DRAWING, [PATH, goal], ["pin.A"]).problem.terms
    assert term.measures(np.array([PINS["A"]]))[0].min() == pytest.approx(0.3 - 0.05 - 0.005, abs=0.02)
