"""The reported number of right-hand sides is the number of their calls, counted by callbacks."""

from functools import partial
from typing import ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.integrate.scenes import TS
from udkjax.equations.laws.abstract_system import TangentPart
from udkjax.integrate.constrained import Constrained
from udkjax.integrate.solvers.counting import NOT_COUNTED, CountingController, count_evaluations, evaluations
from udkjax.integrate.solvers.multistep import Multistep, tolerances_from_controller

SAVE = diffrax.SaveAt(t1=True, controller_state=True)


class Calls:
    def __init__(self):
        self.value = 0

    def add(self):
        self.value += 1


@pytest.fixture
def calls():
    return Calls()


def controller(tol=1e-5):
    return diffrax.PIDController(rtol=tol, atol=tol)


class Told(NamedTuple):
    evaluations: jax.Array


class Tells(diffrax.AbstractAdaptiveSolver):
    """Heun's method, which reports its own number of calls: two per step, and one before the first step."""

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 2

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        terms.vf(t0, y0, args)
        return Told(jnp.array(1))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        first = terms.vf(t0, y0, args)
        euler = y0 + (t1 - t0) * first
        second = terms.vf(t1, euler, args)
        y1 = y0 + (t1 - t0) * (first + second) / 2
        return y1, y1 - euler, {"y0": y0, "y1": y1}, Told(solver_state.evaluations + 2), diffrax.RESULTS.successful


def stiff(calls):
    """A rate that jumps, so that steps are rejected. Every call is counted."""

    def rate(t, y, args):
        jax.debug.callback(calls.add)
        return jnp.where(t < 0.4, -1.0, 8.0) * y

    return rate


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), diffrax.Heun(), Tells()], ids=["Tsit5", "Heun", "one that tells"])
def test_every_call_is_counted(calls, solver):
    """This includes a rejected first step, from which not even the first stage is kept."""
    (solver, control), term = count_evaluations(solver, controller(1e-3)), diffrax.ODETerm(stiff(calls))

    @jax.jit
    def solve(dt0):
        run = diffrax.diffeqsolve(term, solver, 0.0, 1.0, dt0, jnp.array([1.0]), saveat=SAVE, stepsize_controller=control)
        return run.stats["num_rejected_steps"], evaluations(run.controller_state)

    for dt0 in (1e-3, 0.9):  # accepted, and rejected
        calls.value = 0
        rejected, found = solve(dt0)
        jax.effects_barrier()
        assert rejected >= 1 and found == calls.value > 20


@pytest.mark.slow
def test_counting_changes_nothing():
    """Steps, result and gradient are those of the solver itself."""

    def run(choices, y0):
        term = diffrax.ODETerm(lambda t, y, args: -(y**3))
        run = diffrax.diffeqsolve(term, choices[0], 0.0, 2.0, 0.1, y0, stepsize_controller=choices[1], max_steps=64)
        return jnp.asarray(run.ys)[0, 0], run.stats["num_steps"]

    plain = (diffrax.Tsit5(), controller())
    start = jnp.array([1.0])
    both = plain, count_evaluations(*plain)
    alone, counted = (jax.jit(jax.value_and_grad(partial(run, c), has_aux=True))(start) for c in both)
    assert alone == counted


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Kvaerno3(), diffrax.HalfSolver(diffrax.Heun())], ids=["implicit", "halved"])
def test_solvers_without_a_tableau_are_not_counted(solver):
    counted = count_evaluations(solver, controller())
    term = diffrax.ODETerm(lambda t, y, args: -y)
    run = diffrax.diffeqsolve(term, counted[0], 0.0, 1.0, 0.1, jnp.array([1.0]), saveat=SAVE, stepsize_controller=counted[1])
    assert evaluations(run.controller_state) == NOT_COUNTED


# --- as the motion of a mechanism is integrated


class Oscillator(eqx.Module):
    """A harmonic oscillator whose right-hand sides are counted."""

    calls: Calls

    def derivative(self, t, y):
        jax.debug.callback(self.calls.add)
        return jnp.stack([y[1], -4 * y[0]])

    def project(self, t, q, v):
        return q, v

    def tangent_part(self, t, q, v, dq, dv):
        return TangentPart(dq, dv)

    def fix_partition(self, t, q, v):
        return self

    @property
    def independent(self):
        return None


