import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax import GROUND, Frame


class Twin:
    """The equations of a mechanism written down plainly, on arrays: the residuals of its elements, and JAX's derivatives."""

    @staticmethod
    def frames(mechanism, q, v=None):
        found = {GROUND: Frame(0.0, 0.0, 0.0, 1.0, 0.0, *(() if v is None else (0.0, 0.0, 0.0)))}
        for k, name in enumerate(mechanism.body_names):
            x, y, angle = q[3 * k : 3 * k + 3]
            found[name] = Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), *(() if v is None else v[3 * k : 3 * k + 3]))
        return found

    @classmethod
    def psi(cls, mechanism, t, q):
        known = cls.frames(mechanism, q)
        rows = [c.residual(t, *(known[n] for n in mechanism.frames_of(c))) for c in mechanism.constraints.values()]
        return jnp.concatenate([jnp.stack([jnp.asarray(r) for r in part]) for part in rows]) if rows else jnp.zeros(0)

    @classmethod
    def psi_q(cls, mechanism, t, q):
        return jax.jacfwd(cls.psi, 2)(mechanism, t, q)

    @classmethod
    def psi_dot(cls, mechanism, t, q, v):
        return jax.jvp(lambda t, q: cls.psi(mechanism, t, q), (t, q), (jnp.ones_like(t), v))[1]

    @classmethod
    def gamma(cls, mechanism, t, q, v):
        return -jax.jvp(lambda t, q: cls.psi_dot(mechanism, t, q, v), (t, q), (jnp.ones_like(t), v))[1]

    @staticmethod
    def mass(mechanism):
        return jnp.stack([m for b in mechanism.bodies.values() for m in (b.mass, b.mass, b.inertia)])

    @classmethod
    def kinetic(cls, mechanism, v):
        return cls.mass(mechanism) @ v**2 / 2

    @classmethod
    def potential(cls, mechanism, t, q, v):
        """Of gravity and of the force elements that have one."""
        known = cls.frames(mechanism, q, v)
        weights = jnp.tile(jnp.append(mechanism.gravity, 0.0), len(q) // 3) * cls.mass(mechanism)
        stored = [e.potential(t, *(known[n] for n in mechanism.frames_of(e))) for e in mechanism.forces.values()]
        return sum((s for s in stored if s is not None), -weights @ q)

    @classmethod
    def loads(cls, mechanism, t, q, v):
        """Of the elements that state their loads."""
        known, total = cls.frames(mechanism, q, v), jnp.zeros_like(q)
        for e in mechanism.forces.values():
            names = mechanism.frames_of(e)
            for name, load in zip(names, e.loads(t, *(known[n] for n in names)) or [], strict=False):
                if name != GROUND:
                    k = 3 * mechanism.body_names.index(name)
                    total = total.at[k : k + 3].add(jnp.stack([jnp.asarray(c, float) for c in load]))
        return total

    @classmethod
    def force(cls, mechanism, t, q, v):
        return cls.loads(mechanism, t, q, v) - jax.grad(cls.potential, 2)(mechanism, t, q, v)

    @classmethod
    def terms(cls, mechanism, t, q, v):
        """Psi_q, gamma, M and F."""
        A, gamma = cls.psi_q(mechanism, t, q), cls.gamma(mechanism, t, q, v)
        return A, gamma, jnp.diag(cls.mass(mechanism)), cls.force(mechanism, t, q, v)

    @classmethod
    def kkt(cls, mechanism, t, q, v):
        """Accelerations and multipliers from M a + Psi_q^T lambda = F, Psi_q a = gamma, in the sense of least squares."""
        A, gamma, M, F = (np.asarray(x) for x in TERMS(mechanism, jnp.asarray(t), jnp.asarray(q), jnp.asarray(v)))
        matrix = np.block([[M, A.T], [A, np.zeros((len(A), len(A)))]])
        solution = np.linalg.lstsq(matrix, np.concatenate([F, gamma]), rcond=1e-9)[0]
        return solution[: len(q)], solution[len(q) :]


TERMS = jax.jit(Twin.terms)  # operation by operation they are hundreds of programs


@pytest.fixture(scope="session")
def twin():
    return Twin


@pytest.fixture(scope="session")
def closed():
    """The closed position that a mechanism of the library starts from, and random velocities that its constraints allow; flat."""

    def state(mechanism, seed=0):
        q, t = mechanism.q0.ravel(), jnp.array(0.0)
        v = jnp.asarray(np.random.default_rng(seed).standard_normal(q.shape))
        A, rate = jax.jit(lambda m, t, q, v: (Twin.psi_q(m, t, q), Twin.psi_dot(m, t, q, v)))(mechanism, t, q, v)
        return q, v - jnp.linalg.pinv(A, rtol=1e-9) @ rate

    return state
