import numpy as np
import pytest

import udkjax as udk
from tests.integrate.scenes import TS, Until


@pytest.fixture(scope="session")
def table():
    """Reference values by time: the times, and one array for each column."""

    def columns(reference, times=None):
        rows = {float(t): row for t, row in reference.items() if times is None or float(t) in times}
        ts = np.array(sorted(rows))
        return ts, {key: np.array([np.asarray(rows[t][key], float) for t in ts]) for key in rows[ts[0]]}

    return columns


@pytest.fixture(scope="session")
def pendulum():
    return udk.library.compound_pendulum()


@pytest.fixture(scope="session")
def motion(pendulum):
    return udk.simulate(pendulum, TS)


@pytest.fixture(scope="session")
def hung():
    """A rod that swings from a pin. The pin is on a line, 1 m from a point above it, if that point is not too high."""
    bodies = {"rod": udk.Body(1.0, 0.2, [1.0, -0.5], -0.8, angular_velocity=1.0)}
    joints = {
        "line": udk.Slot(["ground", "rod"], [[0.0, 0.0], [-0.75, 0.0]], axis=0.0),
        "thread": udk.Distance(["ground", "rod"], [[0.0, 0.3], [-0.75, 0.0]], 1.0),
    }
    return udk.Mechanism(bodies, joints, forces={"motor": Until("rod", 99.0)})


@pytest.fixture(scope="session")
def linkage():
    """The paper's linkage at an ordinary angle."""
    return udk.library.parallelogram(np.deg2rad(-50))
