"""Ranges of links and transmission angles along a motion, compared with formulas."""

import jax
import numpy as np
import pytest

import udkjax as udk

CRANK_ROCKER = {"lengths": (0.5, 1.2, 0.8), "ground": 1.0}


def at_rocker_end(a, b, c, g, reach):
    """The angles of crank and rocker when crank and coupler are in line, with `reach` = b + a or b - a."""
    crank = np.arccos((reach**2 + g**2 - c**2) / (2 * reach * g)) + (np.pi if reach < b else 0.0)
    rocker = np.pi - np.arccos((c**2 + g**2 - reach**2) / (2 * c * g))
    return crank, rocker


def test_a_rocker_swings_between_its_dead_points():
    (a, b, c), g = CRANK_ROCKER["lengths"], CRANK_ROCKER["ground"]
    mech = udk.library.four_bar(np.pi / 3, **CRANK_ROCKER)
    (first, low), (second, high) = (at_rocker_end(a, b, c, g, reach) for reach in (b + a, b - a))
    start = np.pi / 3
    values = np.sort(np.append(np.linspace(start, start + 2 * np.pi, 9), [first + 2 * np.pi, second, np.pi, 2 * np.pi]))
    motion = udk.kinematics(mech, "body.crank.angle", values)
    found = udk.motion_ranges(mech, motion, "body.crank.angle")
    assert list(found.swings) == ["crank", "rocker"] and not found.strokes and list(found.transmission_angles) == ["C"]
    np.testing.assert_allclose(found.swings["crank"], 2 * np.pi, atol=1e-12)
    np.testing.assert_allclose(found.swings["rocker"], abs(high - low), atol=1e-12)
    angles = [np.arccos((b**2 + c**2 - (g + way * a) ** 2) / (2 * b * c)) for way in (-1, 1)]
    np.testing.assert_allclose(found.transmission_angles["C"], angles, atol=1e-12)
    assert list(udk.motion_ranges(mech, motion).transmission_angles) == ["B", "C"]
    assert "turns all the way round" in str(found) and "rocker" in str(found)
    with pytest.raises(udk.SceneError, match="craft"):
        udk.motion_ranges(mech, motion, "body.craft.angle")


def test_positions_that_are_not_reached_do_not_count():
    mech = udk.library.four_bar(np.pi / 3, lengths=(1.0, 1.5, 1.2), ground=2.2)
    values = np.linspace(np.pi / 3, 2.4, 9)
    motion = udk.kinematics(mech, "body.crank.angle", values)
    last = int(np.sum(motion.reached)) - 1
    assert 0 < last < 8
    found = udk.motion_ranges(mech, motion, "body.crank.angle")
    np.testing.assert_allclose(found.swings["crank"], values[last] - values[0], atol=1e-12)
    assert np.all(np.isfinite(found.transmission_angles["C"]))


@pytest.mark.slow
def test_a_slider_strokes_by_twice_its_crank():
    def stroke(r):
        mech = udk.library.slider_crank(0.3, 4.0, crank=r)
        motion = udk.kinematics(mech, "motor", np.array([0.3, np.pi, 2 * np.pi]))
        return udk.motion_ranges(mech, motion, "motor").strokes["slider"]

    value, slope = jax.value_and_grad(stroke)(0.5)
    np.testing.assert_allclose([value, slope], [1.0, 2.0], atol=1e-12)
