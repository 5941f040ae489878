"""User-defined systems: other coordinates, mass matrices that are not diagonal, rolling and sliding."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.special import fresnel

import udkjax as udk
from udkjax.equations.states.quantities import equations_of
from udkjax.programs.deferred import deferred

G = 9.81
METHODS = udk.Auto(), udk.Greville(), udk.Elimination()
TS = np.linspace(0.0, 2.0, 9)
CHOICES: Any = {"rtol": 1e-10, "atol": 1e-10}


class Ball(eqx.Module):
    """A point mass on a sphere, with `copies` of the same constraint."""

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


def test_redundancy():
    """Three copies of a constraint act like one, and share its multiplier."""
    (q, v), triple = BALL_START, Ball(BALL.weight, BALL.radius, 3).system()
    pull = 1.5**2 - G * q[2]  # towards the centre, per mass; lambda = weight pull / (2 radius)

    @deferred
    def by_each(q, v):
        return [udk.accelerations(s, 0.0, q, v, m, multipliers=True) for m in METHODS for s in (BALL.system(), triple)]

    for k, (a, forces) in enumerate(by_each(q, v)):
        assert_allclose(a, -pull * q + jnp.array([0.0, 0.0, -G]), atol=1e-13)
        assert_allclose(forces, pull / (3 if k % 2 else 1), atol=1e-13)


def test_gains_feed_violations_back():
    """Both gains act on Psi, the first one on a velocity constraint; compared with a calculation by hand, off the manifold."""
    t, q, v = 0.3, jnp.array([0.7, 0.2, -0.8]), jnp.array([0.3, 1.0, 0.5])
    system = udk.ConstrainedSystem(BALL.mass, BALL.force, BALL.constraint, lambda t, q, v: v[0] - 0.2 * v[1] - t)
    a = udk.accelerations(system, t, q, v, stabilization=udk.Baumgarte(3.0, 7.0))
    assert_allclose(2 * q @ a, -2 * v @ v - 6.0 * 2 * q @ v - 49.0 * (q @ q - 1), rtol=1e-12)
    assert_allclose(a[0] - 0.2 * a[1] - 1, -6.0 * (v[0] - 0.2 * v[1] - t), rtol=1e-12)


def test_the_tangential_part_is_what_projection_leaves():
    """On a sphere, the part of changes of position and velocity that is orthogonal to the radius."""
    equations = equations_of(Ball(BALL.weight, BALL.radius, 3).system())
    q, v = BALL_START
    dq, dv = jnp.array([0.3, -0.2, 0.5]), jnp.array([1.0, 2.0, -1.0])
    for left, change in zip(equations.tangent_part(0.0, q, v, dq, dv)[:2], (dq, dv), strict=True):
        assert_allclose(left, change - q * (q @ change) / (q @ q), atol=1e-15)


@pytest.mark.slow
def test_a_batch_and_a_gradient():
    """Each radius has its own motion; derivatives with respect to radius and speed are compared with differences."""

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


def double(redundant):
    """A double pendulum of two unit point masses in its angles; if `redundant`, their sum is a coordinate, constrained twice."""

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


# --- runs: five systems side by side, each of which moves as it does alone


def in_angles():
    """The spherical pendulum in polar angles, by SciPy: theta from straight down, phi around the vertical."""

    def slope(t, y):
        theta, _, p, w = y
        return [p, w, np.sin(theta) * np.cos(theta) * w**2 - G * np.sin(theta), -2 * p * w / np.tan(theta)]

    y = solve_ivp(slope, (0, 2), [np.arcsin(0.6), 0.0, 0.0, 1.5 / 0.6], "DOP853", TS, rtol=1e-12, atol=1e-12).y
    return np.stack([np.sin(y[0]) * np.cos(y[1]), np.sin(y[0]) * np.sin(y[1]), -np.cos(y[0])], 1)


def on_blade(q):
    return jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2])])


W = 1.1  # rad/s
BEAD = np.array([0.5, 0.0]), np.array([0.0, 0.5 * W])


def side_by_side():
    """A ball on a sphere, said three times; a bead on a straight wire that turns; a body whose speed is prescribed; a blade on
    ice that a torque steers; and the double pendulum with one coordinate more."""
    swing: Any = double(True)
    fixed = jnp.diag(jnp.array([2.0, 2.0, 2.0, 0.7, 0.7, 1.0, 1.0, 1.5, 1.5, 0.4]))
    order = np.array([0, 3, 5, 7, 10])

    def parts(x):
        return [x[order[k] : end] for k, end in enumerate([*order[1:], 13])]

    def mass(q):
        *_, angles = parts(q)
        return jax.scipy.linalg.block_diag(fixed, swing.mass(angles))

    def force(t, q, v):
        return jnp.concatenate([jnp.array([0, 0, -2 * G, 0, 0, 0, 0, 0, 0, 0.8]), swing.force(t, parts(q)[4], parts(v)[4])])

    def constraint(t, q):
        ball, (x, y), _, _, angles = parts(q)
        wire = jnp.cos(W * t) * y - jnp.sin(W * t) * x
        return jnp.concatenate([jnp.tile(ball @ ball - 1.0, 3), wire[None], swing.constraint(t, angles)])

    def velocity_constraint(t, q, v):
        speed, blade = parts(v)[2:4]
        return jnp.stack([speed @ speed - (1 + t) ** 2, on_blade(parts(q)[3]) @ blade[:2]])

    return udk.ConstrainedSystem(mass, force, constraint, velocity_constraint), parts


@pytest.mark.parametrize(
    "stabilization",
    [udk.Projection(), *(pytest.param(s, marks=pytest.mark.slow) for s in (udk.Baumgarte(5.0, 5.0), None))],
    ids=lambda x: type(x).__name__,
)
def test_each_kind_of_constraint_along_a_motion(stabilization):
    """Holonomic and nonholonomic, linear and nonlinear, time-dependent, redundant, and with a full mass matrix."""
    (system, parts), projected = side_by_side(), isinstance(stabilization, udk.Projection)
    angles, rates = np.array([1.0, -0.4]), np.array([0.3, 1.2])
    q = np.concatenate([BALL_START[0], BEAD[0], np.zeros(2), np.zeros(3), angles, [angles.sum()]])
    v = np.concatenate([BALL_START[1], BEAD[1], [0.6, 0.8], [2.0, 0.0, 0.0], rates, [rates.sum()]])
    sol = udk.simulate(system, TS, udk.State(q, v), stabilization=stabilization, **CHOICES)
    assert sol.q.shape == (len(TS), 13)
    assert jnp.abs(udk.violation(system, sol)).max() < (1e-14 if projected else 1e-8)  # only Psi: six rows
    (ball, bead, moved, blade, angles), rates = (parts(x.T) for x in (np.asarray(sol.q), np.asarray(sol.v)))
    assert_allclose(ball.T, in_angles(), atol=1e-8)
    assert_allclose(ball[0] * rates[0][1] - ball[1] * rates[0][0], 0.9, atol=1e-8)  # its spin
    assert_allclose(np.sum(rates[0] ** 2, 0) / 2 + G * ball[2], 1.5**2 / 2 - 0.8 * G, atol=1e-8)
    assert_allclose(bead, 0.5 * np.cosh(W * TS) * np.stack([np.cos(W * TS), np.sin(W * TS)]), atol=1e-8)  # r'' = w^2 r
    assert_allclose(rates[2], np.outer([0.6, 0.8], 1 + TS), atol=1e-9)  # in free space the direction stays
    assert_allclose(moved, np.outer([0.6, 0.8], TS + TS**2 / 2), atol=1e-9)
    sine, cosine = (x * np.sqrt(2 * np.pi) for x in fresnel(TS * np.sqrt(2 / np.pi)))
    assert_allclose(blade, [cosine, sine, TS**2], atol=1e-8)  # Cornu's spiral, at 2 m/s
    assert_allclose(np.linalg.norm(rates[3][:2], axis=0), 2.0, atol=1e-8)
    assert_allclose(np.sum(np.asarray(on_blade(blade)) * rates[3][:2], 0), 0.0, atol=1e-14 if projected else 1e-8)
    kinetic = jax.vmap(lambda q, v: v @ double(True).mass(q) @ v / 2)(angles.T, rates[4].T)
    energy = kinetic - G * (2 * np.cos(angles[0]) + np.cos(angles[1]))
    assert_allclose(energy, energy[0], atol=1e-7)
    assert_allclose(angles[2], angles[0] + angles[1], atol=1e-12 if projected else 1e-8)


def test_a_mass_matrix_that_is_not_diagonal():
    """The added coordinate weighs 1e-3 along the sum of the angles: explicitly M + 1e-3 u u^T."""
    q, v = jnp.array([1.0, -0.4]), jnp.array([0.3, 1.2])
    u = jnp.ones(2)
    plain: Any = double(False)
    expected = jnp.linalg.solve(plain.mass(q) + 1e-3 * jnp.outer(u, u), plain.force(0.0, q, v))
    by_both = deferred(lambda q, v: [udk.accelerations(double(True), 0.0, q, v, method) for method in (udk.Auto(), udk.Varga())])
    for a in by_both(jnp.append(q, q.sum()), jnp.append(v, v.sum())):
        assert_allclose(a, jnp.append(expected, expected.sum()), atol=1e-11)
    assert_allclose(udk.accelerations(plain, 0.0, q, v), jnp.linalg.solve(plain.mass(q), plain.force(0.0, q, v)), atol=1e-13)


@pytest.mark.slow
def test_without_constraints_it_is_an_ordinary_equation():
    q, v = [1.0, -0.4], [0.3, 1.2]
    sol = udk.simulate(double(False), TS, udk.State(q, v), **CHOICES)

    def slope(t, y):
        s, c = np.sin(y[0] - y[1]), np.cos(y[0] - y[1])
        F = [-s * y[3] ** 2 - 2 * G * np.sin(y[0]), s * y[2] ** 2 - G * np.sin(y[1])]
        return [*y[2:], *np.linalg.solve([[2.0, c], [c, 1.0]], F)]

    expected = solve_ivp(slope, (0, 2), [*q, *v], "DOP853", TS, rtol=1e-12, atol=1e-12).y
    assert_allclose(sol.q, expected[:2].T, atol=1e-8)


def test_it_needs_a_state():
    with pytest.raises(ValueError, match="no initial guess"):
        udk.simulate(BALL.system(), TS)
