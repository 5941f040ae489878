"""Trajectories by machine code equal those of textbook equations, which are solved in another way."""

import inspect
from importlib import import_module
from itertools import pairwise

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import udkjax as udk
from tests.calls import calls_of
from tests.choices import fast
from tests.textbook import terms

TOL = 1e-9
O = ((0.0, 0.0), (0.0, 0.0))  # noqa: E741
FAST = "parallelogram", "slider_crank"


def by_scipy(mechanism, ts, state=None, gains=(0.0, 0.0)):
    """The motion from M a + Psi_q^T lambda = F, Psi_q a = gamma in the least-squares sense, by SciPy."""
    state = udk.assemble(mechanism) if state is None else state
    n = state.q.size

    def slope(t, y):
        _, A, _, gamma, M, F = terms(mechanism, t, y[:n], y[n:])
        root = np.sqrt(M)
        a = F / M
        if len(A):
            a = a + np.linalg.lstsq(A / root, gamma - A @ a, rcond=1e-8)[0] / root
        return np.concatenate([y[n:], a])

    y0 = np.concatenate([np.ravel(state.q), np.ravel(state.v)])
    breaks = [] if mechanism.breakpoints is None else sorted(float(t) for t in mechanism.breakpoints if ts[0] < t < ts[-1])
    edges, found = [ts[0], *breaks, ts[-1]], {}
    for start, end in pairwise(edges):
        inside = [t for t in ts if start <= t <= end]
        run = solve_ivp(slope, (start, end), y0, "DOP853", t_eval=sorted({*inside, end}), rtol=1e-11, atol=1e-11)
        found |= dict(zip(run.t, run.y.T, strict=True))
        y0 = run.y[:, -1]
    ys = np.array([found[t] for t in ts])
    return ys[:, :n].reshape(len(ts), -1, 3), ys[:, n:].reshape(len(ts), -1, 3)


def agrees(mechanism, ts, atol=1e-6, **choices):
    """Return whether a run by machine code agrees with SciPy."""
    state = choices.pop("state", None)
    solution = udk.simulate(mechanism, ts, state, rtol=TOL, atol=TOL, **choices)
    q, v = by_scipy(mechanism, ts, state)
    assert_allclose(solution.q, q, atol=atol)
    assert_allclose(solution.v, v, atol=10 * atol * max(1.0, np.abs(v).max() / 10))
    return solution


@pytest.fixture(autouse=True)
def served(request):
    """Require machine code for all of these runs, except in tests that check this themselves."""
    with calls_of(import_module("udkjax.integrate.simulate")._finish) as calls:
        yield calls
    if "served" not in inspect.signature(request.function).parameters:
        assert all(natives(calls))


def natives(calls):
    """Return whether machine code ran, for each of some runs."""
    return [call.arguments["run"].problem.compiled.plan.is_native for call in calls]


@pytest.mark.parametrize("name", fast(FAST, udk.library.__all__))
def test_the_library(name):
    mechanism = getattr(udk.library, name)()
    end = min(0.6, 4 * float(udk.analyse(mechanism).time))  # Andrews' mechanism is a hundred times as fast as the others
    solution = agrees(mechanism, np.linspace(0.0, end, 7), atol=2e-7 * max(1.0, float(jnp.abs(mechanism.q0).max())))
    assert np.max(np.abs(udk.violation(mechanism, solution))) < 1e-9


def body(x=0.0, y=0.0, angle=0.0, v=(0.0, 0.0), omega=0.0):
    return udk.Body(1.3, 0.2, [x, y], angle, list(v), omega)


TIMES = np.linspace(0.3, 1.5, 9)


@pytest.fixture(scope="module")
def double():
    """A double pendulum with a damper, and its motion."""
    scene = udk.library.double_pendulum()
    damper = udk.TorsionSpring(scene.body_names, stiffness=1.0, damping=0.1)
    mechanism = udk.Mechanism(scene.bodies, scene.joints, forces={"damper": damper})
    return mechanism, by_scipy(mechanism, TIMES)


