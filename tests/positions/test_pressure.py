"""Pressure angles of cams against formulas of textbooks: followers that slide in line and offset, that swing, and flat ones."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk

BASE, LIFT, OFFSET, RISE = 40.0, 20.0, 12.0, 120.0  # mm, deg
LAW = {"base": BASE, "law": ["cycloidal", "dwell", "harmonic", "dwell"]}
LAW |= {"angle": [RISE, 60, 120, 60], "lift": [LIFT, 0, -LIFT, 0]}
AT = np.array([10.0, 45.0, 60.0, 100.0, 150.0])  # deg
UPWARDS = [{"link": "follower", "direction": [0, 1]}]
WHEEL = {"mass": 1, "width": 10}


class States(NamedTuple):
    ts: jax.Array
    q: jax.Array
    v: jax.Array


def cam(pins, follower, ground, **choices):
    """A cam about the pin O with a follower at the pin P."""
    links = {"cam": {"pins": ["O"], **WHEEL}, "follower": {"pins": follower, "mass": 1, "width": 5}}
    cams, motors = {"cam": {"pins": ["O", "P"], **choices.pop("cam")}}, {"motor": {"pin": "O", "speed": "60 rpm"}}
    units = {"length": "mm", "angle": "deg"}
    return udk.Drawing(pins, links, ground, cams=cams, motors=motors, units=units, **choices).mechanism()


def pressure(mechanism):
    return udk.pressure_angle(mechanism, udk.kinematics(mechanism, "motor", np.deg2rad(AT)), "cam")


def cycloidal_rise():
    """Displacement (mm) and its derivative by the angle of the cam (mm/rad)."""
    x, beta = np.minimum(AT / RISE, 1.0), np.deg2rad(RISE)
    rise = LIFT * (x - np.sin(2 * np.pi * x) / (2 * np.pi))
    return rise, LIFT / beta * (1 - np.cos(2 * np.pi * x))


def eccentric():
    """A circle of radius 40 mm, 10 mm from the axis, as points: its polar radius at polar angles (deg), and its centre."""
    angle = np.deg2rad(np.arange(0.0, 360.0, 1.0))
    return {
        "angle": np.rad2deg(angle).tolist(),
        "radius": (10 * np.cos(angle) + np.sqrt(1600 - 100 * np.sin(angle) ** 2)).tolist(),
    }


@pytest.mark.slow
def test_of_a_follower_in_line():
    """The angle has the tangent s' / (r + s), and is zero in a dwell."""
    mech = cam(
        {"O": [0, 0], "P": [0, BASE]}, ["P"], ["O"], slides=[{"link": "follower", "direction": [0, 1]}], cam={"profile": LAW}
    )
    rise, slope = cycloidal_rise()
    np.testing.assert_allclose(pressure(mech), np.arctan2(slope, BASE + rise), atol=1e-9)


@pytest.mark.slow
def test_of_an_offset_follower():
    """The normal of a circle passes through its centre: its angle to the slide is asin((offset - x) / radius)."""
    place = [OFFSET, np.sqrt(1600 - (OFFSET - 10) ** 2)]
    mech = cam({"O": [0, 0], "P": place}, ["P"], ["O"], slides=UPWARDS, cam={"profile": eccentric()})
    centre = 10 * np.cos(np.deg2rad(AT))
    np.testing.assert_allclose(pressure(mech), np.abs(np.arcsin((OFFSET - centre) / 40)), atol=1e-7)  # the spline of 360 points


@pytest.mark.slow
def test_of_an_offset_follower_by_laws():
    """The angle has the tangent (s' - e) / (y0 + s)."""
    rise, slope = cycloidal_rise()
    height = np.sqrt(BASE**2 - OFFSET**2)
    mech = cam({"O": [0, 0], "P": [OFFSET, height]}, ["P"], ["O"], slides=UPWARDS, cam={"profile": LAW})
    np.testing.assert_allclose(pressure(mech), np.arctan2(np.abs(slope - OFFSET), height + rise), atol=1e-9)


@pytest.mark.slow
def test_of_a_swinging_follower():
    """The arm turns about Q: the angle is that between the normal and the perpendicular of the arm."""
    mech = cam({"O": [0, 0], "P": [50.0, 0], "Q": [50, 60]}, ["Q", "P"], ["O", "Q"], cam={"profile": eccentric()})
    motion = udk.kinematics(mech, "motor", np.deg2rad(AT))
    at = np.asarray(motion.path("follower", mech.joints["cam"].points[1])) * 1e3
    centre = 10 * np.stack([np.cos(np.deg2rad(AT)), np.sin(np.deg2rad(AT))], 1)
    normal, arm = at - centre, at - [50, 60]
    expected = np.arcsin(np.abs(np.sum(normal * arm, 1)) / (np.linalg.norm(normal, axis=1) * np.linalg.norm(arm, axis=1)))
    np.testing.assert_allclose(udk.pressure_angle(mech, motion, "cam"), expected, atol=1e-6)


@pytest.mark.slow
def test_of_a_flat_follower_in_line_is_zero():
    mech = cam({"O": [0, 0], "P": [0, BASE]}, ["P"], ["O"], slides=UPWARDS, cam={"profile": LAW, "face": [0, 1]})
    np.testing.assert_allclose(pressure(mech), 0.0, atol=1e-9)


@pytest.mark.slow
def test_limits_are_printed_with_the_characteristics():
    """The largest pressure angle of the rise, by a fine grid of the formula."""
    mech = cam(
        {"O": [0, 0], "P": [0, BASE]}, ["P"], ["O"], slides=[{"link": "follower", "direction": [0, 1]}], cam={"profile": LAW}
    )
    found = udk.characteristics(mech)
    x = np.linspace(0, 1, 2_000_001)
    angles = np.arctan2(
        LIFT / np.deg2rad(RISE) * (1 - np.cos(2 * np.pi * x)), BASE + LIFT * (x - np.sin(2 * np.pi * x) / 2 / np.pi)
    )
    returning = np.arctan2(LIFT / 2 * np.pi / np.deg2rad(120) * np.sin(np.pi * x), BASE + LIFT * (1 + np.cos(np.pi * x)) / 2)
    np.testing.assert_allclose(found.pressure_angles["cam"], [0, max(angles.max(), returning.max())], atol=1e-9)
    assert "pressure angle of cam" in repr(found)


@pytest.mark.slow
def test_places_that_are_not_reached_have_no_angle():
    mech = cam({"O": [0, 0], "P": [0, BASE]}, ["P"], ["O"], slides=UPWARDS, cam={"profile": LAW})
    motion = udk.kinematics(mech, "motor", np.deg2rad(AT))
    found = udk.pressure_angle(mech, States(motion.values, motion.q.at[2].set(jnp.nan), motion.v), "cam")
    assert np.isnan(found).tolist() == [False, False, True, False, False]


def test_mistakes():
    crank = udk.library.four_bar()
    with pytest.raises(udk.SceneError, match="is not a cam; there are none"):
        udk.pressure_angle(crank, udk.kinematics(crank, "body.crank.angle", [1.0]), "B")
