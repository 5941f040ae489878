"""Backward differentiation formulas: order, cost and accuracy, and everything that a diffrax solver must support."""

import math
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import udkjax as udk
from benchmarks.problems import STIFF
from tests.choices import fast
from udkjax.integrate.solvers.counting import count_evaluations, evaluations
from udkjax.integrate.solvers.multistep import Tolerances

# y(t0), y(t0 - h), ... of Gear's formulas, sum a[j] y[-j] = h y'
GEAR = {
    1: [1, -1],
    2: [3 / 2, -2, 1 / 2],
    3: [11 / 6, -3, 3 / 2, -1 / 3],
    4: [25 / 12, -4, 3, -4 / 3, 1 / 4],
    5: [137 / 60, -5, 5, -10 / 3, 5 / 4, -1 / 5],
}


def controller(rtol, atol):
    return diffrax.PIDController(rtol=rtol, atol=atol, norm=optx.max_norm)


@pytest.fixture(scope="module")
def stiff(data):
    """Runs of a stiff problem at several tolerances by one program, and its references."""
    reference, done = data("stiff_problems"), {}

    def runs(name):
        if name not in done:
            known = reference[name]
            ts, scale, states = (np.array(known[key]) for key in ("times", "scale", "states"))
            solve, called, differentiated, traced = _solver_of(STIFF[name].f)
            found, traces = [], []
            for rtol in (1e-4, 1e-6, 1e-8):
                called.clear()
                differentiated.clear()
                run = solve(jnp.array(STIFF[name].y0), ts, rtol, rtol * scale)
                jax.effects_barrier()
                errors = np.abs(run.ys - states) / (scale + np.abs(states))
                found.append((rtol, errors, run, len(called), len(differentiated)))
                traces.append(len(traced))
            assert traces[0] == traces[-1]  # other numbers compile nothing
            done[name] = found, known["vode"]
        return done[name]

    return runs


def _solver_of(f):
    """Return a program that solves y' = f, and lists of its calls, differentiations and traces of f."""
    called, differentiated, traced = [], [], []

    @jax.custom_jvp
    def watched(y):
        return y

    @watched.defjvp
    def _(primals, tangents):
        jax.debug.callback(lambda: differentiated.append(None))
        return primals[0], tangents[0]

    def counted(t, y, args):
        traced.append(None)
        jax.debug.callback(lambda: called.append(None))
        return f(t, watched(y))

    @jax.jit
    def solve(y0, ts, rtol, atol):
        solver, control = count_evaluations(udk.BDF(), controller(rtol, atol))
        return diffrax.diffeqsolve(
            diffrax.ODETerm(counted),
            solver,
            0.0,
            ts[-1],
            1e-6,
            y0,
            stepsize_controller=control,
            saveat=diffrax.SaveAt(ts=ts, solver_state=True, controller_state=True),
            max_steps=100_000,
        )

    return solve, called, differentiated, traced


@pytest.mark.parametrize("name", fast(["Robertson"], STIFF))
class TestStiffProblems:
    def test_error(self, stiff, name):
        """It is within a factor of ten of the tolerance, at the end and on the way, also before jumps, which enlarge it."""
        for rtol, errors, *_ in stiff(name)[0]:
            assert errors.max() < 10 * rtol

    def test_calls_are_counted(self, stiff, name):
        for _, _, run, called, _ in stiff(name)[0]:
            assert evaluations(run.controller_state) == called
            assert run.solver_state.evaluations <= called

    def test_cost(self, stiff, name):
        """VODE uses the same formulas, and on average over the tolerances takes more right-hand sides for the same error."""
        found, vode = stiff(name)
        errors, calls = np.log([(row["error"], row["right_hand_sides"]) for row in vode]).T
        curve = np.polynomial.Polynomial.fit(errors, calls, 2)
        ratios = [called / np.exp(curve(np.log(errors.max()))) for _, errors, _, called, _ in found]
        assert max(ratios) < 1.5
        assert np.mean(ratios) < 1.0

    def test_jacobian_serves_many_steps(self, stiff, name):
        """It is computed only where it is used. Diffrax discards those of rejected steps."""
        for _, _, run, _, differentiated in stiff(name)[0]:
            steps, counted = int(run.stats["num_accepted_steps"]), int(run.solver_state.jacobians)
            assert counted <= differentiated <= counted + run.stats["num_rejected_steps"]
            assert differentiated < steps / 15
            assert run.solver_state.factorizations < steps / 5


