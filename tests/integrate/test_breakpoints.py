"""Times at which the motion is not smooth: outputs there are as accurate as elsewhere, and so are their derivatives."""

from itertools import pairwise
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import udkjax as udk
from udkjax.scene.elements.splines import natural_spline

TS = np.linspace(0.0, 2.0, 401)
KNOTS, VALUES = np.array([0.0, 0.37, 0.71, 1.13, 1.6]), np.array([0.0, 0.12, -0.1, 0.15, 0.05])
SWITCH, KICK = 0.9, 4.0
MASS, INERTIA, ARM, ANGLE, GRAVITY = 1.0, 0.1, 0.5, -0.9, 9.81


class Kicked(udk.Motion):
    """A user-defined motion: a spline, plus a constant acceleration from some time on."""

    spline: udk.Spline
    switch: Any
    kick: Any

    def __call__(self, t):
        return self.spline(t) + 0.5 * self.kick * jnp.where(t < self.switch, 0.0, t - self.switch) ** 2

    @property
    def breakpoints(self):
        return [*self.spline.breakpoints, self.switch]


def pendulum(motion):
    """A pendulum on a carriage with a given motion."""
    bodies = {
        "carriage": udk.Body(2.0, 1.0),
        "rod": udk.Body(MASS, INERTIA, ARM * np.array([np.cos(ANGLE), np.sin(ANGLE)]), ANGLE),
    }
    joints = {
        "rail": udk.Prismatic(["ground", "carriage"], np.zeros((2, 2)), 0.0),
        "pin": udk.Revolute(["carriage", "rod"], [[0.0, 0.0], [-ARM, 0.0]]),
    }
    return udk.Mechanism(bodies, joints, {"drive": udk.Driver(["ground", "carriage"], "x", motion)})


def kicked(x):
    knots, switch = x
    return pendulum(Kicked(udk.Spline(knots, VALUES), jnp.asarray(switch), jnp.asarray(KICK)))


def start(knots):
    """The rod at rest above a carriage that follows the spline."""
    x, rate = jax.jvp(lambda t: natural_spline(t, knots, jnp.asarray(VALUES)), (0.0,), (1.0,))
    q = [[x, 0.0, 0.0], [x + ARM * np.cos(ANGLE), ARM * np.sin(ANGLE), ANGLE]]
    return udk.State(jnp.array(q), jnp.array([[rate, 0.0, 0.0], [rate, 0.0, 0.0]]))


def angles(x, ts=TS, tol=1e-8, **choices):
    """Angle and rate of the rod (2, T) as a function of the knots and of the time of the kick."""
    found = udk.simulate(kicked(x), ts, start(x[0]), rtol=tol, atol=tol, method=udk.Elimination(), throw=False, **choices)
    return jnp.stack([found.q[:, 1, 2], found.v[:, 1, 2]])


