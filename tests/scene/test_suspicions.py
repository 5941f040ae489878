import numpy as np
import pytest

import udkjax.scene as udk
from udkjax.scene.suspicions import suspicions


def rods(**more):
    """Two rods of one metre on the ground, side by side."""
    bodies = {name: udk.Body(1.0, 1 / 12, (x, 0.5), np.pi / 2) for name, x in (("left", 0.0), ("right", 1.0))}
    joints = {name: udk.Revolute(("ground", name), [(x, 0.0), (-0.5, 0.0)]) for name, x in (("left", 0.0), ("right", 1.0))}
    return udk.Mechanism(bodies, joints, **more)


def test_nothing_is_suspicious_of_the_library():
    for name in udk.library.__all__:
        assert suspicions(getattr(udk.library, name)()) == [], name


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"joint.left.points[1][0]": -500.0}, 'joint.left.points[1] is 500 m from the centre of mass of "left"'),
        ({"joint.left.points[0]": (0.0, 300.0)}, "joint.left.points[0] is 300 m from the nearest body"),
        ({"body.left.angle": 90.0}, "body.left.angle is 90 rad, which looks like degrees: 90 degrees are 1.5708 rad"),
        ({"body.left.angle": -22.5}, "body.left.angle is -22.5 rad, which looks like degrees"),
    ],
)
def test_what_is_likely_a_mistake_is_named(values, expected):
    (found,) = suspicions(rods().with_parameters(values))
    assert found.startswith(expected)


@pytest.mark.parametrize("values", [{"body.left.angle": 7 * np.pi}, {"joint.left.points[1][0]": -12.0}, {"body.left.mass": 1e4}])
def test_what_may_be_meant_is_left_alone(values):
    assert suspicions(rods().with_parameters(values)) == []


def test_a_body_without_a_joint_is_named():
    mech = rods()
    loose = udk.Mechanism(dict(mech.bodies) | {"bob": udk.Body(1, 1)}, mech.joints)
    assert suspicions(loose) == ['body "bob" belongs to no joint: it moves freely']
    assert suspicions(udk.Mechanism({"bob": udk.Body(1, 1)})) == []
