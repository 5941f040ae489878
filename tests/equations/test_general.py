"""Systems of the user's own: other coordinates, masses that are not diagonal, rolling and gliding."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import udkjax as udk
from udkjax.equations import constraints, loads
from udkjax.equations.quantities import equations_of

G = 9.81
STABILIZATIONS = {"projection": udk.Projection(), "Baumgarte": udk.Baumgarte(5.0, 5.0), "none": None}
DENSE = {m.__name__: m() for m in (udk.Auto, udk.SVD, udk.Varga, udk.Greville, udk.Householder, udk.GramSchmidt, udk.Elimination)}
TS = np.linspace(0.0, 2.0, 9)
with_gains_too = pytest.mark.parametrize("stabilization", list(STABILIZATIONS.values())[:2], ids=list(STABILIZATIONS)[:2])
by_projection = pytest.mark.parametrize(  # the others by one motion, the bead's
    "stabilization",
    [pytest.param(s, id=k, marks=pytest.mark.slow if k != "projection" else ()) for k, s in STABILIZATIONS.items()],
)


def run(system, q, v, stabilization=udk.Projection(), tol=1e-10, ts=TS, **choices):
    return udk.simulate(system, ts, udk.State(q, v), rtol=tol, atol=tol, stabilization=stabilization, **choices)


class Ball(eqx.Module):
    """A point mass on a sphere: the same constraint said `copies` times."""

    weight: jax.Array
    radius: jax.Array
    copies: int = eqx.field(static=True, default=1)

    def mass(self, q):
        return self.weight * jnp.eye(3)

    def force(self, t, q, v):
        return self.weight * jnp.array([0.0, 0.0, -G])

    def constraint(self, t, q):
        return jnp.tile(q @ q - self.radius**2, self.copies)

    def system(self):
        return udk.ConstrainedSystem(self.mass, self.force, self.constraint)


BALL = Ball(jnp.array(2.0), jnp.array(1.0))
BALL_START = (jnp.array([0.6, 0.0, -0.8]), jnp.array([0.0, 1.5, 0.0]))


# --- spherical pendulum


@pytest.fixture(scope="module")
def in_angles():
    """The same pendulum in polar angles, by SciPy: theta from straight down, phi around."""

    def slope(t, y):
        theta, _, p, w = y
        return [p, w, np.sin(theta) * np.cos(theta) * w**2 - G * np.sin(theta), -2 * p * w / np.tan(theta)]

    y = solve_ivp(slope, (0, 2), [np.arcsin(0.6), 0.0, 0.0, 1.5 / 0.6], "DOP853", TS, rtol=1e-12, atol=1e-12).y
    return np.stack([np.sin(y[0]) * np.cos(y[1]), np.sin(y[0]) * np.sin(y[1]), -np.cos(y[0])], 1)


@by_projection
def test_spherical_pendulum(in_angles, stabilization):
    sol = run(BALL.system(), *BALL_START, stabilization)
    assert sol.q.shape == (len(TS), 3)
    assert_allclose(sol.q, in_angles, atol=1e-8)
    spin = sol.q[:, 0] * sol.v[:, 1] - sol.q[:, 1] * sol.v[:, 0]
    assert_allclose(spin, 0.9, atol=1e-8)
    energy = jnp.sum(sol.v**2, 1) / 2 + G * sol.q[:, 2]
    assert_allclose(energy, 1.5**2 / 2 - 0.8 * G, atol=1e-8)
    assert jnp.abs(udk.violation(BALL.system(), sol)).max() < (1e-14 if isinstance(stabilization, udk.Projection) else 1e-8)


@pytest.mark.parametrize(
    "method", [DENSE["Auto"], DENSE["Greville"], DENSE["Elimination"]], ids=["Auto", "Greville", "Elimination"]
)
def test_redundancy(method):
    """Three times the same constraint moves as one does; its multiplier is shared."""
    q, v = BALL_START
    triple = Ball(BALL.weight, BALL.radius, 3).system()
    solve = lambda system, q, v: udk.accelerations(system, 0.0, q, v, method, multipliers=True)  # noqa: E731
    (one, force), (three, forces) = jax.jit(lambda q, v: [solve(system, q, v) for system in (BALL.system(), triple)])(q, v)
    pull = 1.5**2 - G * q[2]  # towards the centre, per mass; lambda = weight pull / (2 radius)
    assert_allclose(one, -pull * q + jnp.array([0.0, 0.0, -G]), atol=1e-13)
    assert_allclose(force, pull, atol=1e-13)
    assert_allclose(three, one, atol=1e-13)
    assert_allclose(forces, pull / 3, atol=1e-13)


@pytest.mark.parametrize("copies", [1, 3])
def test_the_tangential_part_is_what_projection_leaves(copies):
    """On a sphere: of changes of position and velocity what is orthogonal to the radius."""
    equations = equations_of(Ball(BALL.weight, BALL.radius, copies).system())
    q, v = BALL_START
    dq, dv = jnp.array([0.3, -0.2, 0.5]), jnp.array([1.0, 2.0, -1.0])
    for left, change in zip(equations.tangent_part(0.0, q, v, dq, dv)[:2], (dq, dv), strict=True):
        assert_allclose(left, change - q * (q @ change) / (q @ q), atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("method", [udk.SVD(), udk.GramSchmidt()], ids=["SVD", "GramSchmidt"])
def test_redundancy_along_a_motion(in_angles, method):
    sol = run(Ball(BALL.weight, BALL.radius, 3).system(), *BALL_START, method=method)
    assert_allclose(sol.q, in_angles, atol=1e-8)


@pytest.mark.slow
def test_a_batch_and_a_gradient():
    """Each radius is its own motion; derivatives of the end with respect to radius and speed against differences."""

    def end(p):
        ball = Ball(jnp.array(2.0), p[0])
        state = udk.State(p[0] * BALL_START[0], p[1] * BALL_START[1])
        return udk.simulate(ball.system(), TS[:5], state, rtol=1e-10, atol=1e-10).q[-1]

    points = jnp.array([[1.0, 1.0], [1.2, 0.8], [0.9, 1.1]])
    h = 1e-5
    shifted = jnp.concatenate([points, points[:1] + h * jnp.array([[1, 0], [-1, 0], [0, 1], [0, -1]])])
    batch = jax.jit(jax.vmap(end))(shifted)
    assert_allclose(jnp.linalg.norm(batch, axis=1), shifted[:, 0], atol=1e-13)
    assert_allclose(batch[0], jax.jit(end)(points[0]), atol=1e-12)
    slope = jax.jit(jax.jacrev(end))(points[0])
    assert_allclose(slope, jnp.stack([batch[3] - batch[4], batch[5] - batch[6]], 1) / (2 * h), atol=1e-6)
    assert_allclose(batch[0] @ slope, [1.0, 0.0], atol=1e-8)  # |q| = radius


# --- nonholonomic


def knife(steer=0.0):
    """A blade on ice: x, y, angle; no velocity across the blade."""
    return udk.ConstrainedSystem(
        mass=lambda q: jnp.diag(jnp.array([1.5, 1.5, 0.4])),
        force=lambda t, q, v: jnp.array([0.0, 0.0, steer]),
        velocity_constraint=lambda t, q, v: jnp.sin(q[2]) * v[0] - jnp.cos(q[2]) * v[1],
    )


@by_projection
def test_a_blade_on_ice_runs_in_a_circle(stabilization):
    speed, turn = 2.0, 1.3
    sol = run(knife(), [0.0, 0.0, 0.0], [speed, 0.0, turn], stabilization)
    angle = turn * TS
    circle = np.stack([np.sin(angle), 1 - np.cos(angle)], 1) * speed / turn
    assert_allclose(sol.q, np.column_stack([circle, angle]), atol=1e-8)
    assert_allclose(jnp.linalg.norm(sol.v[:, :2], axis=1), speed, atol=1e-8)
    across = jnp.sin(sol.q[:, 2]) * sol.v[:, 0] - jnp.cos(sol.q[:, 2]) * sol.v[:, 1]
    assert_allclose(across, 0.0, atol=1e-14 if isinstance(stabilization, udk.Projection) else 1e-8)
    assert udk.violation(knife(), sol).shape == (len(TS), 0)  # no Psi


@pytest.mark.slow
def test_a_blade_that_is_steered():
    """With a constant torque the path is Cornu's spiral: the angle grows with the square of time, the speed stays."""
    sol = run(knife(0.8), [0.0, 0.0, 0.0], [2.0, 0.0, 0.0])
    assert_allclose(sol.q[:, 2], TS**2, atol=1e-8)
    s = np.linspace(0, 2, 4001)
    x = np.trapezoid(np.cos(s**2), s) * 2.0
    assert_allclose(sol.q[-1, 0], x, atol=1e-6)


