"""Belts and chains between two wheels: ratio, sense, files, mistakes, and their strands in a picture."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.show.player.marks.mark_kinds import MarkKind
from udkjax.show.player.marks.marks import marks


def drive(**belt):
    links = {"one": {"pins": ["O"], "mass": 1, "width": 60}, "two": {"pins": ["C"], "mass": 1, "width": 100}}
    motors = [{"pin": "O", "speed": "60 rpm"}]
    gears = [{"links": ["one", "two"], **belt}]
    return udk.Drawing(
        {"O": (0, 0), "C": (300, 0)}, links, ["O", "C"], gears=gears, motors=motors, units={"length": "mm"}
    ).mechanism()


@pytest.mark.parametrize(("belt", "ratio"), [("open", 0.6), ("crossed", -0.6)])
def test_a_belt_has_the_ratio_of_its_radii(belt, ratio):
    mech = drive(radii=[30, 50], belt=belt)
    assert_allclose(udk.motion_at(mech, 0.3).links["two"][0, 1], 2 * np.pi * ratio, rtol=1e-12)
    chain = drive(teeth=[18, 30], pitch=10.5, belt=belt)
    assert_allclose(udk.motion_at(chain, 0.3).links["two"][0, 1], 2 * np.pi * ratio, rtol=1e-12)
    assert_allclose(chain.joints["gear1"].radii, np.array([18, 30]) * 0.0105 / (2 * np.pi))
    for one in (mech, chain):
        assert udk.dumps(udk.loads(udk.dumps(one))) == udk.dumps(one)
    strands = [mark for mark in marks(mech, np.asarray(mech.q0)[None]) if mark["kind"] == MarkKind.ROD]
    ends = np.array([[mark["a"][1:], mark["b"][1:]] for mark in strands])
    assert len(strands) == 2
    for k, (centre, radius) in enumerate((((0.0, 0.0), 0.03), ((0.3, 0.0), 0.05))):
        arms = ends[:, k] - centre
        assert_allclose(np.hypot(*arms.T), radius, rtol=1e-12)
        assert_allclose(np.sum(arms * (ends[:, 1] - ends[:, 0]), axis=1), 0.0, atol=1e-15)  # tangents
    crosses = ends[0, 0, 1] * ends[0, 1, 1] < 0
    assert crosses == (belt == "crossed")


@pytest.mark.parametrize(
    ("belt", "problem"),
    [
        ({"teeth": [18, 30], "belt": "open"}, "belt: give radii, or for a chain teeth and a pitch"),
        ({"radii": [30, 50], "belt": "open", "internal": True}, "internal: a belt is open or crossed"),
        ({"teeth": [18, 30], "pitch": 10}, "pitch: is that of a chain"),
        ({"radii": [30, 50], "belt": "closed"}, 'belt: must be one of "open", "crossed"'),
        ({"radii": [30, 50]}, "wheels of these radii are"),
    ],
)
def test_mistakes(belt, problem):
    with pytest.raises(udk.SceneError, match=problem):
        drive(**belt)