@pytest.mark.parametrize("stabilization", [udk.Projection(), udk.Baumgarte(5.0, 5.0), None])
def test_stabilizations(double, stabilization):
    mechanism, (q, v) = double
    solution = udk.simulate(mechanism, TIMES, rtol=TOL, atol=TOL, stabilization=stabilization)
    assert_allclose(solution.q, q, atol=1e-6)
    assert_allclose(solution.v, v, atol=1e-5)
    drift = np.max(np.abs(udk.violation(mechanism, solution)))
    assert drift < (1e-11 if stabilization == udk.Projection() else 1e-6)


@pytest.mark.parametrize(
    "solver",
    [diffrax.Tsit5(), diffrax.Heun(), *(pytest.param(s(), marks=pytest.mark.slow) for s in (diffrax.Bosh3, diffrax.Midpoint))],
    ids=str,
)
def test_explicit_methods(double, solver):
    mechanism, (q, _) = double
    order = solver.order(None)
    tol = {2: 1e-5, 3: 1e-7}.get(order, TOL)
    solution = udk.simulate(mechanism, TIMES, rtol=tol, atol=tol, solver=solver)
    assert_allclose(solution.q, q, atol=1e3 * tol)
    stats = {k: int(x) for k, x in solution.stats.items()}
    assert stats["steps"] == stats["accepted"] + stats["rejected"] and stats["accepted"] > 5
    tableau = solver.tableau
    stages = tableau.num_stages - bool(tableau.fsal)  # the end's accelerations are the next step's first
    assert stats["right_hand_sides"] >= stats["steps"] * (stages - 1)


def test_errors_follow_the_tolerance():
    """This includes outputs between steps."""
    mechanism, ts = udk.library.compound_pendulum(), np.linspace(0, 1, 8)
    q, _ = by_scipy(mechanism, ts)
    for tol in (1e-4, 1e-7, 1e-10):
        assert_allclose(udk.simulate(mechanism, ts, rtol=tol, atol=tol).q, q, atol=100 * tol)


class Pushes(udk.ForceElement):
    """A torque that jumps at two times, which are given as one vector."""

    times: jax.Array
    height: jax.Array

    def loads(self, t, *frames):
        one, other = self.times[0], self.times[1]
        return [(0.0, 0.0, jnp.where((t >= one) & (t < other), self.height, -0.5 * self.height))]

    @property
    def breakpoints(self):
        return self.times


def pushed(times=(0.25, 0.6)):
    scene = udk.library.compound_pendulum()
    return udk.Mechanism(scene.bodies, scene.joints, forces={"f": Pushes(["rod"], jnp.array(times), jnp.asarray(8.0))})


@pytest.mark.parametrize("ts", [[0.1, 0.25, 0.4, 0.55], [0.0, 0.25, 0.6], [0.25, 0.3, 0.9]], ids=str)
def test_runs_start_anew_behind_breakpoints(ts):
    """Output times may be breakpoints, also the first and the last one; and without a projection."""
    agrees(pushed(), np.array(ts), atol=2e-8, stabilization=udk.Projection() if ts[0] else None)


def test_breakpoints_may_lie_close_together_and_out_of_order():
    agrees(pushed((0.5, 0.499999)), np.linspace(0.0, 1.0, 5), atol=1e-6)


def test_splines():
    motion = udk.Spline([0.0, 0.2, 0.5], [0.0, 0.3, 0.2])
    mechanism = udk.Mechanism(
        {"a": body()}, {"pin": udk.Revolute(["ground", "a"], O)}, {"turn": udk.Driver(["ground", "a"], "angle", motion)}
    )
    solution = udk.simulate(mechanism, [0.0, 0.1, 0.2, 0.4], rtol=1e-6, atol=1e-6)
    assert_allclose(solution.q[:, 0, 2], [float(motion(t)) for t in solution.ts], atol=1e-9)


def turned_by_a_cam(lift=0.2):
    angles = np.linspace(0.0, 2 * np.pi, 9)[:-1]
    return udk.Mechanism(
        {"cam": udk.Body(1.0, 0.1, angular_velocity=3.0), "follower": udk.Body(0.5, 0.1, [0.0, 1.2])},
        {
            "pin": udk.Revolute(["ground", "cam"], O),
            "guide": udk.Prismatic(["ground", "follower"], O, axis=np.pi / 2),
            "contact": udk.Cam(["cam", "follower"], O, udk.Profile(angles, 1.0 + lift * np.cos(angles))),
        },
    )


