"""The number of degrees of freedom does not depend on gear ratios: every function counts the same, and runs agree."""

from itertools import product

import numpy as np
import pytest

import udkjax as udk
from udkjax.equations import analyse
from udkjax.positions.answers.linkage_type import mobility

RATIOS = 1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6
LENGTHS = 1e-6, 1.0, 1e3  # of a crank (m)


def pinned(name: str, place: tuple[float, float]) -> dict[str, udk.Joint]:
    return {f"{name} pin": udk.Revolute(("ground", name), (place, (0.0, 0.0)))}


def turning(name: str, bodies: dict[str, udk.Body]) -> dict[str, udk.Driver]:
    return {"motor": udk.Driver(("ground", name), "angle", udk.Polynomial([float(bodies[name].angle), 1.0]))}


def crank(length: float) -> tuple[dict[str, udk.Body], dict[str, udk.Joint]]:
    """Return the bodies and joints of a slider-crank at an angle of 0.7 rad, with a crank of the given length."""
    a, b = length, 3.0 * length
    tilt = -np.arcsin(a * np.sin(0.7) / b)
    along, up = np.array([np.cos(0.7), np.sin(0.7)]), np.array([np.cos(tilt), np.sin(tilt)])
    end = a * along + b * up
    bodies = {
        "crank": udk.Body(1.0, a * a / 12, a / 2 * along, 0.7),
        "rod": udk.Body(1.0, b * b / 12, a * along + b / 2 * up, tilt),
        "slider": udk.Body(1.0, a * a, end),
    }
    joints = {
        "O": udk.Revolute(("ground", "crank"), ((0.0, 0.0), (-a / 2, 0.0))),
        "A": udk.Revolute(("crank", "rod"), ((a / 2, 0.0), (-b / 2, 0.0))),
        "B": udk.Revolute(("rod", "slider"), ((b / 2, 0.0), (0.0, 0.0))),
        "guide": udk.Prismatic(("ground", "slider"), ((0.0, end[1]), (0.0, 0.0)), 0.0),
    }
    return bodies, joints


def geared(ratio: float, length: float, joint: str) -> tuple[dict[str, udk.Body], dict[str, udk.Joint], str, str]:
    """Return a slider-crank with a wheel that turns by `ratio` for a turn of the crank, or a slide by its length."""
    bodies, joints = crank(length)
    wheel = udk.Body(1.0, length**2, (0.0, -length))
    if joint == "gear":
        joints["pair"] = udk.Gear(("crank", "wheel"), (length * max(ratio, 1.0), length * max(1 / ratio, 1.0)))
    elif joint == "screw":
        joints["pair"] = udk.Screw(("ground", "slider"), ((0, 0), (0, 0)), 0.0, ("ground", "wheel"), length / ratio)
    elif joint == "coupling":
        joints["pair"] = udk.Coupling(("ground", "wheel"), ("ground", "crank"), (-0.7 * ratio, ratio))
    else:
        raise ValueError(joint)
    return bodies | {"wheel": wheel}, joints | pinned("wheel", (0.0, -length)), "crank", "wheel"


def rack(ratio: float, length: float) -> tuple[dict[str, udk.Body], dict[str, udk.Joint], str, str]:
    bodies, joints = crank(length)
    x, y = np.asarray(bodies["slider"].position)
    r = length / ratio
    joints["pair"] = udk.Rack(("slider", "wheel"), r, 0.0)
    return bodies | {"wheel": udk.Body(1.0, r**2, (x, y + r))}, joints | pinned("wheel", (x, y + r)), "crank", "wheel"


def train(ratio: float, length: float) -> tuple[dict[str, udk.Body], dict[str, udk.Joint], str, str]:
    """Return six wheels, of which the last turns by `ratio` for a turn of the first; no stage has a large ratio."""
    stage, joints = ratio**0.2, dict[str, udk.Joint]()
    bodies = {f"wheel {k}": udk.Body(1.0, length**2, (k * length, 0.0)) for k in range(6)}
    for k, name in enumerate(bodies):
        joints |= pinned(name, (k * length, 0.0))
        if k:
            joints[f"gear {k}"] = udk.Gear((f"wheel {k - 1}", name), (stage * length, length))
    return bodies, joints, "wheel 0", "wheel 5"


MECHANISMS = {
    "gear": lambda ratio, length: geared(ratio, length, "gear"),
    "screw": lambda ratio, length: geared(ratio, length, "screw"),
    "coupling": lambda ratio, length: geared(ratio, length, "coupling"),
    "rack": lambda ratio, length: rack(max(ratio, 1.0), length),  # no larger than the crank
    "train": train,
}