def test_a_velocity_that_is_prescribed_and_not_linear():
    """|v|^2 = c(t): Appell's kind. In free space without a force the direction stays."""
    system = udk.ConstrainedSystem(
        lambda q: jnp.eye(2), lambda t, q, v: jnp.zeros(2), velocity_constraint=lambda t, q, v: v @ v - (1 + t) ** 2
    )
    sol = run(system, [0.0, 0.0], [0.6, 0.8])
    assert_allclose(sol.v, np.outer(1 + TS, [0.6, 0.8]), atol=1e-9)
    assert_allclose(sol.q, np.outer(TS + TS**2 / 2, [0.6, 0.8]), atol=1e-9)


# --- rheonomic


@with_gains_too
def test_a_bead_on_a_turning_wire(stabilization):
    """r'' = w^2 r on a straight wire that turns with w: r = r0 cosh(w t)."""
    w = 1.1
    system = udk.ConstrainedSystem(
        mass=lambda q: 0.7 * jnp.eye(2),
        force=lambda t, q, v: jnp.zeros(2),
        constraint=lambda t, q: jnp.cos(w * t) * q[1] - jnp.sin(w * t) * q[0],
    )
    sol = run(system, [0.5, 0.0], [0.0, 0.5 * w], stabilization)
    r = 0.5 * np.cosh(w * TS)
    assert_allclose(sol.q, np.stack([r * np.cos(w * TS), r * np.sin(w * TS)], 1), atol=1e-8)
    _, force = udk.accelerations(system, 0.0, jnp.array([0.5, 0.0]), jnp.array([0.0, 0.5 * w]), multipliers=True)
    assert_allclose(force, 0.0, atol=1e-12)  # 2 m w r' = 0 at the start