def reference(knots=KNOTS, switch=SWITCH, kick=KICK, ts=TS):
    """The same by the pendulum's equation of motion, from each breakpoint or output to the next."""
    spline, y, found = CubicSpline(knots, VALUES, bc_type="natural"), np.array([ANGLE, 0.0]), {}
    stops = np.unique([*ts, *(t for t in (*knots, switch) if ts[0] < t < ts[-1])])
    found[ts[0]] = y
    for a, b in pairwise(stops):
        curvature = (lambda t: spline(t, 2)) if knots[0] < (a + b) / 2 < knots[-1] else (lambda t: 0.0)
        push = kick * ((a + b) / 2 > switch)

        def rates(t, y, curvature=curvature, push=push):
            torque = MASS * ARM * (np.sin(y[0]) * (curvature(t) + push) - np.cos(y[0]) * GRAVITY)
            return [y[1], torque / (INERTIA + MASS * ARM**2)]

        y = found[b] = solve_ivp(rates, (a, b), y, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return np.array([found[t] for t in ts]).T


def assert_within(found, expected, tol, times=10.0):
    """Require that all angles and rates are within a multiple of the tolerance of a step, tol (1 + |y|)."""
    errors = np.abs(np.asarray(found) - expected) / (tol * (1.0 + np.abs(expected)))
    assert errors.max() < times, errors.max(axis=-1)


# --- outputs


@pytest.mark.slow
@pytest.mark.parametrize("tol", [1e-6, 1e-8])
def test_outputs_of_a_motion_by_a_spline(tol):
    """With interpolation across knots, angles were off by 9e-3 and rates by 0.8 at a tolerance of 1e-6."""
    mech = pendulum(udk.Spline(KNOTS, VALUES))
    sol = udk.simulate(mech, TS, start(KNOTS), rtol=tol, atol=tol)
    assert_within([sol.q[:, 1, 2], sol.v[:, 1, 2]], reference(kick=0.0), tol)
    assert sol.stats["rejected"] <= 0.1 * sol.stats["steps"]  # two of five where steps come upon the knots


@pytest.fixture(scope="module")
def single():
    return jax.jit(lambda x, tol: angles(x, tol=tol, dt0=0.03))


@pytest.mark.parametrize("switch", [SWITCH, 0.71, np.nextafter(0.71, 1.0), 0.71 + 1e-9, 0.0, 2.0], ids=str)
def test_outputs_of_a_motion_that_names_its_times(single, switch):
    """Accelerations jump, also where two breakpoints coincide or nearly do, and at the ends of the run."""
    found = single((jnp.asarray(KNOTS), jnp.asarray(switch)), 1e-8)
    assert_within(found, reference(switch=switch), 1e-8)


@pytest.mark.slow
def test_members_of_a_batch_have_breakpoints_of_their_own(single):
    shifts = np.array([[0.0, 0.0, 0.1], [0.05, 0.02, -0.3], [0.0, 0.3, 0.6], [0.1, -0.1, 2.0]])
    knots = jnp.asarray(KNOTS + np.stack([np.zeros(4), shifts[:, 0], shifts[:, 1], np.zeros(4), np.zeros(4)], 1))
    switches = jnp.asarray(SWITCH + shifts[:, 2])
    found = jax.jit(jax.vmap(lambda *x: angles(x, dt0=0.03)))(knots, switches)
    for k in range(4):
        assert_within(found[k], reference(np.asarray(knots[k]), float(switches[k])), 1e-8)
        assert_allclose(found[k], single((knots[k], switches[k]), 1e-8), rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    "choices",
    [
        {"solver": diffrax.Tsit5()},
        pytest.param({"solver": udk.Adams()}, marks=pytest.mark.slow),
        pytest.param({"solver": diffrax.Kvaerno4()}, marks=pytest.mark.slow),
    ],
)
def test_other_solvers(choices):
    """Other solvers of this engine and of diffrax."""
    ts = TS[::20]
    found = udk.simulate(kicked((KNOTS, SWITCH)), ts, start(KNOTS), rtol=1e-6, atol=1e-6, method=udk.Elimination(), **choices)
    assert_within([found.q[:, 1, 2], found.v[:, 1, 2]], reference(ts=ts), 1e-6)


# --- derivatives


@pytest.fixture(scope="module")
def by_differences():
    """Derivatives of the reference with respect to each knot and the switch, at other times than these, by differences."""
    ts, h = np.linspace(0.0, 2.0, 12), 1e-4
    each = lambda k, sign: (KNOTS + sign * h * (np.arange(5) == k), SWITCH + sign * h * (k == 5))  # noqa: E731
    ahead, behind = (np.stack([reference(*each(k, s), ts=ts) for k in range(6)], -1) for s in (1, -1))
    return ts, (ahead - behind) / (2 * h)


@pytest.mark.slow
def test_derivatives_along_breakpoints(by_differences):
    """Forward, and reverse by a recorded run. The first knot is left out, since the spline is another line before it."""
    ts, expected = by_differences
    x, weights = (jnp.asarray(KNOTS), jnp.asarray(SWITCH)), np.cos(np.arange(2.0 * len(ts))).reshape(2, -1)
    forward = jax.jit(jax.jacfwd(lambda x: angles(x, ts, dt0=0.03, adjoint=diffrax.ForwardMode())))(x)
    forward = np.concatenate([forward[0], forward[1][..., None]], -1)
    assert_allclose(forward[..., 1:], expected[..., 1:], rtol=0, atol=1e-5)
    reverse = jax.jit(jax.grad(lambda x: jnp.sum(weights * angles(x, ts, dt0=0.03))))(x)
    assert_allclose(np.append(*reverse), np.tensordot(weights, forward, 2), rtol=0, atol=1e-9)


# --- pieces of the state: a cam, whose profile is a spline in the angle, and a force of a user's own

PHI, RADII = np.array([-1.2, -0.2, 0.7, 1.7, 2.9, 4.0]), np.array([1.0, 1.06, 1.2, 1.1, 1.02, 0.97])
CAM_TS = TS[::4]


def follower(radii, rate, tol=1e-8, phi=PHI, **choices):
    """Angle and rate (2, T) of a free cam, which its follower turns unevenly, as a function of the follower's mass."""
    fixed, profile = np.zeros((2, 2)), udk.Profile(phi, radii)
    joints = {
        "pivot": udk.Revolute(["ground", "cam"], fixed),
        "rail": udk.Prismatic(["ground", "follower"], fixed, np.pi / 2, 0.0),
        "contact": udk.Cam(["cam", "follower"], fixed, profile),
    }
    bodies = {"cam": udk.Body(1.0, INERTIA), "follower": udk.Body(MASS, 1.0, (0.0, 1.1))}
    mech = udk.Mechanism(bodies, joints)
    radius, slope = jax.jvp(profile, (np.pi / 2,), (1.0,))
    q = jnp.stack([jnp.zeros(3), jnp.stack([0.0, radius, 0.0])])
    v = rate * jnp.stack([jnp.array([0.0, 0.0, 1.0]), jnp.stack([0.0, -slope, 0.0])])
    run = udk.simulate(mech, CAM_TS, udk.State(q, v), rtol=tol, atol=tol, method=udk.Elimination(), throw=False, **choices)
    return jnp.stack([run.q[:, 0, 2], run.v[:, 0, 2]])


def by_energy(radii, rate):
    """The same in another way: the rate from the energy, and the time from its integral over the angle, knot by knot."""
    spline = CubicSpline(np.append(PHI, PHI[0] + 2 * np.pi), np.append(radii, radii[0]), bc_type="periodic")
    inertia = lambda angle: INERTIA + MASS * spline(np.pi / 2 - angle, 1) ** 2  # noqa: E731
    energy = inertia(0.0) * rate**2 / 2 + MASS * GRAVITY * spline(np.pi / 2)
    speed = lambda angle: np.sqrt(2 * (energy - MASS * GRAVITY * spline(np.pi / 2 - angle)) / inertia(angle))  # noqa: E731
    nodes, weights = np.polynomial.legendre.leggauss(60)
    time = lambda a, b: (b - a) / 2 * np.sum(weights / speed((a + b) / 2 + (b - a) / 2 * nodes))  # noqa: E731
    knots = np.sort(np.ravel(np.pi / 2 - PHI[:, None] + 2 * np.pi * np.arange(-2, 12)))
    found, start, begin = [], 0.0, 0.0
    for t in CAM_TS:
        while begin + time(start, end := knots[knots > start][0]) < t:
            begin, start = begin + time(start, end), end
        angle = start + (t - begin) * speed(start)
        for _ in range(20):
            angle -= (begin + time(start, angle) - t) * speed(angle)
        found.append((angle, speed(angle)))
    return np.array(found).T


@pytest.fixture(scope="module")
def cam():
    run = jax.jit(follower)
    return lambda *x: run(*map(jnp.asarray, x))


@pytest.mark.slow
@pytest.mark.parametrize("tol", [1e-6, 1e-8])
def test_outputs_across_the_knots_of_a_cam(cam, tol):
    """With interpolation across knots, rates were off by up to 0.7 rad/s."""
    assert_within(cam(RADII, 4.0, tol, PHI), by_energy(RADII, 4.0), tol)


@pytest.mark.slow
def test_derivatives_across_the_knots_of_a_cam():
    """They are as large as 80. If steps end in the piece after a knot, derivatives of outputs before it are off by 0.06."""
    weights, h = np.cos(np.arange(2.0 * len(CAM_TS))).reshape(2, -1), 1e-5
    x, along = (jnp.asarray(RADII), jnp.asarray(4.0)), (jnp.cos(jnp.arange(6.0)), jnp.asarray(1.0))
    forward = jax.jit(lambda x, dx: jax.jvp(lambda x: follower(*x, dt0=0.03, adjoint=diffrax.ForwardMode()), (x,), (dx,))[1])
    found = forward(x, along)
    ahead, behind = (by_energy(RADII + s * h * along[0], 4.0 + s * h * along[1]) for s in (1, -1))
    assert_allclose(found, (ahead - behind) / (2 * h), rtol=0, atol=3e-4)
    reverse = jax.jit(jax.grad(lambda x: jnp.sum(weights * follower(*x, dt0=0.03))))(x)
    assert_allclose(np.dot(reverse[0], along[0]) + reverse[1], np.sum(weights * found), rtol=1e-9)


def test_a_cam_at_rest_on_a_knot(cam):
    """Rounding puts it in one piece or the other. In both cases the run ends."""
    phi, radii = np.pi / 2 + np.array([-2.0, -1.0, 0.0, 1.0, 2.0, np.pi]), np.array([1.2, 1.1, 1.0, 1.1, 1.2, 1.25])
    assert_allclose(cam(radii, 1e-15, 1e-8, phi), 0.0, atol=1e-9)


class Buffer(udk.ForceElement):
    """A user-defined spring that only pushes: a force in two pieces."""

    stiffness: Any

    def loads(self, t, *frames):
        return [(-self.stiffness * jnp.maximum(frames[0].x, 0.0), 0.0, 0.0)]

    def piece(self, t, *frames):
        return frames[0].x > 0.0


def test_a_force_that_names_its_pieces():
    """A body hits it and returns."""
    stiffness, rate, gap, tol = 400.0, 1.5, 0.6, 1e-8
    bodies = {"body": udk.Body(1.0, 1.0, (-gap, 0.0), velocity=(rate, 0.0))}
    mech = udk.Mechanism(bodies, forces={"buffer": Buffer(["body"], stiffness)}, gravity=(0.0, 0.0))
    sol = udk.simulate(mech, TS, rtol=tol, atol=tol)
    since, w = TS - gap / rate, np.sqrt(stiffness)
    x = np.where(since < 0, rate * since, np.where(w * since < np.pi, rate / w * np.sin(w * since), -rate * (since - np.pi / w)))
    v = np.where(since < 0, rate, np.where(w * since < np.pi, rate * np.cos(w * since), -rate))
    assert_within([sol.q[:, 0, 0], sol.v[:, 0, 0]], [x, v], tol)


class Reversal(udk.ForceElement):
    """A force along x that changes its sign at a given time."""

    time: float = 0.3

    def loads(self, t, *frames):
        return [(jnp.where(t < self.time, 1.0, -5.0), 0.0, 0.0)]

    @property
    def breakpoints(self):
        return [self.time]


@pytest.mark.parametrize(("engine", "end"), [("native", 0.3), ("native", 0.5), pytest.param("jax", 0.5, marks=pytest.mark.slow)])
def test_an_event_and_the_end_may_be_at_a_breakpoint(engine, end):
    ball = udk.Mechanism({"ball": udk.Body(1.0, 0.1)}, forces=[Reversal(["ball"])], gravity=(0.0, 0.0))
    line = udk.Event(lambda t, at: at["ball"].x - 0.045, udk.Log(), name="line")  # which it passes at 0.3 s, but for rounding
    found = udk.simulate(ball, [0.0, end], events=[line], engine=engine, rtol=1e-8, atol=1e-8)
    later = end - 0.3
    assert_allclose(found.q[-1, 0, 0], 0.045 + 0.3 * later - 2.5 * later**2, atol=1e-12)
    assert found.stats["steps"] < 60  # not one window after another up to the breakpoint


class Staircase(udk.ForceElement):
    """A force that is held between samples, and grows in steps with the place: kinks beside breakpoints are not located."""

    held: Any
    growth: float

    def loads(self, t, *frames):
        return [(self.held(t) + self.growth * jnp.floor(frames[0].x * 10.0), 0.0, 0.0)]


@pytest.mark.parametrize("tol", [1e-5, 1e-8])
def test_sudden_changes_beside_breakpoints(tol):
    """Steps as short as these changes require say nothing of the motion before them: a velocity there was 1e14 m/s."""
    cases = (
        ([10.0, -30.0], 2.0),
        ([10.0, -30.0], 5.0),
        ([7995.0, -5794.0, -2903.0, 4103.0, 215.0, 8786.0], 8.11),
    )
    for forces, growth in cases:
        steps = Staircase(["ball"], udk.Held(np.array(forces), 0.1), growth)
        ball = udk.Mechanism({"ball": udk.Body(1.0, 0.1)}, forces={"steps": steps}, gravity=(0.0, 0.0))
        ts = np.linspace(0.0, 0.5, 51)
        run = udk.simulate(ball, ts, rtol=tol, atol=tol)
        q, v = run.q[:, 0, 0], run.v[:, 0, 0]
        # The change of v in an interval, with x from Hermite's cubic: floor(10 x) differs from 10 x - 1/2 by at most 1/2.
        held, h = np.array(forces)[np.minimum((ts[:-1] * 10.0 + 1e-9).astype(int), len(forces) - 1)], np.diff(ts)
        mean_x = (q[1:] + q[:-1]) / 2 - np.diff(v) * h / 12
        within = 20 * tol * np.abs(v).max()
        assert_allclose(np.diff(v), h * (held + growth * (10.0 * mean_x - 0.5)), rtol=0.0, atol=growth * h[0] / 2 + within)
        for k in (10, 20, 30):
            clock = udk.Event(lambda t, at, time=ts[k]: t - time, udk.Stop(), name="clock")
            stopped = udk.simulate(ball, ts[::10], events=clock, rtol=tol, atol=tol)
            assert stopped.events is not None
            assert_allclose(stopped.events.v_before[0, 0, 0], v[k], rtol=0.0, atol=within)


def test_outputs_after_jumps_beside_a_stiff_damper():
    """A torque jumps: w = tau / c, but for I / c = 7 ns, which no step resolves. Derivatives and lanes, too."""
    inertia, damping, torques = 0.07, 1e7, np.array([0.8, -1.0, 0.3, 1.2, -0.7, 0.1])
    ts = np.append(0.0, 0.1 * np.arange(1, 12) + 0.013)

    def speeds(torques, tol=1e-9):
        """Return c w, which is tau."""
        rotor = {"rotor": udk.Body(1.0, inertia, angular_velocity=2.0)}
        pin = {"pin": udk.Revolute(["ground", "rotor"], [[0.0, 0.0], [0.0, 0.0]])}
        drag = udk.TorsionSpring(["ground", "rotor"], stiffness=0.0, damping=damping, angle=0.0)
        held = udk.Torque(["ground", "rotor"], udk.Held(torques, 0.2))
        mechanism = udk.Mechanism(rotor, pin, forces={"drag": drag, "held": held}, gravity=[0.0, 0.0])
        return damping * udk.simulate(mechanism, ts, rtol=tol, atol=tol).v[1:, 0, 2]

    now = (ts[1:, None] // 0.2 == np.arange(6)).astype(float)
    for tol in (1e-6, 1e-9):
        assert_allclose(speeds(torques, tol), now @ torques, rtol=0.0, atol=1e-4)
    factors = jnp.array([1.0, -2.0, 3.0])
    assert_allclose(jax.vmap(lambda x: speeds(x * torques))(factors), factors[:, None] * (now @ torques), rtol=0.0, atol=1e-4)
    for transform in (jax.jacfwd, jax.jacrev):
        assert_allclose(transform(speeds)(jnp.asarray(torques)), now, rtol=0.0, atol=1e-4)
