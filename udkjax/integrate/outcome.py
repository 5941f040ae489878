"""The end of a run and its cost, from the solver's own statistics."""

from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from udkjax.equations.abstract_system import AbstractSystem
from udkjax.integrate.problem import IntegratorOutput
from udkjax.integrate.solution import Result
from udkjax.native.steps import DONE, LEAST_ATOL, LOOK_AHEAD, LOST, NOT_FINITE, STEP_LIMIT, STEP_TOO_SMALL


class FinishedRun(NamedTuple):
    """A run as the integrator leaves it."""

    raw: IntegratorOutput
    ts: Float[Array, "T"]
    usable: Bool[Array, ""]  # `usable` of its arguments
    closed: Bool[Array, ""]
    missed: Bool[Array, ""]  # the closed state takes rows that the method leaves out
    drift_tol: Float[Array, ""]


def increases(ts: Float[Array, "T"]) -> Bool[Array, ""]:
    """Tell whether output times are finite, and each after the one before."""
    return jnp.all(jnp.diff(ts) > 0) & jnp.all(jnp.isfinite(ts))


def usable(q: Array, v: Array, rtol: Array, atol: Array, drift_tol: Array, dt0: Array | None) -> Bool[Array, ""]:
    """Tell whether numbers are what `simulate` lets in: of those that are traced when it is called it sees the shapes alone."""
    finite = jnp.all(jnp.isfinite(q)) & jnp.all(jnp.isfinite(v))
    tolerant = (rtol >= 0) & (atol >= 0) & (rtol + atol >= LEAST_ATOL) & (rtol + atol < jnp.inf) & (drift_tol > 0)
    return finite & tolerant & (True if dt0 is None else (dt0 > 0) & (dt0 < jnp.inf))


def outcome(run: FinishedRun, xp: ModuleType = jnp) -> tuple[Array, Array, Bool[Array, "T"]]:
    """Return the `Result`, the time (s) that belongs to it, and which of the output times count."""
    code = xp.where(run.raw.status == STEP_LIMIT, Result.step_limit, Result.step_too_small)
    code = xp.where(run.raw.status == NOT_FINITE, Result.not_finite, code)
    code = xp.where(run.raw.status == LOST, Result.drift, code)
    code = xp.where(run.raw.status == DONE, Result.successful, code)
    code, time, reached = _drift(run, code, xp)
    first = xp.arange(len(run.ts)) == 0
    code = xp.where(run.missed, Result.drift, code)
    code = xp.where(run.closed, code, Result.could_not_assemble)
    code = xp.where(run.usable, code, Result.invalid_argument)
    started = run.usable & run.closed & ~run.missed
    return code, xp.where(started, time, run.ts[0]), reached & (started | first)


def status_at_end(equations: AbstractSystem, span: Array, status: Array, t: Array, y: Array) -> Array:
    """Return the status of a run that ended in (t, y): `NOT_FINITE` where its step became too small beside what is not finite.

    That may be in (t, y) itself or up to `LOOK_AHEAD` of the span later.
    """
    q, v = jnp.split(y, 2)
    times = t + jnp.array([0.0, LOOK_AHEAD]) * span

    def finite(_: Array) -> Array:
        return jnp.all(jax.lax.map(lambda later: equations.is_finite(later, q + (later - t) * v, v), times))

    is_finite = jax.lax.cond(status != DONE, finite, lambda _: jnp.array(True), 0)
    return jnp.where((status == STEP_TOO_SMALL) & ~is_finite, NOT_FINITE, status)


def _drift(run: FinishedRun, code: Array, xp: ModuleType) -> tuple[Array, Array, Bool[Array, "T"]]:
    """Return code, time and the reached times, where the first output time at which a row of Psi is violated ends the solution.

    That holds for rows that the method leaves out, too.
    """
    lost = run.raw.reached & ~(run.raw.violation <= run.drift_tol)
    drifted, first = xp.any(lost), xp.argmax(lost)
    reached = run.raw.reached & (~drifted | (xp.arange(len(run.ts)) <= first))
    code = xp.where(drifted, xp.where(first == 0, Result.initial_state_open, Result.drift), code)
    return code, xp.where(drifted, run.ts[first], run.raw.t), reached


def counts(raw: IntegratorOutput, projected: bool, outputs: int, xp: ModuleType = jnp) -> dict[str, Int[Array, ""]]:
    """Count steps and what follows from them; right-hand sides are -1 where they are not known."""
    return {
        "steps": raw.tried,
        "accepted": raw.accepted,
        "rejected": raw.tried - raw.accepted,
        "right_hand_sides": raw.evaluations,
        "projections": raw.tried + 2 * (outputs - 1) if projected else xp.zeros_like(raw.tried),
    }
