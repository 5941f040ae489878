"""Positions of batches in lanes, compared with `kinematics` of each member, and with differences."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.positions.following.drive import drive
from udkjax.positions.following.free_numbers import FreeNumbers

FOUR_BAR = udk.Drawing(
    pins={"O": (0, 0), "A": (0.03, 0.04), "B": (0.12, 0.09), "P": (0.06, 0.12), "C": (0.1, 0)},
    links={
        "crank": {"pins": ["O", "A"], "mass": 1.0},
        "coupler": {"pins": ["A", "B", "P"], "density": 7850, "thickness": 0.005},
        "rocker": {"pins": ["C", "B"], "mass": 1.0},
    },
    ground=["O", "C"],
    motors={"motor": {"pin": "O", "speed": 6.0}},
)
MECH = FOUR_BAR.mechanism()
PINS = [f"pin.{name}" for name in "OABPC"]
START = float(drive(MECH, "motor").value(MECH.q0))
BATCH = udk.PositionBatch(MECH, "motor", PINS, derivatives=True)


def members(count, size, seed=0):
    rng = np.random.default_rng(seed)
    return {name: np.asarray(FOUR_BAR.pins[name[4:]]) + rng.normal(0, size, (count, 2)) for name in PINS}


def test_each_member_is_where_kinematics_has_it():
    given, values = members(11, 2e-3), START + np.linspace(0.1, 1.3, 7)
    found = BATCH(given, values)
    assert np.all(found.reached) and found.dq is not None
    for k in (0, 10):
        one = udk.kinematics(MECH.with_parameters({name: x[k] for name, x in given.items()}), "motor", values)
        np.testing.assert_allclose(found.q[k], one.q, atol=1e-14)
        np.testing.assert_allclose(found.dq[k], one.v, atol=1e-12)


def test_derivatives_along_all_pins_are_those_of_differences():
    """Differences of fourth order: members moved by h and 2 h along each of the ten coordinates."""
    given, values, h = members(1, 2e-3), START + np.array([0.4, 2.0]), 2e-5
    found = BATCH(given, values)
    assert found.by_parameters is not None
    assert BATCH.free.entries()[:3] == ["pin.O[0]", "pin.O[1]", "pin.A[0]"]
    x = BATCH.free.join(given)
    steps = h * np.array([2.0, 1.0, -1.0, -2.0])[:, None, None] * np.eye(10)
    q = BATCH(BATCH.free.split((x + steps).reshape(-1, 10)), values).q.reshape(4, 10, *found.q.shape[1:])
    differences = (-q[0] + 8 * q[1] - 8 * q[2] + q[3]) / (12 * h)
    np.testing.assert_allclose(found.by_parameters[0], np.moveaxis(differences, 0, -1), rtol=1e-9, atol=1e-9)


def test_the_transmission_is_the_sine_of_the_angle_at_the_pin():
    values = START + np.linspace(0.0, 6.0, 13)
    found = BATCH(members(1, 0.0), values)
    angle = udk.transmission_angle(MECH, udk.kinematics(MECH, "motor", values), "B")
    np.testing.assert_allclose(np.abs(found.transmission[0]), np.sin(angle), atol=1e-13)


def test_beyond_a_toggle_there_is_nothing_and_lanes_beside_do_not_mind():
    given = members(3, 0.0)
    given["pin.C"][1] = [0.2, 0.0]  # the crank of this one does not turn
    found = BATCH(given, START + np.linspace(0.0, -2 * np.pi, 40), threads=1)
    assert np.all(found.reached[[0, 2]])
    assert 0 < found.reached[1].sum() < 40
    assert np.all(np.isnan(found.q[1][~found.reached[1]]))
    limit = float(udk.travel(MECH.with_parameters({"pin.C": given["pin.C"][1]}), "motor").lower)
    last = np.linspace(START, START - 2 * np.pi, 40)[found.reached[1]][-1]
    assert limit <= last <= limit + 2 * np.pi / 39


def test_any_scene_a_six_bar_and_redundant_rows():
    mech = udk.library.parallelogram()  # one link too many
    free = ["body.coupler.mass"]
    values = float(drive(mech, "body.link1.angle").value(mech.q0)) + np.linspace(0.1, 0.9, 5)
    found = udk.PositionBatch(mech, "body.link1.angle", free, derivatives=True)({free[0]: np.ones(2)}, values)
    assert found.dq is not None
    one = udk.kinematics(mech, "body.link1.angle", values)
    np.testing.assert_allclose(found.q[1], one.q, atol=1e-13)
    np.testing.assert_allclose(found.dq[1], one.v, atol=1e-12)
    assert not np.any(found.by_parameters)  # positions do not depend on masses
    point = "joint.A1.points[0][1]"
    torn = udk.PositionBatch(mech, "body.link1.angle", [point])({point: np.array([0.0, 0.01])}, values)
    assert torn.reached.all(1).tolist() == [True, False]  # links of different lengths cannot close


def test_wrong_input_is_named():
    with pytest.raises(udk.SceneError, match=r'no number named "pin\.Q"'):
        udk.PositionBatch(MECH, "motor", ["pin.Q"])
    with pytest.raises(udk.SceneError, match="named twice"):
        udk.PositionBatch(MECH, "motor", ["pin.A", "pin.A"])
    with pytest.raises(udk.SceneError, match=r'"pin\.A" is missing'):
        BATCH({name: x for name, x in members(2, 0.0).items() if name != "pin.A"}, np.array([0.1]))
    with pytest.raises(udk.SceneError, match="must have the shape"):
        BATCH(members(2, 0.0) | {"pin.A": np.zeros(2)}, np.array([0.1]))
    with pytest.raises(ValueError, match="values"):
        BATCH(members(2, 0.0), np.zeros((3, 4)))
    with pytest.raises(ValueError, match="finite"):
        BATCH(members(2, 0.0), np.array([0.1, np.nan]))


def test_a_member_that_cannot_go_on_does_not_hold_up_the_others():
    """One member of a register has too short a rocker for a full turn; the others get to the end."""
    given = members(8, 0.0)
    given["pin.C"][3] = [0.14, 0.02]
    found = BATCH(given, START + np.array([6.0]))
    assert not found.reached[3, 0] and np.delete(found.reached, 3, axis=0).all()


def test_a_model_is_traced_once(monkeypatch):
    """Its parts have the moved mechanism in common, whose trace takes most of the time before the first position."""
    moved, calls = FreeNumbers.moved, []
    monkeypatch.setattr(FreeNumbers, "moved", lambda self, x: calls.append(1) or moved(self, x))
    found = udk.PositionBatch(MECH, "motor", ["pin.A"])({"pin.A": np.array([[0.03, 0.04]])}, [START])
    assert len(calls) == 1 and found.reached.all()
