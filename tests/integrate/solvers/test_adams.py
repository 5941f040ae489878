"""Adams methods: order, cost compared with VODE, accuracy, and everything that a diffrax solver must support."""

import math
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.special import ellipj, ellipk

import udkjax as udk
from benchmarks.integrators import FINER, Work, vode
from benchmarks.problems import NOT_STIFF, pendulum
from tests.choices import fast
from udkjax.integrate.solvers.counting import CountingController, Wrapper, count_evaluations, evaluations, tally
from udkjax.integrate.solvers.multistep import Tolerances

solve_ode: Any = diffrax.diffeqsolve  # whose parts are None where they were not asked for
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
QUICK = diffrax.PIDController(rtol=1e-9, atol=1e-9)


def program(f, solver, counting=count_evaluations):
    """Solve y' = f(t, y) for any numbers with one compilation. Return the run, the actual calls of f, and the reported calls."""
    called = []

    def counted(t, y, args):
        jax.debug.callback(lambda: called.append(None))
        return f(t, y)

    @jax.jit
    def solve(y0, ts, dt0, tol):
        counted_solver, control = counting(solver, diffrax.PIDController(rtol=tol, atol=tol))
        return diffrax.diffeqsolve(
            diffrax.ODETerm(counted),
            counted_solver,
            ts[0],
            ts[-1],
            dt0,
            y0,
            stepsize_controller=control,
            saveat=diffrax.SaveAt(ts=ts, solver_state=True, controller_state=True),
        )

    def run(y0, ts, tol, dt0=1e-4):
        called.clear()
        found = jax.block_until_ready(solve(jnp.array(y0), jnp.array(ts), dt0, tol))
        jax.effects_barrier()
        return found, len(called), int(evaluations(found.controller_state))

    return run


@pytest.fixture(scope="module")
def swing():
    """The program of the pendulum with each corrector."""
    return {corrector: program(pendulum, udk.Adams(corrector=corrector)) for corrector in ("pece", "iteration")}


@pytest.fixture(scope="module", params=fast(["pece"], ["pece", "iteration"]))
def pendulums(swing, request):
    return swing[request.param]


def exact_pendulum(ts):
    """Angle (rad) and rate (rad/s) of a pendulum released at 2 rad."""
    k, w = np.sin(1.0), np.sqrt(9.81)
    sn, cn, *_ = ellipj(ellipk(k**2) + w * np.asarray(ts), k**2)
    return np.stack([2 * np.arcsin(k * sn), 2 * k * w * cn], axis=1)


class TestPendulum:
    ts = np.linspace(0.0, 2.0, 41)  # 1.5 swings
    y0 = (2.0, 0.0)

    @pytest.mark.parametrize("tol", TOLERANCES)
    def test_error_is_that_asked_for(self, pendulums, tol):
        """It holds at the end and between steps: the polynomial of a step has the order of the step."""
        run, *_ = pendulums(self.y0, self.ts, tol)
        assert np.abs(run.ys - exact_pendulum(self.ts)).max() < 10 * tol

    @pytest.mark.parametrize("dt0", [1e-6, 1e-4, 1e-2, 1.0])
    def test_every_call_is_counted(self, pendulums, dt0):
        run, called, counted = pendulums(self.y0, self.ts, 1e-8, dt0)
        assert called == counted
        assert run.solver_state.evaluations <= called  # those of rejected steps are not in the state

    def test_any_first_step(self, pendulums):
        runs = [pendulums(self.y0, self.ts, 1e-8, dt0) for dt0 in (1e-6, 1e-4, 1e-2, 1.0)]
        calls = [counted for _, _, counted in runs]
        assert max(calls) < 1.25 * min(calls)
        for run, *_ in runs:
            assert np.abs(run.ys - exact_pendulum(self.ts)).max() < 1e-7

    def test_two_calls_a_step(self, swing):
        run, called, _ = swing["pece"](self.y0, self.ts, 1e-8)
        accepted, rejected = run.stats["num_accepted_steps"], run.stats["num_rejected_steps"]
        assert called == 1 + 2 * accepted + rejected

    def test_tightest_tolerance(self, pendulums):
        """Rounding errors neither stop the run nor make its steps tiny."""
        run, called, _ = pendulums(self.y0, self.ts, 1e-13)
        assert np.abs(run.ys - exact_pendulum(self.ts)).max() < 1e-11
        assert called < 600

    def test_backwards(self, pendulums):
        run, *_ = pendulums(exact_pendulum([2.0])[0], self.ts[::-1], 1e-9, -1e-3)
        np.testing.assert_allclose(run.ys, exact_pendulum(self.ts[::-1]), rtol=0, atol=3e-8)