@pytest.fixture(scope="module")
def steps():
    """A function that makes steps of a given order and size from the exact history of y' = -y^2, y = 1 / (2 + t)."""
    solver = udk.BDF(root_finder=Tolerances(1e-12, 1e-12), root_find_max_steps=9)
    terms, exact = diffrax.ODETerm(lambda t, y, _: -(y**2)), lambda t: jnp.array([1 / (2 + t)])

    @jax.jit
    def steps(order, h):
        state = solver.init(terms, 0.0, h, exact(0.0), None)
        values = [exact(-h * j) for j in range(len(state.phi))]
        phi = jnp.stack([sum((-1) ** j * math.comb(i, j) * values[j] for j in range(i + 1)) for i in range(len(values))])

        def step(carry, i):
            y, state = carry
            state = eqx.tree_at(lambda s: s.order, state, order)
            y, _, _, state, _ = solver.step(terms, i * h, (i + 1) * h, y, None, state, False)
            return (y, state), y

        state = eqx.tree_at(lambda s: s.phi, state, phi)
        return jax.lax.scan(step, (exact(0.0), state), jnp.arange(128))[1][:, 0]

    return steps


@pytest.mark.parametrize("order", range(1, 6))
def test_formula_is_gears(steps, order):
    h = 0.1
    new = float(steps(order, h)[0])
    history = jnp.array([new, *(1 / (2 - h * j) for j in range(order))])
    assert float(jnp.dot(jnp.array(GEAR[order]), history)) == pytest.approx(-h * new**2, abs=1e-12)


@pytest.mark.parametrize("order", range(1, 6))
def test_order_of_convergence(steps, order):
    errors = [float(abs(steps(order, 2.0 / n)[n - 1] - 0.25)) for n in (64, 128)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)


def test_uneven_steps_follow_a_polynomial():
    """After steps of any sizes a step of order k continues a polynomial of degree k, however stiff the equation."""
    times, t1 = np.array([0.0, -0.3, -0.35, -0.9, -1.0, -1.7]), 0.2
    p = np.polynomial.Polynomial([1.0, -2.0, 0.5, 1.5, -0.7, 0.3])
    solver = udk.BDF(root_finder=Tolerances(1e-12, 1e-12))
    terms = diffrax.ODETerm(lambda t, y, _: jnp.polyval(jnp.array(p.deriv().coef[::-1]), t) - 1e6 * (y - y_exact(t)))
    y_exact = lambda t: jnp.polyval(jnp.array(p.coef[::-1]), t)[None]  # noqa: E731
    state = eqx.filter_jit(solver.init)(terms, 0.0, t1, y_exact(0.0), None)
    divided = [np.prod(times[0] - times[1 : i + 1]) * _divided(p, times[: i + 1]) for i in range(6)]
    nodes = jnp.append(jnp.array(times), -2.0)
    phi = jnp.array([*divided, 0.0])[:, None]
    state = eqx.tree_at(lambda s: (s.times, s.phi, s.order), state, (nodes, phi, jnp.array(5)))
    y1, _, dense, _, _ = eqx.filter_jit(solver.step)(terms, 0.0, t1, y_exact(0.0), None, state, False)
    np.testing.assert_allclose(y1, p(t1), rtol=1e-12)
    between = solver.interpolation_cls(t0=0.0, t1=t1, **dense)
    np.testing.assert_allclose(between.evaluate(0.13), p(0.13), rtol=1e-12)
    np.testing.assert_allclose(between.evaluate(0.0, 0.13), p(0.13) - p(0.0), rtol=1e-12)


def _divided(p, times):
    if len(times) == 1:
        return p(times[0])
    return (_divided(p, times[:-1]) - _divided(p, times[1:])) / (times[0] - times[-1])


def reaction(t, y, rates):
    """x' = -k x^2 and z' = -s (z - x), which is undefined for negative x."""
    k, s = rates
    x = jnp.where(y["x"] < 0, jnp.nan, y["x"])
    return {"x": -k * x**2, "z": -s * (y["z"] - x)}


TS = jnp.array([0.5, 2.0])


def react(k, s=1e3, start=1.0, first=1e-3, adjoint=None) -> Any:
    return diffrax.diffeqsolve(
        diffrax.ODETerm(reaction),
        udk.BDF(),
        0.0,
        2.0,
        first,
        {"x": jnp.asarray(start), "z": jnp.asarray(start)},
        (k, s),
        stepsize_controller=controller(1e-8, 1e-8),
        saveat=diffrax.SaveAt(ts=TS),
        adjoint=adjoint or diffrax.ForwardMode(),  # the fastest to compile
        max_steps=512,
    )


@pytest.fixture(scope="module")
def reacted():
    solve = jax.jit(react)
    return lambda k, s=1e3, first=1e-3: solve(k, s, 1.0, first)


@pytest.mark.slow
def test_stiffness_costs_nothing(reacted):
    """z follows x + k x^2 / s, and its rate s does not limit the step."""
    for s in (1e3, 1e6):
        run, x = reacted(3.0, s), 1 / (1 + 3 * TS)
        np.testing.assert_allclose(run.ys["x"], x, rtol=1e-7)
        np.testing.assert_allclose(run.ys["z"], x + 3 * x**2 / s, rtol=20 / s**2 + 1e-7)
        assert run.stats["num_steps"] < 300


