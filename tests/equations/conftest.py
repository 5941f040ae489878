import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.equations import constraints, loads


@jax.jit  # operation by operation they are hundreds of programs
def terms(mechanism, t, q, v):
    """Psi_q, gamma, M and F."""
    A, gamma = constraints.psi_q(mechanism, t, q), constraints.gamma(mechanism, t, q, v)
    return A, gamma, jnp.diag(loads.mass(mechanism)), loads.force(mechanism, t, q, v)


@pytest.fixture(scope="session")
def kkt():
    """Accelerations and multipliers from M a + Psi_q^T lambda = F, Psi_q a = gamma, in the sense of least squares."""

    def solved(mechanism, t, q, v):
        A, gamma, M, F = (np.asarray(x) for x in terms(mechanism.without_origin, jnp.asarray(t), jnp.asarray(q), jnp.asarray(v)))
        matrix = np.block([[M, A.T], [A, np.zeros((len(A), len(A)))]])
        solution = np.linalg.lstsq(matrix, np.concatenate([F, gamma]), rcond=1e-9)[0]
        return solution[: len(q)], solution[len(q) :]

    return solved


@pytest.fixture(scope="session")
def closed():
    """The closed position that a mechanism of the library starts from, and random velocities that its constraints allow; flat."""

    def state(mechanism, seed=0):
        q, t = mechanism.q0.ravel(), jnp.array(0.0)
        v = jnp.asarray(np.random.default_rng(seed).standard_normal(q.shape))
        rows = jax.jit(lambda m, t, q, v: (constraints.psi_q(m, t, q), constraints.psi_dot(m, t, q, v)))
        A, rate = rows(mechanism.without_origin, t, q, v)
        return q, v - jnp.linalg.pinv(A, rtol=1e-9) @ rate

    return state


@pytest.fixture(scope="session")
def linkage():
    """The paper's, at an ordinary angle."""
    return udk.library.parallelogram(np.deg2rad(-50))