def ratios(problem, run):
    """Calls relative to those of VODE's Adams methods at equal error. Work is interpolated between FINER tolerances."""
    yardstick = Work([vode(problem, tol) for tol in FINER])
    found = []
    for tol in (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
        result, called, _ = run(problem.y0, (0.0, problem.end), tol)
        found.append(called / yardstick.at(problem.error(result.ys[-1])))
    found = np.array(found)
    return found[np.isfinite(found)]  # at the loosest tolerances VODE itself has lost the orbit


@pytest.mark.slow
def test_cost_beside_vode(pendulums):
    found = ratios(NOT_STIFF["pendulum"], pendulums)
    assert len(found) >= 6 and found.max() < 1.5 and found.mean() < 1


@pytest.mark.slow
@pytest.mark.parametrize("corrector", ["pece", "iteration"])
@pytest.mark.parametrize("name", ["Arenstorf", "Pleiades"])
def test_cost_beside_vode_in_orbits(name, corrector):
    found = ratios(NOT_STIFF[name], program(NOT_STIFF[name].f, udk.Adams(corrector=corrector)))
    assert len(found) >= 6 and found.max() < 1.5 and found.mean() < 1


@pytest.fixture(scope="module", params=["pece", "iteration"])
def steps(request):
    """Steps of a fixed order and size for y' = f(t, y, args), with exact values of f before the start."""
    solver = udk.Adams(corrector=request.param, root_finder=Tolerances(1e-14, 1e-14), root_find_max_steps=9)
    rows = solver.max_order + 2

    def make(f, exact):
        @eqx.filter_jit
        def run(order, h, args, count):
            terms = diffrax.ODETerm(f)
            start = solver.init(terms, 0.0, h, exact(0.0, args), args)
            values = [f(-h * j, exact(-h * j, args), args) for j in range(rows)]
            phi = jnp.stack([sum((-1) ** j * math.comb(i, j) * values[j] for j in range(i + 1)) for i in range(rows)])
            fixed = lambda s: eqx.tree_at(lambda s: (s.control.order, s.control.step), s, (order, h))  # noqa: E731
            start = eqx.tree_at(lambda s: (s.phi, s.points), start, (phi, jnp.array(rows)))

            def step(i, carry):
                y, state = carry
                y, _, _, state, _ = solver.step(terms, i * h, (i + 1) * h, y, args, fixed(state), False)
                return y, state

            return jax.lax.fori_loop(0, count, step, (exact(0.0, args), start))[0]

        return run

    return make


def test_polynomials_are_integrated_exactly(steps):
    """Order k interpolates k + 1 values of f, and is exact up to degree k but no higher."""
    exact = lambda t, degree: jnp.array([(t + 3.0) ** (degree + 1)])  # noqa: E731
    run = steps(lambda t, y, degree: jnp.array([(degree + 1) * (t + 3.0) ** degree]), exact)
    for order in range(1, 13):
        errors = []
        for degree in (order, order + 1):
            end = float(exact(1.5, jnp.array(float(degree)))[0])
            errors.append(abs(float(run(jnp.array(order), 0.5, jnp.array(float(degree)), 3)[0]) / end - 1))
        assert errors[0] < 1e-12 < 100 * errors[0] < errors[1] or errors[0] < 1e-13 < errors[1]


@pytest.mark.slow
def test_order_of_convergence(steps):
    """The result of order k is corrected to order k + 1."""
    run = steps(lambda t, y, args: -(y**2), lambda t, args: jnp.array([1 / (args + t)]))
    for order in range(1, 13):
        # above rounding errors: the higher the order, the larger the steps
        h, shift, time = (0.1, 6.0, 4.0) if order < 6 else (0.4, 10.0, 8.0) if order < 9 else (0.8, 14.0, 8.0)
        counts, end = (round(time / h), round(2 * time / h)), 1 / (shift + time)
        errors = [abs(float(run(jnp.array(order), time / n, jnp.array(shift), n)[0]) - end) for n in counts]
        rate = np.log2(errors[0] / errors[1])
        assert rate > order + 0.9
        assert rate < order + 1.6 or order > 5  # for high ones these steps are large still


def oscillator(t, y, a):
    """Solve y'' = -a y from (1, 0): y = cos(sqrt(a) t)."""
    return {"y": y["v"], "v": -a * y["y"]}


START = {"y": jnp.array(1.0), "v": jnp.array([0.0])[0]}


def test_any_pytree_and_float_tolerances():
    run = solve_ode(diffrax.ODETerm(oscillator), udk.Adams(), 0.0, 3.0, None, START, 4.0, stepsize_controller=QUICK)
    np.testing.assert_allclose([run.ys["y"][-1], run.ys["v"][-1]], [np.cos(6.0), -2 * np.sin(6.0)], atol=3e-8)


class TestDerivatives:
    """Derivatives of cos(sqrt(a) t) with respect to a and t."""

    @staticmethod
    def end(a, t, adjoint, corrector: Literal["pece", "iteration"] = "pece"):
        term, solver = diffrax.ODETerm(oscillator), udk.Adams(corrector=corrector)
        return solve_ode(term, solver, 0.0, t, 1e-3, START, a, stepsize_controller=QUICK, adjoint=adjoint, max_steps=300).ys["y"][
            0
        ]

    a, t = jnp.array([4.0, 9.0, 1.0]), jnp.array([3.0, 1.0, 2.0])
    exact = (-t * jnp.sin(jnp.sqrt(a) * t) / (2 * jnp.sqrt(a)), -jnp.sqrt(a) * jnp.sin(jnp.sqrt(a) * t))

    @pytest.mark.slow
    @pytest.mark.parametrize("corrector", ["pece", "iteration"])
    def test_reverse_of_a_batch(self, corrector):
        """The members end at different times."""
        end = lambda a, t: self.end(a, t, diffrax.RecursiveCheckpointAdjoint(), corrector)  # noqa: E731
        found = jax.jit(jax.vmap(jax.grad(end, argnums=(0, 1))))(self.a, self.t)
        np.testing.assert_allclose(found, self.exact, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_batch_is_its_members(swing):
    """Each member has its own order and step."""
    y0 = jnp.array([[2.0, 0.0], [0.1, 0.0], [3.0, 1.0]])

    @jax.jit
    def solve(y0):
        term = diffrax.ODETerm(lambda t, y, args: pendulum(t, y))
        save = diffrax.SaveAt(t1=True, solver_state=True)
        run = solve_ode(term, udk.Adams(), 0.0, 2.0, 1e-3, y0, stepsize_controller=QUICK, saveat=save)
        return run.ys[0], run.solver_state.evaluations

    states, calls = jax.vmap(solve)(y0)
    assert len(set(calls.tolist())) > 1
    for member, state, called in zip(y0, states, calls):
        alone, called_alone = solve(member)
        assert called == called_alone
        np.testing.assert_allclose(state, alone, rtol=0, atol=1e-13)


@jax.jit
def swing_down(a):
    """The pendulum of frequency sqrt(a), from 2 rad to the vertical."""
    term = diffrax.ODETerm(lambda t, y, a: jnp.stack([y[1], -a * jnp.sin(y[0])]))
    event = diffrax.Event(lambda t, y, args, **_: y[0], optx.Newton(1e-12, 1e-12))
    options = {"saveat": diffrax.SaveAt(dense=True, t1=True), "stepsize_controller": QUICK, "event": event, "max_steps": 200}
    return solve_ode(term, udk.Adams(), 0.0, 3.0, 1e-3, jnp.array([2.0, 0.0]), a, **options)


QUARTER = ellipk(np.sin(1.0) ** 2) / np.sqrt(9.81)  # s, of its period


@pytest.mark.slow
def test_dense_output():
    """It is as accurate as the steps, and continuous. An event is found in it."""
    run = swing_down(9.81)
    assert float(run.ts[0]) == pytest.approx(QUARTER, abs=1e-8)
    times = np.linspace(0.0, QUARTER, 500)
    assert np.abs(jax.vmap(run.interpolation.evaluate)(times) - exact_pendulum(times)).max() < 1e-8
    steps = np.asarray(run.interpolation.ts)
    steps = steps[(steps > 0) & (steps < QUARTER)]
    around = [jax.vmap(run.interpolation.evaluate)(steps * (1 + side)) for side in (-1e-15, 1e-15)]
    np.testing.assert_allclose(*around, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_time_of_an_event_has_a_derivative():
    assert float(jax.jit(jax.grad(lambda a: swing_down(a).ts[0]))(9.81)) == pytest.approx(-QUARTER / (2 * 9.81), rel=1e-6)


class OnCircle(Wrapper):
    """Steps of a solver, each followed by projection on the unit circle, as on a constraint."""

    solver: diffrax.AbstractSolver

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, error, dense, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        error = tally(self.solver, error, solver_state, state, made_jump)
        return y1 / jnp.linalg.norm(y1), error, dense, state, result


@pytest.mark.slow
@pytest.mark.parametrize("corrector", ["pece", "iteration"])
def test_projected_states_enter_the_history(corrector):
    """The newest point is replaced, at no more than two calls per attempt, and the method need not start anew at every step."""
    on_circle = lambda solver, control: (OnCircle(solver), CountingController(control))  # noqa: E731
    run = program(lambda t, y: jnp.stack([y[1], -y[0]]), udk.Adams(corrector=corrector), on_circle)
    found, called, counted = run((1.0, 0.0), np.linspace(0.0, 20.0, 3), 1e-9)
    np.testing.assert_allclose(found.ys, [[1, 0], [np.cos(10), -np.sin(10)], [np.cos(20), -np.sin(20)]], rtol=0, atol=2e-8)
    assert called == counted < 450
    if corrector == "pece":
        assert called <= 2 * found.stats["num_steps"] + 2


@pytest.mark.slow
def test_jump():
    """f jumps at 1. If the method knows of the jump, it starts anew there; otherwise it copes as well."""
    term = diffrax.ODETerm(lambda t, y, args: jnp.where(t < 1.0, 50.0 * jnp.cos(50.0 * t), 100.0 * jnp.cos(50.0 * t)))
    exact = np.sin(50.0) + 2 * (np.sin(100.0) - np.sin(50.0))
    steps = []
    for control in (QUICK, diffrax.ClipStepSizeController(QUICK, jump_ts=[1.0])):
        run = solve_ode(term, udk.Adams(), 0.0, 2.0, 1e-3, jnp.array(0.0), stepsize_controller=control)
        assert float(run.ys[0]) == pytest.approx(exact, abs=3e-8)
        steps.append(int(run.stats["num_steps"]))
    assert steps[1] < steps[0]


def test_first_step_out_of_the_domain():
    """y' = -1 / (2 y), y = sqrt(1 - t): the first trial step ends where y is infinite."""
    term = diffrax.ODETerm(lambda t, y, args: -0.5 / y)
    run = solve_ode(term, udk.Adams(), 0.0, 0.9, 2.0 - 1e-9, jnp.array(1.0), stepsize_controller=QUICK)
    assert float(run.ys[0]) == pytest.approx(np.sqrt(0.1), abs=3e-8)


def test_bad_input():
    with pytest.raises(ValueError, match="1 <= min_order <= max_order <= 12, not min_order=1, max_order=13"):
        udk.Adams(max_order=13)
    with pytest.raises(ValueError, match="'pc'"):
        udk.Adams("pc")  # pyright: ignore[reportArgumentType]
