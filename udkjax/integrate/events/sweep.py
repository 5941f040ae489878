"""A sweep of a run with events: machine code runs as far as it is certain what happens, to the first crossing at most.

Windows look more closely where it cannot tell (`window`). In phases in which contacts are at rest there are no sweeps: their
forces are no conditions of machine code.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate import native_engine
from udkjax.integrate.events.condition_program import condition_numbers
from udkjax.integrate.events.crossings import NO_EVENT, ZERO
from udkjax.integrate.events.hybrid import Hybrid, RunState
from udkjax.integrate.events.window import choose
from udkjax.integrate.native_engine import WatchedRun
from udkjax.native.conditions import watch_inputs
from udkjax.native.steps import CROSSED, DONE, UNSURE


class SweepResult(NamedTuple):
    """The result of a sweep."""

    state: RunState  # as far as it went
    sides: Int[Array, "2E"]  # of zero, there; of what crosses it, before that
    event: Int[Array, ""]  # or `NO_EVENT`
    ends: Bool[Array, ""]  # whether it is the end of the run
    rows: Int[Array, "T"]  # the numbers of outputs; of any value beyond the last
    q: Float[Array, "T n"]
    v: Float[Array, "T n"]
    totals: Int[Array, "4"]


def can_sweep(hybrid: Hybrid) -> Bool[np.ndarray, "phases"]:
    """Return a mask of the phases with sweeps."""
    free = np.isin(np.arange(len(hybrid.plans)), hybrid.contact_free_phases)
    native = np.array([plan.is_native for plan in hybrid.plans])
    return free & native & (hybrid.watched is not None)


def sweep(
    hybrid: Hybrid,
    ts: Float[Array, "T"],
    state: RunState,
    sides: Int[Array, "2E"],
    scale: Float[Array, "2E"],
    watched: Bool[Array, "2E"],
    written: Int[Array, ""],
    drift_tol: Float[Array, ""],
    runs: Bool[Array, ""],
) -> SweepResult:
    """Run to the first crossing, or as far as it is certain that there is none.

    Args:
        hybrid: the system.
        ts: the output times (s).
        state: state at the beginning of the sweep.
        sides: the sides of zero of all conditions there.
        scale: scale of each condition.
        watched: mask of the conditions that count.
        written: number of outputs written already.
        drift_tol: the violation of the constraints that a sweep may have.
        runs: whether it is to run at all, as a member of a batch.
    """
    E, T = hybrid.count, len(ts)
    output = written + np.arange(T)
    due = ts[jnp.minimum(output, T - 1)]
    # Machine code writes outputs up to the first that is infinite, and then the end.
    later = jnp.where((output < T) & (due < ts[-1]), jnp.maximum(due, state.t), jnp.inf)
    times = jnp.concatenate([state.t[None], later, ts[-1:]])
    numbers = [jnp.ravel(x) for x in condition_numbers(hybrid.events)]
    given = watch_inputs(jnp, numbers, sides[:E], watched[:E], ZERO * scale[:E], hybrid.directions[:E], hybrid.scales.rate)

    def of_phase(phase: int, t: Array, q: Array, v: Array, added: tuple) -> WatchedRun:
        problem = hybrid.problem(phase, t, q, v, added)
        assert hybrid.watched is not None  # else there are no sweeps
        return native_engine.watch(replace(problem, max_steps=jnp.where(runs, hybrid.max_steps, 0)), hybrid.watched, given)

    among = tuple(int(k) for k in np.flatnonzero(can_sweep(hybrid)))
    found = hybrid.in_phase(state.phase, of_phase, times, state.q, state.v, state.added, among=among)
    raw = found.output
    is_known = (raw.status == CROSSED) | (raw.status == UNSURE) | (raw.status == DONE)
    rows = raw.reached & (times <= found.t)
    violation = jnp.max(jnp.where(rows, raw.violation, 0.0))
    goes = runs & is_known & (found.t > state.t) & (jnp.maximum(violation, found.violation) <= drift_tol)
    crosses = runs & is_known & (raw.status == CROSSED) & (jnp.maximum(violation, found.violation) <= drift_tol)
    own = (times[1:-1] <= state.t)[:, None]
    tried = jnp.stack([raw.tried, raw.accepted, raw.evaluations, hybrid.projects * (raw.tried + 2 * (jnp.sum(rows) - 1))])
    end = RunState(found.t, found.q, found.v, state.phase, state.added)
    after = choose(goes | crosses, end, state)
    return SweepResult(
        state=after,
        sides=jnp.where(goes | crosses, jnp.append(found.sides, sides[E:]), sides),
        event=jnp.where(crosses, found.event, NO_EVENT),
        ends=goes & (raw.status == DONE),
        rows=jnp.where(rows[1:-1] & (due < after.t) & (output < T), output, T),
        q=jnp.where(own, state.q, raw.q[1:-1]),
        v=jnp.where(own, state.v, raw.v[1:-1]),
        totals=jnp.where(runs, tried, 0),
    )
