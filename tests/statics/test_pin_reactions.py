"""Reactions by pin: those of all links at one pin, in ground axes, balance."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.statics.reaction_peaks import RestingPositions, cam_forces


def test_the_forces_of_all_links_at_a_pin_balance():
    pins = {"O": [0.0, 0.0], "B": [0.3, 0.0], "C": [0.6, 0.1], "D": [0.4, -0.3]}
    links = {name: udk.Link(["B", end], mass=1.0) for name, end in (("one", "O"), ("two", "C"), ("three", "D"))}
    mech = udk.Drawing(pins, links, ["O"]).mechanism()
    sol = udk.simulate(mech, np.linspace(0.0, 0.2, 3))
    found, by_joint = udk.pin_reactions(mech, sol), udk.reactions(mech, sol)
    assert "B-2" in mech.joints and set(found) == {"O", "B"} and set(found["B"]) == {"one", "two", "three"}
    total = sum(np.asarray(load) for load in found["B"].values())
    size = max(np.abs(np.asarray(load)).max() for load in found["B"].values())
    assert size > 1.0
    assert_allclose(total, np.zeros((3, 3)), rtol=0, atol=1e-12 * size)
    shared = (
        by_joint["B"]["one"][:, :2] + by_joint["B-2"]["one"][:, :2] if "one" in by_joint["B-2"] else by_joint["B"]["one"][:, :2]
    )
    assert_allclose(found["B"]["one"][:, :2], shared, rtol=0, atol=1e-12 * size)
    # Newton's law of the outer link, which nothing else holds.
    a = np.asarray(udk.accelerations(mech, 0.0, sol.q[0], sol.v[0]))[mech.body_names.index("two")]
    assert_allclose(found["B"]["two"][0, :2], a[:2] + [0.0, 9.81], rtol=0, atol=1e-9 * size)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_cam_would_have_to_pull_above_its_jump_speed(share, side):
    """A follower of weight m g on the profile r + e cos(angle) accelerates at -e w^2 cos(w t). It jumps if e w^2 > g."""
    r, e, angle = 0.05, 0.01, np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
    speed, pins = share * np.sqrt(9.81 / e), {"O": (0.0, 0.0), "P": (0.0, r)}
    mech = udk.Drawing(
        pins,
        {"cam": udk.Link(["O"], mass=1.0, width=0.05), "follower": udk.Link(["P"], mass=2.0, width=0.02)},
        ground=["O"],
        slides={"guide": {"link": "follower", "direction": np.pi / 2}},
        cams={"lift": {"pins": ["O", "P"], "profile": {"angle": angle, "radius": r + e * np.cos(angle)}}},
        motors={"motor": {"pin": "O", "speed": side * speed}},
    ).mechanism()
    ts = np.linspace(0.0, 2 * np.pi / speed, 73)
    motion = udk.kinematics(mech, None, ts)
    pressed, y = cam_forces(mech, motion)["lift"], motion.q[:, 1, 1]
    exact = r + e * np.cos(np.pi / 2 - side * speed * ts)
    assert_allclose(y, exact, atol=1e-5 * r)
    upwards = 2.0 * (9.81 - e * speed**2 * np.cos(np.pi / 2 - side * speed * ts))
    slope = e * np.sin(np.pi / 2 - side * speed * ts) / exact
    assert_allclose(pressed, upwards * np.hypot(1.0, slope), atol=0.01 * 2.0 * 9.81)
    assert (pressed.min() < 0) == (share > 1)


@pytest.mark.parametrize("follower", ["ground", "post"])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_cam_on_a_fixed_point_presses_with_its_weight_or_hangs_on_it(side, follower):
    """A disc above or below the point, which belongs to the ground or to a body that is fixed to it."""
    disc, radius = udk.Body(2.0, 0.01, (0.0, side * 0.05)), np.full(8, 0.05)
    joints = {
        "guide": udk.Prismatic(("ground", "disc"), np.zeros((2, 2)), np.pi / 2, 0.0),
        "contact": udk.Cam(("disc", follower), np.zeros((2, 2)), udk.Profile(np.arange(8) * np.pi / 4, radius)),
        "foot": udk.Weld(("ground", "post"), np.zeros((2, 2)), 0.0),
    }
    mech = udk.Mechanism({"disc": disc, "post": udk.Body(1.0, 1.0)}, joints)
    rest = RestingPositions(np.zeros(1), mech.q0[None], mech.v0[None])
    assert_allclose(cam_forces(mech, rest)["contact"], side * 2.0 * 9.81, rtol=1e-12)
