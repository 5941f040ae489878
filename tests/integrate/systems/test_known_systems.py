"""User-defined systems whose motion is known: exactly, by independent equations, or by what it conserves."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import udkjax as udk
from experiments.parts import closed_chains, stewart
from tests.integrate.systems import own_systems
from tests.integrate.systems.own_systems import G

TIGHT: Any = {"rtol": 1e-11, "atol": 1e-11}
TS = np.linspace(0.0, 10.0, 41)


def run(system, q, v, ts=TS, **choices):
    solution = udk.simulate(system, ts, udk.State(np.array(q), np.array(v)), **(TIGHT | choices))
    assert solution.settings["engine"] == "native"
    return solution


def by_scipy(slope, y0, ts=TS):
    return solve_ivp(slope, (ts[0], ts[-1]), y0, "DOP853", ts, rtol=1e-12, atol=1e-12).y


def test_a_conical_pendulum():
    radius, depth = 0.8, 0.6
    rate = np.sqrt(G / depth)
    q = run(own_systems.pendulum(), [radius, 0.0, -depth], [0.0, radius * rate, 0.0]).q
    circle = [radius * np.cos(rate * TS), radius * np.sin(rate * TS), 0 * TS - depth]
    assert_allclose(q, np.stack(circle, 1), rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_bead_on_a_turning_hoop():
    radius, rate, start = 0.5, 6.0, 2.5
    angle, _ = by_scipy(lambda t, y: [y[1], np.sin(y[0]) * (rate**2 * np.cos(y[0]) - G / radius)], [start, 0.0])
    out = radius * np.sin(start)
    solution = run(own_systems.bead_on_hoop(rate, radius), [out, 0.0, -radius * np.cos(start)], [0.0, out * rate, 0.0])
    out = radius * np.sin(angle)
    expected = [out * np.cos(rate * TS), out * np.sin(rate * TS), -radius * np.cos(angle)]
    assert_allclose(solution.q, np.stack(expected, 1), rtol=0, atol=1e-10)


def test_a_disc_rolls_in_a_circle():
    """Leaning at a constant angle, at the rate that balances the moments; its energy is that of its motion and its height."""
    lean, turn = -0.3, 2.0
    spin, system = own_systems.steady_spin(lean, turn), own_systems.disc()
    solution = run(system, [0.0, 0.0, 0.0, lean, 0.0], [0.4 * spin, 0.0, turn, 0.0, spin - turn * np.sin(lean)])
    radius = 0.4 * spin / turn
    circle = [radius * np.sin(turn * TS), radius * (1 - np.cos(turn * TS)), turn * TS, 0 * TS + lean]
    assert_allclose(solution.q[:, :4], np.stack(circle, 1), rtol=0, atol=1e-9)
    assert_allclose(udk.violation(system, solution), 0.0, atol=1e-14)
    total = udk.energy(system, solution).total
    assert_allclose(total, total[0], rtol=1e-12)
    assert total[0] > udk.energy(system, solution).potential[0] > 0.0


@pytest.mark.parametrize(
    ("chain", "rows", "rank"),
    [pytest.param(closed_chains.bennett, 14, 11, id="Bennett"), pytest.param(closed_chains.bricard, 24, 23, id="Bricard")],
)
@pytest.mark.slow
def test_an_overconstrained_chain_in_space(chain, rows, rank):
    """One freedom where counting finds none: rank n - 1 of more rows; closed and conservative for 100 s."""
    system = chain()
    start = udk.State(system.q0, system.v0)
    values = udk.singular_values(system, 0.0, start.q)
    assert int(np.sum(values > 1e-9 * values[0])) == rank == len(start.q) - 1
    ts = np.linspace(0.0, 100.0, 401)
    solution = run(system, start.q, start.v, ts)
    violated = udk.violation(system, solution)
    assert violated.shape == (401, rows)
    assert np.abs(violated).max() < 1e-12
    energy = udk.energy(system, solution)
    assert np.ptp(energy.total) < 1e-9 * energy.kinetic.max()
    moved = np.linalg.norm(np.diff(solution.q, axis=0), axis=1)
    assert moved.max() > 0.3


@pytest.mark.slow
def test_the_angles_of_bricards_chain():
    """Its threefold symmetry relates alternate angles: cos a + cos b + cos a cos b = 0."""
    system = closed_chains.bricard()
    q = run(system, system.q0, system.v0).q
    axes = np.asarray(q)[:, 12:].reshape(len(TS), 4, 3)
    points = np.asarray(q)[:, :12].reshape(len(TS), 4, 3)
    links = np.diff(points, axis=1)
    cosines = np.sum(links[:, 1:] * links[:, :-1], 2)  # between links that meet in a joint, both normal to its axis
    assert_allclose(np.linalg.norm(axes, axis=2), 1.0, atol=1e-12)
    a, b = cosines.T
    assert_allclose(a + b + a * b, 0.0, atol=1e-9)
    assert np.ptp(a) > 0.5


def rods_of_a04(a, b):
    """Points and axes of Bricard's chain by its angles, alternately a and b, in the axes of the benchmark."""
    frame, frames = jnp.eye(4), []
    for k in range(6):
        frames.append(frame)
        frame = frame @ turned((a, b)[k % 2], (1, -1)[k % 2])
    return jnp.stack(frames)[:, :3, 3], jnp.stack(frames)[:, :3, 2]