# --- a mass matrix that is full


def double(redundant):
    """A double pendulum of two unit point masses in its angles; `redundant` adds their sum as a coordinate, and says so twice."""

    def mass(q):
        c = jnp.cos(q[0] - q[1])
        M = jnp.array([[2.0, c], [c, 1.0]])
        return jnp.block([[M, jnp.zeros((2, 1))], [jnp.zeros((1, 2)), jnp.full((1, 1), 1e-3)]]) if redundant else M

    def force(t, q, v):
        s = jnp.sin(q[0] - q[1])
        F = jnp.array([-s * v[1] ** 2 - 2 * G * jnp.sin(q[0]), s * v[0] ** 2 - G * jnp.sin(q[1])])
        return jnp.append(F, 0.0) if redundant else F

    def constraint(t, q):
        gap = q[0] + q[1] - q[2]
        return jnp.array([gap, -3.0 * gap])

    return udk.ConstrainedSystem(mass, force, constraint if redundant else None)


def test_a_mass_matrix_that_is_not_diagonal():
    """The added coordinate weighs 1e-3 along the sum of the angles: M + 1e-3 u u^T, explicitly."""
    q, v = jnp.array([1.0, -0.4]), jnp.array([0.3, 1.2])
    u = jnp.ones(2)
    plain = double(False)
    expected = jnp.linalg.solve(plain.mass(q) + 1e-3 * jnp.outer(u, u), plain.force(0.0, q, v))
    by_all = jax.jit(lambda q, v: [udk.accelerations(double(True), 0.0, q, v, method) for method in DENSE.values()])
    for a in by_all(jnp.append(q, q.sum()), jnp.append(v, v.sum())):
        assert_allclose(a, jnp.append(expected, expected.sum()), atol=1e-11)
    assert_allclose(udk.accelerations(plain, 0.0, q, v), jnp.linalg.solve(plain.mass(q), plain.force(0.0, q, v)), atol=1e-13)


def test_without_constraints_it_is_an_ordinary_equation():
    q, v = [1.0, -0.4], [0.3, 1.2]
    sol = run(double(False), q, v)

    def slope(t, y):
        s, c = np.sin(y[0] - y[1]), np.cos(y[0] - y[1])
        F = [-s * y[3] ** 2 - 2 * G * np.sin(y[0]), s * y[2] ** 2 - G * np.sin(y[1])]
        return [*y[2:], *np.linalg.solve([[2.0, c], [c, 1.0]], F)]

    expected = solve_ivp(slope, (0, 2), [*q, *v], "DOP853", TS, rtol=1e-12, atol=1e-12).y
    assert_allclose(sol.q, expected[:2].T, atol=1e-8)


@by_projection
@pytest.mark.slow
def test_mass_redundancy_and_constraints_along_a_motion(stabilization):
    q, v = np.array([1.0, -0.4]), np.array([0.3, 1.2])
    sol = run(double(True), [*q, q.sum()], [*v, v.sum()], stabilization)
    energy = jax.vmap(lambda q, v: v @ double(True).mass(q) @ v / 2 - G * (2 * jnp.cos(q[0]) + jnp.cos(q[1])))(sol.q, sol.v)
    assert_allclose(energy, energy[0], atol=1e-7)
    assert_allclose(sol.q[:, 2], sol.q[:, 0] + sol.q[:, 1], atol=1e-12)


# --- the same linkage by either way


@pytest.mark.slow
def test_a_mechanism_written_by_hand_moves_alike():
    mech = udk.library.parallelogram(np.deg2rad(-50))
    system = udk.ConstrainedSystem(
        mass=lambda q: jnp.diag(loads.mass(mech)),
        force=lambda t, q, v: loads.force(mech, t, q, v),
        constraint=lambda t, q: constraints.psi(mech, t, q),
    )
    q, v = mech.q0.ravel(), mech.v0.ravel()
    a, forces = udk.accelerations(system, 0.0, q, v, multipliers=True)
    expected, known = udk.accelerations(mech, 0.0, mech.q0, mech.v0, multipliers=True)
    assert_allclose(a, expected.ravel(), atol=1e-12)
    assert_allclose(forces, known, atol=1e-11)


def test_it_needs_a_state():
    with pytest.raises(ValueError, match="initial state"):
        udk.simulate(BALL.system(), TS)