@pytest.mark.slow
@pytest.mark.parametrize("projected", [True, False])
def test_what_forgets_its_last_stage_takes_it_again(calls, projected):
    run = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, equations: equations.derivative(t, y)),
        Constrained(diffrax.Tsit5(), projected),
        0.0,
        1.0,
        0.05,
        jnp.array([1.0, 0.0]),
        Oscillator(calls),
        saveat=SAVE,
        stepsize_controller=CountingController(controller(1e-3)),
    )
    jax.effects_barrier()
    assert evaluations(run.controller_state) == calls.value
    assert calls.value == (7 if projected else 6) * run.stats["num_steps"] + (0 if projected else 1)


class Remembers(Multistep):
    """Euler's method, which records whether it is told of jumps."""

    root_finder: object = eqx.field(default_factory=tolerances_from_controller)
    root_find_max_steps: int = 1
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def init(self, terms, t0, t1, y0, args):
        return Told(jnp.array(0))

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1 = y0 + (t1 - t0) * terms.vf(t0, y0, args)
        return y1, 0 * y0, {"y0": y0, "y1": y1, "jump": made_jump}, Told(solver_state.evaluations + 1), diffrax.RESULTS.successful


@pytest.mark.parametrize("jumped", [False, True])
def test_a_projection_is_no_jump_to_a_multistep_method(calls, jumped):
    """A jump would make it discard its history. A Runge-Kutta method only discards its last stage."""
    solver = Constrained(Remembers(), True)
    equations, y0 = Oscillator(calls), jnp.array([1.0, 0.0])
    terms = diffrax.ODETerm(lambda t, y, equations: equations.derivative(t, y))
    *_, dense, state, _ = solver.step(terms, 0.0, 0.1, y0, equations, solver.init(terms, 0.0, 0.1, y0, equations), jumped)
    assert dense["jump"] is jumped
    assert state.evaluations == 1


# --- the first step


def test_the_first_step_may_be_given(pendulum):
    """The start then takes one right-hand side, and a step that is too long is rejected."""
    stats = {dt0: udk.simulate(pendulum, TS, dt0=dt0).stats for dt0 in (0.01, 2.0, 1e-9)}
    stages = diffrax.Dopri8.tableau.num_stages - 1  # the last one serves interpolation alone
    for found in stats.values():
        assert found["right_hand_sides"] == stages * found["steps"] + 1
    assert stats[2.0]["rejected"] > 0
    assert stats[1e-9]["steps"] >= stats[0.01]["steps"] + 6  # steps grow by 10 at most


@pytest.mark.parametrize(("dt0", "problem"), [(0.0, "positive"), (-0.1, "positive"), (jnp.nan, "positive"), ([0.1], "one")])
def test_a_first_step_is_checked(pendulum, dt0, problem):
    with pytest.raises(ValueError, match=problem):
        udk.simulate(pendulum, TS, dt0=dt0)


# --- as a whole run says


def counted(held):
    """A stone that counts the evaluations of its force. If `held`, it moves on a circle."""
    count = Calls()

    def force(t, q, v):
        jax.debug.callback(count.add)
        return jnp.stack([-q[0], -9.81 + 0.0 * t])

    return udk.ConstrainedSystem(lambda q: jnp.eye(2), force, (lambda t, q: q @ q - 1.0) if held else None), count


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "held"),
    [
        pytest.param(diffrax.Tsit5(), True, id="Tsit5-projected"),
        *(pytest.param(s(), False, id=f"{s.__name__}-free") for s in (diffrax.Dopri8, diffrax.Heun)),
    ],
)
def test_right_hand_sides_are_counted(solver, held):
    """A method that uses its last stage again takes one fewer per step, unless projection has changed the state."""
    system, count = counted(held)
    sol = udk.simulate(system, TS, udk.State(np.array([0.6, 0.8]), np.zeros(2)), rtol=1e-5, atol=1e-5, solver=solver)
    jax.effects_barrier()
    stats = {k: int(v) for k, v in sol.stats.items()}
    assert stats["steps"] == stats["accepted"] + stats["rejected"] > 3
    assert count.value == stats["right_hand_sides"]
    assert stats["projections"] == (stats["steps"] + 2 * (len(TS) - 1) if held else 0)