def turned(angle, twist):
    """The frame of the next joint: turned about z by an angle, moved by 1 along x, twisted about x by 90 degrees."""
    c, s, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
    rows = [[c, zero, twist * s, c], [s, zero, -twist * c, s], [zero, twist + zero, zero, zero], [zero, zero, zero, 1 + zero]]
    return jnp.stack([jnp.stack(row) for row in rows])


def path_of_a04(ts):
    """P3 by one coordinate: the angles follow the curve f = cos a + cos b + cos a cos b = 0, at the rate w of (f_b, -f_a)."""
    start = np.array(rods_of_a04(*[jnp.array(np.pi / 2)] * 2)[0])
    to_scene = np.linalg.lstsq(start, closed_chains.A04_POINTS, rcond=None)[0]  # both begin in the first joint
    assert_allclose(start @ to_scene, closed_chains.A04_POINTS, atol=1e-12)

    def along(y):
        a, b = y
        return jnp.stack([-jnp.sin(b) * (1 + jnp.cos(a)), jnp.sin(a) * (1 + jnp.cos(b))])

    def energies(y):
        (P, _), (dP, du) = jax.jvp(lambda y: rods_of_a04(*y), (y,), (along(y),))
        ends = dP[:-1], dP[1:]
        rods = sum(jnp.sum(x * z) for x, z in (ends, (ends[0], ends[0]), (ends[1], ends[1]))) / 3
        section = closed_chains.A04_WIDTH**2 / 12 * (jnp.sum(du[:-1] ** 2) + jnp.sum(du[1:] ** 2))
        return rods + section, G * jnp.sum((P[:-1] + P[1:]) @ to_scene[:, 1]) / 2  # per w^2 / 2, and V

    @jax.jit
    def slope(y):
        (inertia, _), (change, force) = jax.jvp(energies, (y[:2],), (along(y[:2]),))
        return jnp.append(y[2] * along(y[:2]), -(change * y[2] ** 2 / 2 + force) / inertia)

    y = by_scipy(lambda t, y: np.asarray(slope(y)), [np.pi / 2, np.pi / 2, 0.0], ts)
    return np.stack([rods_of_a04(*map(jnp.asarray, angles))[0][2] @ to_scene for angles in y[:2].T])


@pytest.mark.slow
def test_the_benchmark_a04():
    """The third point of the rods over the 10 s of the benchmark, by redundant coordinates and by one."""
    system = closed_chains.a04()
    solution = run(system, system.q0, system.v0)
    assert_allclose(np.asarray(solution.q)[:, 3:6], path_of_a04(TS), rtol=0, atol=1e-9)
    energy = udk.energy(system, solution)
    assert np.ptp(energy.total) < 1e-9 * energy.kinetic.max()
    assert udk.diagnose(system, udk.State(solution.q[0], solution.v[0])).degrees_of_freedom == 1


@pytest.mark.slow
def test_a_stewart_platform():
    """Thirteen bodies with 12 rows too many, beside Lagrange's equations of the platform's six coordinates."""
    ts, pose = np.linspace(0.0, 0.4, 5), np.array([0.05, -0.03, 0.95, 0.1, -0.15, 0.2])
    rest = np.asarray(stewart.lengths(jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])))
    system, q = stewart.system(rest), np.asarray(stewart.bodies(jnp.asarray(pose)))
    solution = run(system, q, 0 * q, ts)
    expected = np.stack([stewart.bodies(y) for y in stewart.poses(pose, rest, ts)])
    assert np.ptp(expected[:, -7:], axis=0).min() > 1e-3  # all coordinates of the platform move
    assert_allclose(solution.q, expected, rtol=0, atol=1e-11)
    assert_allclose(udk.violation(system, solution), 0.0, atol=1e-14)
    found = udk.diagnose(system, udk.State(q, 0 * q))
    assert (found.degrees_of_freedom, len(found.redundant)) == (6, 12)


