"""Efforts that hold mechanisms at rest against friction, beside closed forms: an incline, a wedge, a toggle clamp."""

from typing import Any

import jax
import numpy as np
import pytest

import udkjax as udk
from tests.friction import G, pendulum

LAWS: dict[str, dict[str, Any]] = {"smooth": {"law": "smooth"}, "set-valued": {"law": "set-valued"}}


def wedge(angle: float, **friction: Any) -> udk.Mechanism:
    """Return a load of 2 kg on an incline, as on the thread of a screw."""
    return udk.Mechanism(
        {"load": udk.Body(2.0, 0.01, [0.0, 0.0], angle)},
        {"S": udk.Prismatic(["ground", "load"], [[0.0, 0.0], [0.0, 0.0]], angle)},
        forces={"rub": udk.Friction("S", **friction)},
    )


def clamp(sine: float, push: float = 500.0, coefficient: float = 0.1, radius: float = 0.01, length: float = 0.2) -> udk.Mechanism:
    """Return a toggle of two rods without weight, whose knee is `length` times `sine` above the line of its ends.

    A workpiece pushes at its slider.
    """
    c, s = length * np.sqrt(1 - sine**2), length * sine
    angle = np.arcsin(sine)
    return udk.Mechanism(
        {
            "lever": udk.Body(1.0, 0.01, [c / 2, s / 2], angle),
            "rod": udk.Body(1.0, 0.01, [1.5 * c, s / 2], -angle),
            "slider": udk.Body(1.0, 0.01, [2 * c, 0.0]),
        },
        {
            "A": udk.Revolute(["ground", "lever"], [[0.0, 0.0], [-length / 2, 0.0]]),
            "B": udk.Revolute(["lever", "rod"], [[length / 2, 0.0], [-length / 2, 0.0]]),
            "C": udk.Revolute(["rod", "slider"], [[length / 2, 0.0], [0.0, 0.0]]),
            "S": udk.Prismatic(["ground", "slider"], [[0.0, 0.0], [0.0, 0.0]], 0.0),
        },
        forces={"work": udk.Force("slider", [-push, 0.0])}
        | {pin: udk.Friction(pin, coefficient=coefficient, radius=radius, law="set-valued") for pin in "ABC"},
        gravity=[0.0, 0.0],
    )


def test_a_wedge_locks_itself_up_to_the_angle_of_friction():
    """The horizontal force is W tan(angle + phi) to lift, W tan(angle - phi) to lower, with tan(phi) the coefficient.

    Beyond angle + phi = 90 degrees no force lifts the load.
    """
    weight, phi = 2.0 * G, np.arctan(0.3)
    for angle, rests in ((phi - 1e-9, True), (phi + 1e-9, False), (np.pi / 2 - phi + 1e-6, False)):
        found = udk.holding_efforts(wedge(angle, coefficient=0.3), "body.load.x", [0.0])
        lifting = weight * np.tan(angle + phi)
        np.testing.assert_allclose(found.upper, lifting if lifting > 0 else np.inf, rtol=1e-12)
        np.testing.assert_allclose(found.lower, weight * np.tan(angle - phi), atol=1e-12)
        np.testing.assert_allclose(found.without_friction, weight * np.tan(angle), rtol=1e-12)
        assert bool(found.rests[0]) is rests


def test_an_equilibrium_names_the_friction_around_it():
    rest = udk.equilibrium(pendulum(coefficient=0.3, radius=0.1), stable=True)
    assert bool(rest.stable) and rest.left_out == ("rub",)
    assert "friction rub, with which it rests in all positions around, see holding_efforts" in str(rest)
    assert udk.equilibrium(udk.library.simple_pendulum()).left_out == ()


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_static_coefficients_count(law):
    weight, phi = 2.0 * G, np.arctan(0.4)
    found = udk.holding_efforts(wedge(0.2, coefficient=0.1, static_coefficient=0.4, **LAWS[law]), "body.load.x", [0.0])
    np.testing.assert_allclose(found.upper, weight * np.tan(0.2 + phi), rtol=1e-12)
    np.testing.assert_allclose(found.lower, weight * np.tan(0.2 - phi), rtol=1e-12)


@pytest.mark.slow
def test_no_force_lifts_a_load_up_a_steep_incline():
    """Beyond angle + phi = 90 degrees a horizontal force presses more than it lifts: the bound is infinite."""
    phi = np.arctan(0.5)
    steep, less = (udk.holding_efforts(wedge(np.pi / 2 - phi + e, coefficient=0.5), "body.load.x", [0.0]) for e in (1e-6, -1e-6))
    assert float(steep.upper[0]) == np.inf
    np.testing.assert_allclose(less.upper, 2.0 * G / np.tan(1e-6), rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("push", [500.0, 5e4])
def test_a_toggle_clamp_locks_itself(push):
    """It holds, however strong the workpiece, where one line passes all three circles of friction: h <= 2 mu r."""
    limit = 2 * 0.1 * 0.01 / 0.2
    for sine, rests in ((limit * (1 - 1e-7), True), (limit * (1 + 1e-7), False)):
        found = udk.holding_efforts(clamp(sine, push), "body.lever.angle", [np.arcsin(sine)])
        assert bool(found.rests[0]) is rests
        still = np.abs(udk.accelerations(clamp(sine, push), 0.0, clamp(sine).q0, clamp(sine).v0)).max() < 1e-6
        assert bool(still) is rests


@pytest.mark.slow
def test_resting_positions_of_a_clamp_and_their_efforts():
    """Over all positions; the bounds of the torque at the lever are those of runs that begin to move."""
    limit = 2 * 0.1 * 0.01 / 0.2
    angles = np.arcsin(limit * np.array([2.5, 1.5, 0.9, 0.5, 0.1]))
    found = udk.holding_efforts(clamp(2.5 * limit), "body.lever.angle", angles)
    assert found.rests.tolist() == [False, False, True, True, True]
    assert "rests without effort" in str(found)
    for k in (0, 3):
        for bound, forwards in ((found.lower, False), (found.upper, True)):
            for share, moves in ((1.0 - 1e-6, False), (1.0 + 1e-6, True)):
                middle = float(found.lower[k] + found.upper[k]) / 2
                torque = udk.Torque(["ground", "lever"], middle + share * (float(bound[k]) - middle))
                base = clamp(float(np.sin(angles[k])))
                loaded = udk.Mechanism(base.bodies, base.joints, forces=dict(base.forces) | {"hand": torque}, gravity=[0.0, 0.0])
                alpha = float(udk.accelerations(loaded, 0.0, loaded.q0, loaded.v0)[0, 2])
                assert alpha == pytest.approx(0.0, abs=1e-7) if not moves else (alpha > 0) is forwards


@pytest.mark.slow
def test_derivatives_and_batches():
    weight = 2.0 * G

    def upper(coefficient):
        changed = wedge(0.2, coefficient=0.3).with_parameters({"force.rub.coefficient": coefficient})
        return udk.holding_efforts(changed, "body.load.x", [0.0]).upper[0]

    slope = weight / np.cos(0.2 + np.arctan(0.3)) ** 2 / (1 + 0.3**2)
    np.testing.assert_allclose(jax.grad(upper)(0.3), slope, rtol=1e-10)
    np.testing.assert_allclose(jax.jacfwd(upper)(0.3), slope, rtol=1e-10)
    coefficients = np.array([0.1, 0.3])
    np.testing.assert_allclose(jax.vmap(upper)(coefficients), weight * np.tan(0.2 + np.arctan(coefficients)), rtol=1e-12)