@pytest.mark.slow
def test_step_without_a_solution_is_rejected(reacted):
    """A first step of 2 makes x negative. The run recovers."""
    run = reacted(3.0, first=2.0)
    assert run.stats["num_rejected_steps"] > 0
    np.testing.assert_allclose(run.ys["x"], 1 / (1 + 3 * TS), rtol=1e-7)


@pytest.mark.slow
def test_gradients(reacted):
    """Gradients with respect to rate and initial state: of x compared with the exact ones, of z with differences."""
    k, h = 3.0, 1e-3
    ahead = jax.jit(jax.jacfwd(lambda k, y: react(k, start=y).ys, argnums=(0, 1)))(k, 1.0)
    np.testing.assert_allclose(ahead["x"][0], -TS / (1 + k * TS) ** 2, rtol=1e-6)
    np.testing.assert_allclose(ahead["x"][1], 1 / (1 + k * TS) ** 2, rtol=1e-6)
    more, less = (reacted(k + d).ys["z"] for d in (h, -h))
    np.testing.assert_allclose(ahead["z"][0], (more - less) / (2 * h), rtol=1e-5)


@pytest.mark.slow
def test_reverse_gradients():
    reverse = diffrax.RecursiveCheckpointAdjoint()
    ahead = jax.jit(jax.jacfwd(lambda k, y: react(k, start=y).ys["z"][1], argnums=(0, 1)))(3.0, 1.0)
    back = jax.jit(jax.grad(lambda k, y: react(k, start=y, adjoint=reverse).ys["z"][1], argnums=(0, 1)))(3.0, 1.0)
    np.testing.assert_allclose(back, ahead, rtol=1e-10)


def swing(t, y, args):
    return {"x": y["v"], "v": -y["x"]}


@pytest.mark.slow
def test_event_backward_in_time():
    """cos t falls to zero at -pi / 2. On the way, the step's polynomial gives the solution and its derivative."""
    event = diffrax.Event(lambda t, y, args, **_: y["x"], optx.Newton(1e-12, 1e-12))

    @eqx.filter_jit
    def fall(x):
        run: Any = diffrax.diffeqsolve(
            diffrax.ODETerm(swing),
            udk.BDF(),
            0.0,
            -4.0,
            -1e-3,
            {"x": x, "v": jnp.array(0.0)},
            stepsize_controller=controller(1e-8, 1e-8),
            event=event,
            saveat=diffrax.SaveAt(t1=True, dense=True),
            max_steps=256,
        )
        ts = jnp.array([-0.1, -0.7, -1.5])
        return run, ts, jax.vmap(run.evaluate)(ts), jax.vmap(run.derivative)(ts)

    run, ts, between, rates = fall(jnp.array(1.0))
    assert float(run.ts[0]) == pytest.approx(-math.pi / 2, abs=1e-7)
    assert float(run.ys["v"][0]) == pytest.approx(1.0, abs=1e-7)
    np.testing.assert_allclose(between["x"], np.cos(ts), rtol=0, atol=1e-7)
    np.testing.assert_allclose(rates["x"], -np.sin(ts), rtol=0, atol=1e-5)


@pytest.mark.slow
def test_jump_begins_a_new_history():
    """y' = -k (y - u(t)), and u jumps from 0 to 1. A solver that knows of the jump does not search for it by rejected steps."""
    k = 50.0
    run: Any = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, _: -k * (y - jnp.where(t < 1, 0.0, 1.0))),
        udk.BDF(),
        0.0,
        1.1,
        1e-3,
        jnp.array([1.0]),
        stepsize_controller=diffrax.ClipStepSizeController(controller(1e-7, 1e-7), jump_ts=jnp.array([1.0])),
        saveat=diffrax.SaveAt(t1=True),
        max_steps=512,
    )
    assert float(run.ys[0, 0]) == pytest.approx(1 - math.exp(-k * 0.1), abs=1e-6)
    assert run.stats["num_rejected_steps"] < 15


@pytest.mark.slow
def test_linkage():
    """Projecting each step costs BDF no steps, and large gains, which make the drift stiff, hardly any."""
    mech, ts = udk.library.parallelogram(), jnp.linspace(0.0, 5.0, 11)
    exact = udk.simulate(mech, ts, rtol=1e-11, atol=1e-11)
    tols = {"rtol": 1e-8, "atol": 1e-8, "solver": udk.BDF()}
    projected = udk.simulate(mech, ts, **tols)
    free = udk.simulate(mech, ts, stabilization=None, **tols)
    gains = udk.simulate(mech, ts, stabilization=udk.Baumgarte(1000.0, 100.0), **tols)
    for run in (projected, free, gains):
        np.testing.assert_allclose(run.q, exact.q, atol=1e-6)
    assert projected.stats["steps"] < 1.1 * free.stats["steps"]
    assert gains.stats["steps"] < 2 * free.stats["steps"]


def test_impossible_orders_are_named():
    with pytest.raises(ValueError, match="1 <= min_order <= max_order <= 5, not min_order=1, max_order=6"):
        udk.BDF(max_order=6)
