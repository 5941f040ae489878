"""Runs by their steps: of equal size, or saved where a step ends, so that no interpolation hides what the steps are worth."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import udkjax as udk
from udkjax.equations import prepare
from udkjax.integrate.constrained import Constrained
from udkjax.integrate.diffrax_engine import derivative
from udkjax.integrate.solvers.bdf import BDF
from udkjax.integrate.solvers.counting import CountingController, evaluations
from udkjax.integrate.solvers.multistep import Multistep, Tolerances

GROWTH = 1.1  # of the steps of the start; beyond 1.127 the formula of order five is unstable
# The first step, relative to the steps to come: with order one its error is 1e-12 of that of a later step.
SMALLEST = 1e-6
STARTING = int(np.ceil(np.log(1 / SMALLEST) / np.log(GROWTH)))  # steps of the start
NEWTON, ACCEPT = 1e-11, 1.0  # tolerances: implicit equations are solved well, and what an Adams method estimates is accepted


class Graded(diffrax.AbstractStepSizeController):
    """Steps of one size, which grow up to it from `first`, by `GROWTH` each, since a multistep method begins with order one."""

    size: Any
    first: Any

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return t0 + self.first, self.first

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        ahead = jnp.minimum(GROWTH * controller_state, self.size)
        return jnp.array(True), t1, t1 + ahead, jnp.array(False), ahead, diffrax.RESULTS.successful


def equal_steps(solver: Any, span: float, steps: int) -> Graded:
    """Return steps that fill the span: so many of equal size, with a multistep method after a start."""
    if not isinstance(solver, Multistep):
        return Graded(span / steps, span / steps)
    sizes = np.minimum(SMALLEST * GROWTH ** np.arange(STARTING + 1), 1.0)
    size = span / (steps + sizes[sizes < 1].sum())
    return Graded(size, SMALLEST * size)


def start_of(mechanism: udk.Mechanism) -> Any:
    """Return y = (q, v)."""
    return jnp.concatenate([mechanism.q0.ravel(), mechanism.v0.ravel()])


def by_equal_steps(mechanism: udk.Mechanism, solver: Any, ts: np.ndarray, projected: bool = True) -> Callable:
    """Return a compiled function from the number of equal steps to y at `ts` (T, 2n): the last one is the end of a step."""
    equations, y0 = prepare(mechanism, udk.Elimination()), start_of(mechanism)
    if isinstance(solver, Multistep):
        tol = NEWTON if isinstance(solver, BDF) else ACCEPT
        solver = eqx.tree_at(lambda s: s.root_finder, solver, Tolerances(tol, tol, optx.max_norm))

    @jax.jit
    def run(controller):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(derivative),
            Constrained(solver, projected),
            ts[0],
            ts[-1],
            None,
            y0,
            equations,
            saveat=diffrax.SaveAt(ts=jnp.asarray(ts)),
            stepsize_controller=controller,
            max_steps=2**17,
            throw=False,
        ).ys

    return lambda steps: run(equal_steps(solver, ts[-1] - ts[0], steps))


def by_tolerance(
    mechanism: udk.Mechanism,
    solver: Any,
    end: float,
    every: int,
    max_steps: int,
    projected: bool = True,
    outputs: Any = None,
) -> Callable:
    """Return a compiled function from rtol = atol to what follows, all but the last after each `every` steps.

    That is t and y (inf beyond the last one), the calls of the right-hand side, whether the end was reached; and y at `outputs`.
    """
    equations, y0 = prepare(mechanism, udk.Elimination()), start_of(mechanism)
    saved = [diffrax.SubSaveAt(t0=True, steps=every), diffrax.SubSaveAt(ts=[end] if outputs is None else outputs)]

    @jax.jit
    def run(tol):
        out: Any = diffrax.diffeqsolve(
            diffrax.ODETerm(derivative),
            Constrained(solver, projected),
            0.0,
            end,
            1e-3,
            y0,
            equations,
            saveat=diffrax.SaveAt(subs=saved, controller_state=True),
            stepsize_controller=CountingController(diffrax.PIDController(rtol=tol, atol=tol, norm=optx.max_norm)),
            max_steps=max_steps,
            throw=False,
        )
        return out.ts[0], out.ys[0], evaluations(out.controller_state), out.result == diffrax.RESULTS.successful, out.ys[1]

    return run
