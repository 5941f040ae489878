"""A user's script without udkjax for the paper's linkage: dense matrices, derivatives by JAX, diffrax."""

import diffrax
import jax
import jax.numpy as jnp

PIVOTS, PINS = jnp.array([0.0, 1.0, 2.0]), jnp.array([-1.0, 0.0, 1.0])
MASS = jnp.array([1.0, 1.0, 0.1] * 3 + [2.0, 2.0, 0.2])
WEIGHT = jnp.array([0.0, -9.81, 0.0] * 4)
MAX_STEPS = 100_000


def psi(q):
    """Return 12 rows: each link's foot on the ground, its tip on the coupler."""
    link, coupler = q[:9].reshape(3, 3), q[9:]
    half = 0.5 * jnp.stack([jnp.cos(link[:, 2]), jnp.sin(link[:, 2])], axis=1)
    feet = link[:, :2] - half - jnp.stack([PIVOTS, 0.0 * PIVOTS], axis=1)
    along = jnp.stack([jnp.cos(coupler[2]), jnp.sin(coupler[2])])
    tips = link[:, :2] + half - coupler[:2] - PINS[:, None] * along
    return jnp.concatenate([feet.ravel(), tips.ravel()])


def gamma(q, v):
    """Return -(Psi_q v)_q v."""
    return -jax.jvp(lambda q: jax.jvp(psi, (q,), (v,))[1], (q,), (v,))[1]


def by_pinv(y):
    """Solve the Udwadia-Kalaba equation with a dense pseudoinverse, as the paper writes it."""
    q, v = y[:12], y[12:]
    root = MASS**-0.5
    psi_q = jax.jacfwd(psi)(q)
    a = WEIGHT + root * (jnp.linalg.pinv(psi_q * root, rtol=1e-4) @ (gamma(q, v) - psi_q @ WEIGHT))
    return jnp.concatenate([v, a])


def by_cholesky(y, baumgarte=10.0, tikhonov=1e-4, mass=MASS, weight=WEIGHT):
    """Solve it with Cholesky factors of D D^T, regularized, and stabilized."""
    q, v = y[:12], y[12:]
    root = mass**-0.5
    psi_q = jax.jacfwd(psi)(q)
    D = psi_q * root
    b = gamma(q, v) - 2 * baumgarte * (psi_q @ v) - baumgarte**2 * psi(q) - psi_q @ weight
    factor = jax.scipy.linalg.cho_factor(D @ D.T + tikhonov * jnp.eye(12))
    return jnp.concatenate([v, weight + root * (D.T @ jax.scipy.linalg.cho_solve(factor, b))])


def solve(ts, tikhonov=1e-4, adjoint=None):
    """Return a function from a state (24,) and a tolerance to the coordinates (T, 12) at `ts`; masses and weight may differ."""

    def run(y0, tol, mass=MASS, weight=WEIGHT):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: by_cholesky(y, tikhonov=tikhonov, mass=args[0], weight=args[1])),
            diffrax.Dopri8(),
            t0=ts[0],
            t1=ts[-1],
            dt0=None,
            y0=y0,
            args=(mass, weight),
            saveat=diffrax.SaveAt(ts=ts),
            stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol),
            adjoint=diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
            max_steps=MAX_STEPS,
            throw=False,
        )
        assert solution.ys is not None
        return solution.ys[:, :12]

    return run
