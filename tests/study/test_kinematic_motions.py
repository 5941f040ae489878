"""Along a `Kinematics` over values of a driver, the driver has these values, rates and accelerations, and time is zero."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.calls import calls_of
from tests.choices import fast
from udkjax.equations.states.state_arrays import StateArrays
from udkjax.programs.deferred import deferred

AMPLITUDE, FREQUENCY, PHASE, OFFSET = 0.4, 3.0, 0.3, 0.9
TS = np.linspace(0.0, 0.9, 7)
X = FREQUENCY * TS + PHASE
VALUES = OFFSET + AMPLITUDE * np.sin(X)
RATES, ACCELERATIONS = AMPLITUDE * FREQUENCY * np.cos(X), -AMPLITUDE * FREQUENCY**2 * np.sin(X)
FRICTION = {
    "no friction": None,
    "friction": {"joint": "P", "torque": 3.0, "velocity": 0.1},
    "friction by load": {"joint": "guide", "coefficient": 0.2, "speed": 0.1},
    "set-valued friction by load": {"joint": "guide", "coefficient": 0.2, "law": "set-valued"},
}


class Push(udk.ForceElement):
    """A force (N) along x that changes with time, or that of one time."""

    frozen: bool = eqx.field(static=True, default=False)

    def loads(self, t, frame):
        return ((5.0 * jnp.cos(2.0 * (0.0 if self.frozen else t) + 0.5), 0.0, 0.0),)


def scene(motion, friction=None, frozen=False):
    """Return a slider-crank whose crank moves like this, with a force and friction on its slider and a motor at its rod."""
    crank = udk.library.slider_crank()
    forces = {"push": Push(("slider",), frozen=frozen), "return": udk.TorsionSpring(("crank", "rod"), 2.0, 0.3)}
    if friction:
        forces["rub"] = udk.Friction(**friction)
    return udk.Mechanism(crank.bodies, crank.joints, {"motor": udk.Driver(("ground", "crank"), "angle", motion)}, forces)


def in_time(friction=None):
    """Return a mechanism with loads of time zero, and its motion over times."""
    mech = scene(udk.Sine(AMPLITUDE, FREQUENCY, PHASE, OFFSET), friction, frozen=True)
    return mech, udk.kinematics(mech, None, TS)


def over_values(friction=None, values=VALUES, rates: Any = RATES, accelerations: Any = ACCELERATIONS):
    """Return a mechanism whose motor turns otherwise and whose loads depend on time, and the same motion over values."""
    mech = scene(udk.Polynomial([0.2, 7.0, -1.0]), friction)
    return mech, udk.kinematics(mech, "motor", values, rate=rates, acceleration=accelerations)


def quantities(mech, motion):
    """Return what the functions of a history say of a motion."""
    powers = udk.power_balance(mech, motion)
    return {
        "energy": udk.energy(mech, motion),
        "efforts": udk.efforts(mech, motion, stabilization=udk.Baumgarte(10.0, 10.0)),
        "reactions": udk.reactions(mech, motion, about="joint"),
        "unique": udk.unique_reactions(mech, motion),
        "pin reactions": udk.pin_reactions(mech, motion),
        "friction": udk.friction_loads(mech, motion),
        "powers": (powers.drivers, powers.forces, powers.joints),
        "accelerations": udk.path(mech, motion, "rod", derivative=2),
    }


@pytest.mark.parametrize("name", fast(["friction", "friction by load"], FRICTION))
def test_loads_along_values_are_those_of_the_motion(name):
    of_time, of_values = quantities(*in_time(FRICTION[name])), quantities(*over_values(FRICTION[name]))
    for name, expected in of_time.items():
        for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(of_values[name]), strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9, err_msg=name)


def test_uniform_motions_are_evaluated_like_times():
    """By NumPy, without a trace; loads at other rates and accelerations by JAX, to the same values."""
    rate, acceleration = 2.0, 0.7
    mech, motion = over_values(None, VALUES, rate, acceleration)
    by_jax = jax.jit(lambda m: (udk.efforts(mech, m), udk.reactions(mech, m)))(motion)
    with calls_of(StateArrays.solve) as calls:
        by_numpy = udk.efforts(mech, motion), udk.reactions(mech, motion)
    assert len(calls) == 2
    for a, b in zip(jax.tree.leaves(by_jax), jax.tree.leaves(by_numpy), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-10)


def test_efforts_along_values_have_derivatives():
    mech = two_motors()

    def effort(x):
        motion = udk.kinematics(mech, "a", VALUES + x[0], rate=RATES * x[1], acceleration=ACCELERATIONS + x[2])
        return jnp.sum(udk.efforts(mech, motion)["b"] * np.arange(1.0, 8.0))

    x = jnp.array([0.1, 1.2, 0.5])
    steps = 1e-5 * np.eye(3)
    differences = [(effort(x + h) - effort(x - h)) / 2e-5 for h in steps]
    np.testing.assert_allclose(deferred(jax.grad(effort))(x), differences, rtol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.vmap(effort))(x + steps), [effort(x + h) for h in steps], rtol=1e-10)


def two_motors():
    """Return two links in a chain, each turned by a motor of its own."""
    bodies = {"upper": udk.Body(1.0, 0.1, (0.5, 0.0)), "lower": udk.Body(1.0, 0.1, (1.5, 0.0))}
    joints = {
        "shoulder": udk.Revolute(("ground", "upper"), ((0.0, 0.0), (-0.5, 0.0))),
        "elbow": udk.Revolute(("upper", "lower"), ((0.5, 0.0), (-0.5, 0.0))),
    }
    drivers = {
        "a": udk.Driver(("ground", "upper"), "angle", udk.Polynomial([0.0, 1.0, 2.0])),
        "b": udk.Driver(("upper", "lower"), "angle", udk.Sine(0.5, 2.0, 0.6)),
    }
    return udk.Mechanism(bodies, joints, drivers)


def test_other_drivers_hold_still():
    """Efforts are those of inverse dynamics, although in time the other motor turns, too."""
    mech = two_motors()
    motion = udk.kinematics(mech, "a", VALUES, rate=RATES, acceleration=ACCELERATIONS, held={"b": 0.4})
    expected = udk.inverse_dynamics(mech, TS, motion).efforts
    found = udk.efforts(mech, motion, stabilization=udk.Baumgarte(5.0, 5.0))
    for name in mech.drivers:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-10)
    np.testing.assert_allclose(udk.power_balance(mech, motion).drivers["b"], 0.0, atol=1e-12)


def test_ranks_along_values_do_not_depend_on_the_rate():
    """A crank that passes a toggle: the rank changes at the same value, whatever the rate."""
    mech = udk.library.parallelogram()
    found = [
        udk.diagnose(mech, solution=udk.kinematics(mech, "body.link1.angle", np.linspace(0.4, -0.4, 9), rate=rate), fixes=False)
        for rate in (1.0, -30.0)
    ]
    (one,), (other,) = (x.timeline.changes for x in found if x.timeline is not None)
    assert abs(one.time - other.time) < 1e-6 and abs(one.time) < 1e-6


def test_a_diagnosis_begins_where_the_motion_does():
    """In time, the driver would be elsewhere."""
    mech, motion = over_values()
    found = udk.diagnose(mech, solution=motion, fixes=False)
    np.testing.assert_allclose(found.q, motion.q[0], atol=1e-12)
    assert f"{VALUES.min():g} to {VALUES.max():g} rad, {len(VALUES)} output values" in str(found)
