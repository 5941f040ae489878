"""Cams by laws of lift: exact displacements and derivatives, files, flat faces, and mistakes by name."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.scene.elements.profiles import LIFT_LAWS

LAW = {"base": 40, "law": ["cycloidal", "dwell", "3-4-5", "dwell"], "angle": [120, 60, 90, 90], "lift": [20, 0, -20, 0]}


def cam(profile=LAW, **more):
    links = {"cam": {"pins": ["O"], "mass": 1, "width": 60}, "follower": {"pins": ["P"], "mass": 1, "width": 10}}
    cams = [{"pins": ["O", "P"], "profile": profile, **more}]
    slides, motors = [{"link": "follower", "direction": [0, 1]}], [{"pin": "O", "speed": "300 rpm"}]
    units = {"length": "mm", "angle": "deg"}
    return udk.Drawing({"O": (0, 0), "P": (0, 40)}, links, ["O"], slides, cams=cams, motors=motors, units=units).mechanism()


@pytest.mark.parametrize("name", LIFT_LAWS)
def test_laws_rise_from_zero_to_one_with_zero_slopes_at_both_ends(name):
    law = LIFT_LAWS[name]
    slope, second = jax.grad(law), jax.grad(jax.grad(law))
    ends = np.array([0.0, 1.0])
    assert_allclose([law(x) for x in ends], [0.0, 0.0 if name == "dwell" else 1.0], atol=1e-14)
    assert_allclose([slope(x) for x in ends], 0.0, atol=1e-13)
    if name != "harmonic":
        assert_allclose([second(x) for x in ends], 0.0, atol=1e-12)
    peak = {"dwell": 0.0, "cycloidal": 2 * np.pi, "harmonic": np.pi**2 / 2, "3-4-5": 10 / 3**0.5, "4-5-6-7": 7.51318840439929}
    assert_allclose(np.max(np.abs(jax.vmap(second)(np.linspace(0.0, 1.0, 4001)))), peak[name], rtol=1e-5)


@pytest.mark.slow
def test_a_follower_moves_by_the_laws():
    mech = cam()
    at = np.array([30.0, 90.0, 150.0, 200.0, 330.0])
    found = udk.motion_at(mech, at.tolist()).pins["P"][:, :, 1]
    w, u = 10 * np.pi, (200 - 180) / 90
    rise, back = w / np.radians(120), w / np.radians(90)
    for k, x in ((0, 0.25), (1, 0.75)):
        height = 0.04 + 0.02 * (x - np.sin(2 * np.pi * x) / (2 * np.pi))
        assert_allclose(
            found[k], [height, 0.02 * rise, 0.02 * rise**2 * 2 * np.pi * np.sin(2 * np.pi * x)], rtol=1e-11, atol=1e-11
        )
    assert_allclose(found[2], [0.06, 0.0, 0.0], atol=1e-12)
    lift = 0.02 * np.array(
        [10 * u**3 - 15 * u**4 + 6 * u**5, 30 * u**2 - 60 * u**3 + 30 * u**4, 60 * u - 180 * u**2 + 120 * u**3]
    )
    assert_allclose(found[3], [0.06, 0.0, 0.0] - lift * [1, back, back**2], rtol=1e-11)
    assert_allclose(found[4], [0.04, 0.0, 0.0], atol=1e-12)
    assert_allclose(udk.motion_at(cam(LAW | {"clockwise": True}), [-30]).pins["P"][0, 0, 1], found[0, 0], rtol=1e-12)
    assert_allclose(udk.motion_at(cam(face=[0, 1]), at.tolist()).pins["P"][:, :, 1], found, atol=1e-11)


def test_a_file_keeps_the_laws():
    mech = cam(face="90 deg")
    text = udk.dumps(mech)
    assert (
        'law = ["cycloidal", "dwell", "3-4-5", "dwell"], angle = [120.0, 60.0, 90.0, 90.0], lift = [20.0, 0.0, -20.0, 0.0]}'
        in text
    )
    assert udk.dumps(udk.loads(text)) == text
    assert_allclose(mech.parameters()["cam.cam1.profile.lift"], [0.02, 0.0, -0.02, 0.0])
    by_hand = udk.Mechanism(mech.bodies, mech.joints, mech.drivers, gravity=mech.gravity)
    assert udk.dumps(udk.loads(udk.dumps(by_hand))) == udk.dumps(by_hand)
    slope = jax.grad(lambda b: mech.with_parameters({"cam.cam1.profile.base": b}).joints["cam1"].profile(np.pi / 3))(0.04)
    assert_allclose(slope, 1.0)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"angle": [120, 60, 90, 80]}, "profile.angle.*must add up to a whole turn"),
        ({"lift": [20, 0, -10, 0]}, "profile.lift.*must add up to zero"),
        (
            {"law": ["cycloid", "dwell", "3-4-5", "dwell"]},
            'profile.law.0.: must be one of .*not "cycloid"; did you mean "cycloidal"',
        ),
        ({"law": ["cycloidal", "dwell", "3-4-5"]}, "profile.law: must have as many entries as angle and lift"),
        ({"base": -1}, "profile.base: must be > 0"),
        ({"lft": 1}, 'profile.lft: unknown key; did you mean "lift"'),
    ],
)
def test_mistakes(change, problem):
    with pytest.raises(udk.SceneError, match=problem):
        cam(LAW | change)