@pytest.mark.slow
def test_satellites_keep_a_formation():
    """The relative motion is prescribed; the other is that of both masses together. The multipliers are the thrust."""
    distance, rate = 0.1, 3.0

    def gap(t):
        return distance * np.array([np.cos(rate * t), 0.8 * np.sin(rate * t), 0.6 * np.sin(rate * t)])

    def pull(r):
        return -r / np.linalg.norm(r) ** 3

    def slope(t, y):
        return [*y[3:], *((2 * pull(y[:3]) + pull(y[:3] + gap(t)) + rate**2 * gap(t)) / 3)]

    expected = by_scipy(slope, [1.0, 0, 0, 0, 1.0, 0])
    system = own_systems.satellites(distance, rate)
    q, v = [1.0, 0, 0, 1.0 + distance, 0, 0], [0, 1.0, 0, 0, 1.0 + 0.8 * distance * rate, 0.6 * distance * rate]
    solution = run(system, q, v)
    assert_allclose(solution.q[:, :3], expected[:3].T, rtol=0, atol=1e-9)
    assert_allclose(solution.q[:, 3:] - solution.q[:, :3], np.stack([gap(t) for t in TS]), rtol=0, atol=1e-13)
    load = udk.reactions(system, solution)["constraint"]["load"]
    assert_allclose(load[:, :3], -load[:, 3:], rtol=0, atol=1e-12)
    first = slope(0.0, expected[:, 0])[3:]
    assert_allclose(load[0, :3], 2 * (first - pull(expected[:3, 0])), rtol=0, atol=1e-10)


def test_a_rigid_body_by_a_quaternion():
    """Its angular velocity is that of Euler's equations, whatever inertia the norm of the quaternion has."""
    J, start = np.array([1.0, 2.0, 3.5]), np.array([0.3, 2.0, 0.1])

    def euler(t, w):
        return [
            (J[1] - J[2]) * w[1] * w[2] / J[0],
            (J[2] - J[0]) * w[2] * w[0] / J[1],
            (J[0] - J[1]) * w[0] * w[1] / J[2],
        ]

    bodies = (own_systems.quaternion_body(J, along) for along in (jnp.array(1.0), jnp.array(5.0)))
    one, other = (run(body, [1.0, 0, 0, 0], [0.0, *start / 2]) for body in bodies)
    omega = jax.vmap(lambda p, dp: own_systems.spinning(p, dp)[0])(one.q, one.v)
    assert_allclose(omega, by_scipy(euler, start).T, rtol=0, atol=5e-9)
    assert_allclose(one.q, other.q, rtol=0, atol=1e-10)


def test_a_singular_mass_matrix_is_named():
    system = own_systems.quaternion_body(np.array([1.0, 2.0, 3.5]), 0.0)
    with pytest.raises(udk.SimulationError, match="mass matrix is not positive definite: its eigenvalues are 0 to 14"):
        run(system, [1.0, 0, 0, 0], [0.0, 0.1, 0.2, 0.3])


@pytest.mark.slow
@pytest.mark.parametrize("method", [udk.Auto(), udk.SVD(), udk.Elimination()], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("coupling", [0.0, 0.2])
def test_a_linkage_that_folds_flat(method, coupling):
    """A parallelogram by its pins passes its singular configurations, also with a full M: it stays one and keeps its energy."""
    inertia = np.eye(4) + coupling

    def constraint(t, q):
        left, right = q[:2], q[2:]
        crank, bar = right - jnp.array([2.0, 0.0]), right - left
        return jnp.stack([left @ left - 1.0, crank @ crank - 1.0, bar @ bar - 4.0])

    system = udk.ConstrainedSystem(
        lambda q: jnp.asarray(inertia), constraint=constraint, potential=lambda t, q: G * (q[1] + q[3])
    )
    ts = np.linspace(0.0, 5.0, 101)
    solution = run(system, [0.0, -1.0, 2.0, -1.0], [8.0, 0.0, 8.0, 0.0], ts, method=method, rtol=1e-9, atol=1e-9)
    q = np.asarray(solution.q)
    assert_allclose(q[:, 2:] - q[:, :2], np.tile([2.0, 0.0], (101, 1)), atol=1e-12)
    assert np.sum(np.diff(np.sign(q[:, 1])) != 0) > 5  # flat many times
    total = udk.energy(system, solution).total
    assert_allclose(total, total[0], atol=1e-6)


@pytest.mark.slow
def test_sixty_coordinates():
    """A chain of twenty point masses: structural zeros keep its programs short; Psi holds, and so does the energy."""
    count = 20
    steps = np.random.default_rng(0).normal(size=(count, 3))
    points = np.cumsum(steps / np.linalg.norm(steps, axis=1)[:, None], 0)

    def constraint(t, q):
        P = jnp.concatenate([jnp.zeros((1, 3)), q.reshape(count, 3)])
        return jnp.sum(jnp.square(P[1:] - P[:-1]), 1) - 1.0

    system = udk.ConstrainedSystem(
        lambda q: jnp.eye(3 * count), constraint=constraint, potential=lambda t, q: G * jnp.sum(q[2::3])
    )
    solution = run(system, points.ravel(), 0 * points.ravel(), np.linspace(0.0, 0.5, 6), rtol=1e-9, atol=1e-9)
    assert_allclose(udk.violation(system, solution), 0.0, atol=1e-13)
    energy = udk.energy(system, solution)
    assert_allclose(energy.total, energy.total[0], atol=1e-6 * float(energy.kinetic.max()))