def counts(mechanism: udk.Mechanism) -> list[int]:
    """Return the degrees of freedom by every function that counts them."""
    diagnosis, found = udk.diagnose(mechanism, fixes=False), analyse(mechanism)
    q = udk.assemble(mechanism).q
    rank = int(udk.uniqueness(mechanism, 0.0, q).rank)
    assert diagnosis.can_move or not diagnosis.degrees_of_freedom
    assert not diagnosis.is_singular
    return [
        udk.check(mechanism).degrees_of_freedom,
        diagnosis.degrees_of_freedom,
        -1 if found.degrees_of_freedom is None else found.degrees_of_freedom,
        found.coordinates - rank,
    ]


def mechanism_of(kind: str, driven: str | None, ratio: float, length: float) -> udk.Mechanism:
    bodies, joints, first, last = MECHANISMS[kind](ratio, length)
    motor = {} if driven is None else turning(first if driven == "first" else last, bodies)
    return udk.Mechanism(bodies, joints, motor)


CASES = [(kind, driven) for kind in MECHANISMS for driven in (None, "first", "last")]


@pytest.mark.parametrize(("kind", "driven"), CASES)
def test_freedoms_do_not_depend_on_gear_ratios(kind, driven):
    for ratio, length in ((1e-6, 1e3), (1e4, 1.0), (1e6, 1e-6)):
        found = counts(mechanism_of(kind, driven, ratio, length))
        assert found == [0 if driven else 1] * len(found), (ratio, length)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "driven"), CASES)
def test_freedoms_of_all_ratios_and_lengths(kind, driven):
    for ratio, length in product(RATIOS, LENGTHS):
        found = counts(mechanism_of(kind, driven, ratio, length))
        assert found == [0 if driven else 1] * len(found), (ratio, length)


FINGER = """<body name="A{k}" pos="{x} 0 0"><joint name="a{k}" axis="0 1 0"/>
 <geom type="capsule" fromto="0 0 0 0.05 0 0.02" size="0.005" mass="0.03"/>
 <body name="B{k}" pos="0.05 0 0.02"><joint name="b{k}" axis="0 1 0" armature="{armature}"/>
 <geom type="capsule" fromto="0 0 0 0.04 0 0" size="0.005" mass="0.03"/></body></body>
 <body name="C{k}" pos="{to} 0 0"><joint name="c{k}" axis="0 1 0"/>
 <geom type="capsule" fromto="0 0 0 0.05 0 0.02" size="0.005" mass="0.03"/></body>"""


def gripper(armature: float) -> udk.Mechanism:
    """Return two parallelogram fingers that move together, with the rotor of a motor on a hinge of each."""
    fingers = "".join(FINGER.format(k=k, x=0.3 * k, to=0.3 * k + 0.04, armature=armature) for k in (1, 2))
    closing = "".join(f'<connect body1="B{k}" body2="C{k}" anchor="0.04 0 0"/>' for k in (1, 2))
    return udk.loads(
        f'<mujoco><option><flag contact="disable"/></option><worldbody>{fingers}</worldbody>'
        f'<equality>{closing}<joint joint1="a1" joint2="a2"/></equality></mujoco>'
    )


@pytest.mark.parametrize("armature", [1e-3, 2.0, 50.0])
def test_a_gripper_with_heavy_rotors_moves(armature):
    mechanism = gripper(armature)
    assert counts(mechanism) == [1, 1, 1, 1]
    assert mobility(mechanism).true == 1
    assert udk.explain(mechanism).rank == 3 * len(mechanism.body_names) - 1


@pytest.mark.parametrize("ratio", [1e-5, 1e5])
def test_a_motor_at_either_end_of_a_gear_drives_the_other_end(ratio):
    """The run follows the ratio: a wheel of 1 rad/s turns the last wheel of a train."""
    for driven, speed in (("first", 1.0), ("last", 1.0 / ratio)):
        bodies, joints, first, last = train(ratio, 1.0)
        motor = {"motor": udk.Driver(("ground", first if driven == "first" else last), "angle", udk.Polynomial([0.0, 1.0]))}
        run = udk.simulate(udk.Mechanism(bodies, joints, motor), np.linspace(0.0, 0.1, 3))
        turned = np.asarray(run.q[:, [0, 5], 2])
        sign = -1.0  # five pairs of external gears
        np.testing.assert_allclose(
            turned[:, 0], speed * run.ts * (1.0 if driven == "first" else sign), rtol=1e-7, atol=1e-9 * speed
        )
        np.testing.assert_allclose(turned[:, 1], sign * ratio * turned[:, 0], rtol=1e-7, atol=1e-9 * ratio * speed)
