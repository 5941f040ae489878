"""A pendulum with a damped torsion spring, and measurements of it: all tests share one compiled program."""

import numpy as np
import pytest

import udkjax as udk

ANGLE = "body.rod.angle"
NAMES = ("body.rod.inertia", "force.spring.damping")
TS = np.sort(np.append(np.random.default_rng(3).uniform(0.0, 5.0, 59), 0.0))  # irregular


def pendulum(inertia: float = 0.375, damping: float = 0.2, angle: float = 1.2) -> udk.Mechanism:
    rod = udk.library.compound_pendulum(angle=angle)
    spring = udk.TorsionSpring(("ground", "rod"), stiffness=3.0, damping=damping)
    mech = udk.Mechanism(rod.bodies, rod.joints, forces={"spring": spring})
    return mech.with_parameters({"body.rod.inertia": inertia})


def swing(mech: udk.Mechanism, ts: np.ndarray = TS) -> np.ndarray:
    return np.asarray(udk.simulate(mech, ts, rtol=1e-12, atol=1e-12).q)[:, 0, 2]


@pytest.fixture(scope="session")
def measured():
    """The true mechanism and its angle at `TS`."""
    mech = pendulum()
    return mech, swing(mech)