@pytest.mark.slow
def test_cams():
    """This includes outputs between steps near the boundary of two cubics of the profile."""
    mechanism, ts = turned_by_a_cam(), np.linspace(0.0, 1.5, 61)
    solution = agrees(mechanism, ts, atol=1e-7)
    batch = jax.jit(jax.vmap(lambda tol: udk.simulate(mechanism, ts, rtol=tol, atol=tol, throw=False)))(jnp.full(8, TOL))
    assert_allclose(batch.q, np.broadcast_to(solution.q, batch.q.shape), atol=1e-9)


@pytest.mark.slow
def test_derivatives_along_cams():
    def lifted(lift):
        return udk.simulate(turned_by_a_cam(lift), np.linspace(0.0, 1.5, 4), rtol=1e-11, atol=1e-11).q[-1, 0, 2]

    known = udk.analyse(turned_by_a_cam())

    def traced(radius):
        scene = turned_by_a_cam().with_parameters({"joint.contact.profile.radius": radius})
        return udk.simulate(scene, np.linspace(0.0, 1.5, 4), rtol=1e-9, atol=1e-9, analysis=known, throw=False).q[-1, 0, 2]

    radius = turned_by_a_cam().joints["contact"].profile.radius
    along = jnp.cos(jnp.arange(8) * jnp.pi / 4)
    slope = (lifted(0.2 + 1e-4) - lifted(0.2 - 1e-4)) / 2e-4
    forward, gradient = jax.jit(lambda r: (jax.jvp(traced, (r,), (along,))[1], jax.grad(traced)(r)))(radius)
    assert_allclose(forward, slope, rtol=2e-6)
    assert_allclose(gradient @ along, slope, rtol=2e-6)


def test_a_first_step_is_taken_as_given():
    mechanism = udk.library.compound_pendulum()
    few, many = (udk.simulate(mechanism, [0.0, 1e-3], dt0=dt0, rtol=1e-3, atol=1e-3) for dt0 in (1.0, 1e-9))
    assert few.stats["steps"] == 1 and 6 <= many.stats["steps"] <= 9  # ten times as long at most, one after another
    assert_allclose(few.q, many.q, atol=1e-10)


def test_it_takes_no_less_from_late_times_and_backward_offsets():
    """The motion is the same a million seconds later."""
    mechanism = udk.library.compound_pendulum()
    one, other = (udk.simulate(mechanism, np.linspace(0.0, 1.0, 5) + start, rtol=1e-9, atol=1e-9).q for start in (0.0, 1e6))
    assert_allclose(one, other, atol=1e-8)


# --- what is integrated otherwise


def traced(mechanism, **choices):
    """A run that is not compiled: its engine is known beforehand."""
    jax.eval_shape(lambda start: udk.simulate(mechanism, [0.0, 0.1], start, **choices).q, udk.State(mechanism.q0, mechanism.v0))


@pytest.mark.slow
def test_what_has_no_machine_code_is_integrated_by_another_engine(served):
    scene = udk.library.compound_pendulum()

    class Odd(udk.ForceElement):
        def loads(self, t, *frames):
            return [(0.0, 0.0, jax.lax.erf_inv(0.5 * jnp.cos(frames[0].angle)))]

    mechanism = udk.Mechanism(scene.bodies, scene.joints, forces={"f": Odd(["rod"])})
    agrees(mechanism, np.linspace(0.0, 0.5, 4))
    assert served and not any(natives(served))


class Learned(udk.ForceElement):
    law: eqx.nn.MLP

    def loads(self, t, *frames):
        (rod,) = frames
        return [(0.0, 0.0, self.law(jnp.stack([rod.omega, rod.angle]))[0])]


def test_a_small_network_is_integrated_by_either_engine(served):
    del served
    scene = udk.library.compound_pendulum()
    law = eqx.nn.MLP(2, 1, 3, 1, activation=jnp.tanh, key=jax.random.key(1))
    mechanism = udk.Mechanism(scene.bodies, scene.joints, forces={"f": Learned(["rod"], law)})
    agrees(mechanism, np.linspace(0.0, 0.5, 4))


def test_solvers_of_several_steps_are_not_served(served):
    traced(udk.library.compound_pendulum(), solver=udk.BDF())
    assert not any(natives(served))
