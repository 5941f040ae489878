import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.textbook import terms


@pytest.fixture(scope="session")
def kkt():
    """Return accelerations and multipliers from M a + Psi_q^T lambda = F, Psi_q a = gamma, by least squares."""

    def solved(mechanism, t, q, v):
        x = terms(mechanism, t, q, v)
        matrix = np.block([[np.diag(x.mass), x.psi_q.T], [x.psi_q, np.zeros((len(x.psi), len(x.psi)))]])
        solution = np.linalg.lstsq(matrix, np.concatenate([x.force, x.gamma]), rcond=1e-9)[0]
        return solution[: len(q)], solution[len(q) :]

    return solved


@pytest.fixture(scope="session")
def closed():
    """Return the closed initial position of a mechanism of the library, and random velocities within its constraints; flat."""

    def state(mechanism, seed=0):
        q = mechanism.q0.ravel()
        v = np.random.default_rng(seed).standard_normal(q.shape)
        x = terms(mechanism, 0.0, q, v)
        return q, jnp.asarray(v - np.linalg.pinv(x.psi_q, rcond=1e-9) @ x.psi_dot)

    return state


@pytest.fixture(scope="session")
def linkage():
    """The paper's linkage at a generic angle."""
    return udk.library.parallelogram(np.deg2rad(-50))
