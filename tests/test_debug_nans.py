"""With jax.debug_nans, ordinary calls and their derivatives pass: no NaN is computed and discarded."""

import jax
import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast

C, S = np.cos(0.6), np.sin(0.6)
BODIES = {"b": udk.Body(1.0, 0.1, [0.5 * C, 0.5 * S], 0.6), "c": udk.Body(1.0, 0.1, [1.5 * C, 0.5 * S], -0.6)}
JOINTS = {
    "pin": udk.Revolute(["ground", "b"], [[0, 0], [-0.5, 0]]),
    "elbow": udk.Revolute(["b", "c"], [[0.5, 0], [-0.5, 0]]),
    "guide": udk.Slot(["ground", "c"], [[0, 0], [0.5, 0]], 0.0),
}
FORCES = {
    "spring": udk.Spring(["ground", "c"], [[3.0, 0.0], [0.5, 0.0]], stiffness=5.0, length=0.5, damping=0.1),
    "rub": udk.Friction("pin", torque=0.2, velocity=0.1),
}
MECH = udk.Mechanism(BODIES, JOINTS, {}, FORCES)  # a slider-crank
BALL = udk.Mechanism({"b": udk.Body(1.0, 0.1, [0.0, 0.2])})
TS = np.linspace(0.0, 0.3, 3)
ANGLES = np.array([0.6, 0.7, 0.8])


def motion(m):
    return udk.kinematics(m, "body.b.angle", ANGLES)


def fall(m, *events):
    return udk.simulate(BALL.with_parameters({"body.b.mass": m.bodies["b"].mass}), TS, events=events)


def times(solution):
    assert solution.events is not None
    return solution.events.time


def crosses(action):
    return udk.Event(lambda t, at: at["b"].y, action, -1)


CALLS = {
    "simulate": lambda m: udk.simulate(m, TS).q,
    "assemble": lambda m: udk.assemble(m).q,
    "reactions": lambda m: udk.reactions(m, motion(MECH)),
    "energy and violation": lambda m: (udk.energy(m, motion(MECH)).total, udk.violation(m, motion(MECH))),
    "power_balance": lambda m: udk.power_balance(m, motion(MECH)).residual,
    "inverse_dynamics": lambda m: udk.inverse_dynamics(m, ANGLES, motion=motion(MECH), drivers=["body.b.angle"]).power,
    "equilibrium": lambda m: udk.equilibrium(m).q,
    "accelerations": lambda m: udk.accelerations(m, 0.0, MECH.q0, MECH.v0, formulation=udk.CoordinatePartitioning()),
    "events": lambda m: times(fall(m, udk.Contact("b", restitution=0.5), crosses(udk.Log()))),
}
CALLED = {"kinematics": motion, "travel": lambda m: udk.travel(m, "body.c.angle"), "stop": lambda m: fall(m, crosses(udk.Stop()))}


@pytest.mark.parametrize("name", fast(["energy and violation", "kinematics", "stop"], [*CALLS, *CALLED]))
def test_ordinary_calls_pass_where_jax_looks_for_values_that_are_no_numbers(name):
    """Also the derivatives of `CALLS`; test_kinematics.py checks those of positions."""
    with jax.debug_nans(True):
        if name in CALLED:
            CALLED[name](MECH)
            return

        def total(mass):
            return sum(x.sum() for x in jax.tree.leaves(CALLS[name](MECH.with_parameters({"body.b.mass": mass}))))

        value, slope = jax.value_and_grad(total)(1.0)
    assert not np.isnan(value) and np.isfinite(slope)
