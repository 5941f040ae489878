"""Followers that slide past the centre of a cam, or swing, move by its laws as exactly as those in line: against own formulas."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.scene.elements.profiles import SwingProfile

SPEED = 10 * np.pi  # 300 rpm
LAW = {"base": 40, "law": ["cycloidal", "dwell", "4-5-6-7", "dwell"], "angle": [120, 60, 90, 90]}
LIFT, SWING = {"lift": [20, 0, -20, 0]}, {"swing": [25, 0, -25, 0]}
AT = np.array([10.0, 45.0, 90.0, 119.0, 150.0, 200.0, 225.0, 265.0, 330.0])
WHEEL = {"mass": 1, "width": 60}
OFFSET = 12 + 1j * (40**2 - 12**2) ** 0.5
PIVOT, ARM = 90.0, 70.0


def shares():
    """Shares of the step at the turns AT, and their first two derivatives by time: (T, 3)."""
    x, y = AT / 120, (AT - 180) / 90
    risen = [x - np.sin(2 * np.pi * x) / (2 * np.pi), 1 - np.cos(2 * np.pi * x), 2 * np.pi * np.sin(2 * np.pi * x)]
    fallen = [35 * y**4 - 84 * y**5 + 70 * y**6 - 20 * y**7, 140 * y**3 * (1 - y) ** 3, 420 * y**2 * (1 - y) ** 2 * (1 - 2 * y)]
    rate, back = SPEED / np.deg2rad(120), SPEED / np.deg2rad(90)
    parts = [
        [r * rate**k, float(k == 0) + 0 * x, (1.0 if k == 0 else 0.0) - f * back**k]
        for k, (r, f) in enumerate(zip(risen, fallen, strict=True))
    ]
    return np.stack([np.select([AT < 120, AT < 180, AT < 270], p, 0.0) for p in parts], 1)


def turned_about(arm, angle):
    """The vector arm exp(i angle), and its first two derivatives by time, of an angle with two derivatives (T, 3): (T, 3)."""
    place = arm * np.exp(1j * angle[:, 0])
    return np.stack([place, 1j * angle[:, 1] * place, (1j * angle[:, 2] - angle[:, 1] ** 2) * place], 1)


def follower_of(pins, follower, profile, slides=(), clockwise=False, **more):
    """The mechanism of a cam about O, with a follower at P; pins are complex numbers (mm)."""
    links = {"cam": {"pins": ["O"], **WHEEL}, "follower": {"pins": follower, **WHEEL}}
    motors = [{"pin": "O", "speed": "-300 rpm" if clockwise else "300 rpm"}]
    cams = [{"pins": ["O", "P"], "profile": profile | ({"clockwise": True} if clockwise else {}), **more}]
    places = {name: (float(np.real(z)), float(np.imag(z))) for name, z in pins.items()}
    ground, units = [pin for pin in pins if pin != "P"], {"length": "mm", "angle": "deg"}
    return udk.Drawing(places, links, ground, list(slides), cams=cams, motors=motors, units=units).mechanism()


def motion(mechanism, clockwise=False):
    """Complex places, velocities and accelerations of P (T, 3)."""
    return udk.motion_at(mechanism, (-AT if clockwise else AT).tolist()).pins["P"] @ np.array([1, 1j])


def sliding(direction=1j, clockwise=False):
    slide = {"link": "follower", "direction": [np.real(direction), np.imag(direction)]}
    return follower_of({"O": 0, "P": -1j * direction * OFFSET}, ["P"], LAW | LIFT, [slide], clockwise)


@pytest.mark.parametrize(
    ("direction", "clockwise"),
    [(1j, False), *(pytest.param(*x, marks=pytest.mark.slow) for x in ((1j, True), (0.6 - 0.8j, False)))],
)
def test_a_follower_slides_past_the_centre_by_the_laws(direction, clockwise):
    expected = 0.02 * shares() + [1e-3 * OFFSET.imag, 0, 0]
    along = motion(sliding(direction, clockwise), clockwise) / direction
    assert_allclose(along, expected - 1j * np.array([1e-3 * OFFSET.real, 0, 0]), rtol=1e-11, atol=1e-11)


def swinging(side=1, clockwise=False):
    psi = np.arccos((PIVOT**2 + ARM**2 - 40**2) / (2 * PIVOT * ARM))
    pins = {"O": 0, "Q": PIVOT, "P": PIVOT - ARM * np.exp(-1j * side * psi)}
    return psi, follower_of(pins, ["Q", "P"], LAW | SWING, clockwise=clockwise)


@pytest.mark.slow
@pytest.mark.parametrize(("side", "clockwise"), [(1, False), (1, True), (-1, False)])
def test_a_follower_swings_by_the_laws(side, clockwise):
    psi, mech = swinging(side, clockwise)
    angle = -side * (np.deg2rad(25) * shares() + [psi, 0, 0])
    expected = [1e-3 * PIVOT, 0, 0] + turned_about(-1e-3 * ARM, angle)
    assert_allclose(motion(mech, clockwise), expected, rtol=1e-11, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, -1])
def test_a_flat_face_swings_by_the_laws(side):
    """The face is 10 mm from the pivot, towards the cam; P is a point of it."""
    normal = np.exp(1j * side * np.arccos((40 + 10) / PIVOT))
    arm = (-10 + 60j * side) * normal
    face = [normal.real, normal.imag]
    mech = follower_of({"O": 0, "Q": PIVOT, "P": PIVOT + arm}, ["Q", "P"], LAW | SWING, face=face)
    expected = [1e-3 * PIVOT, 0, 0] + turned_about(1e-3 * arm, -side * np.deg2rad(25) * shares())
    assert_allclose(motion(mech), expected, rtol=1e-11, atol=1e-10)


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("pivot", [PIVOT, -PIVOT])
def test_a_swinging_follower_is_an_arm_from_its_pivot_on_the_side_that_the_sign_says(pivot, clockwise):
    angles, swings = np.deg2rad(LAW["angle"]), np.deg2rad(SWING["swing"])
    profile = SwingProfile(LAW["base"], LAW["law"], angles, swings, pivot=pivot, arm=ARM, start=0.3, clockwise=clockwise)
    for turn in (0.4, 2.5, 3.9):
        distance = float(profile(turn))
        point = distance * np.exp(1j * float(profile.sight(distance, flat=False)))  # with the pivot on the x axis
        assert abs(point - PIVOT) == pytest.approx(ARM, rel=1e-12) and np.sign(point.imag) == np.sign(pivot)
        assert float(profile.turn(distance, float(profile.bearing(turn)))) == pytest.approx(turn, rel=1e-12)


def test_a_file_keeps_what_guides_the_follower():
    mech = swinging()[1]
    assert "swing = [25.0, 0.0, -25.0, 0.0]}" in udk.dumps(mech)
    by_hand = udk.Mechanism(mech.bodies, mech.joints, mech.drivers, gravity=mech.gravity)
    text = udk.dumps(by_hand)
    assert "pivot = 0.09" in text
    assert udk.dumps(udk.loads(text)) == text
    profile = mech.joints["cam1"].profile
    assert_allclose([profile.arm, profile.start], [0.07, 0.0], atol=1e-15)
    with pytest.raises(udk.SceneError, match=r"profile\.pivot: missing"):
        udk.loads(text.replace("pivot = 0.09, ", ""))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"swing": [25, 0, -20, 0]}, "the swings must add up to zero"),
        ({"base": 10}, "base: the follower can be at 0.02292 to 0.1571 m from the centre, not at 0.01 m"),
        ({"swing": [160, 0, -160, 0]}, "swing: the follower is stretched out 155.6 deg .* should swing 160 deg"),
    ],
)
def test_laws_that_a_swinging_follower_cannot_follow(change, problem):
    with pytest.raises(udk.SceneError, match=problem):
        follower_of({"O": 0, "Q": PIVOT, "P": 30 + 30j}, ["Q", "P"], LAW | SWING | change)


def test_laws_that_a_sliding_follower_cannot_follow():
    slides = [{"link": "follower", "direction": [0, 1]}]
    with pytest.raises(udk.SceneError, match=r"a circle of 0.04 m does not reach the line of the follower, 0.05 m off"):
        follower_of({"O": 0, "P": 50 + 30j}, ["P"], LAW | LIFT, slides)
    with pytest.raises(
        udk.SceneError, match='swing: "follower" must turn about one pin of the link, or the ground, that carries'
    ):
        follower_of({"O": 0, "P": 30j}, ["P"], LAW | SWING, slides)
