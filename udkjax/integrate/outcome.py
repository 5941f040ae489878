"""The end of a run and its cost, from the output of an integrator."""

from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.equations.laws.abstract_system import AbstractSystem
from udkjax.integrate.problem import IntegratorOutput
from udkjax.integrate.solution import Result
from udkjax.native.module.steps import LOOK_AHEAD, Status

# The least `atol`, relative to the scene's scales: errors cannot be below rounding, and a coordinate near zero has no other
# tolerance.
LEAST_ATOL = np.finfo(float).eps


class FinishedRun(NamedTuple):
    """The output of an integrator, and the facts about the arguments of the run that `outcome` needs."""

    raw: IntegratorOutput
    ts: Float[Array, "T"]
    usable: Bool[Array, ""]  # whether its arguments are `usable`
    closed: Bool[Array, ""]  # `PreparedRun.is_closed`
    missed: Bool[Array, ""]  # `PreparedRun.has_missed_rows`


def increases(ts: Float[Array, "T"]) -> Bool[Array, ""]:
    """Return True if output times are finite and increasing."""
    return jnp.all(jnp.diff(ts) > 0) & jnp.all(jnp.isfinite(ts))


def usable(q: Array, v: Array, rtol: Array, atol: Array, drift_tol: Array, dt0: Array | None) -> Bool[Array, ""]:
    """Return True if these numbers are valid for `simulate`, which can check only the shapes of traced numbers itself."""
    finite = jnp.all(jnp.isfinite(jnp.concatenate([q, v])))
    tolerant = (rtol >= 0) & (atol >= 0) & (rtol + atol >= LEAST_ATOL) & (rtol + atol < jnp.inf) & (drift_tol > 0)
    return finite & tolerant & (True if dt0 is None else (dt0 > 0) & (dt0 < jnp.inf))


def failure(status: Any, xp: ModuleType = jnp) -> Any:
    """Return the `Result` that belongs to the `Status` of a run that ended before its last time."""
    code = xp.where(status == Status.STEP_LIMIT, Result.step_limit, Result.step_too_small)
    for status_of, result in (
        (Status.NOT_FINITE, Result.not_finite),
        (Status.LOST, Result.drift),
        (Status.SINGULAR, Result.singular),
        (Status.SPURIOUS_RANK, Result.spurious_rank),
        (Status.MISSING_RANK, Result.missing_rank),
        (Status.INTERRUPTED, Result.interrupted),
    ):
        code = xp.where(status == status_of, result, code)
    return code


def outcome(run: FinishedRun, xp: ModuleType = jnp) -> tuple[Array, Array]:
    """Return the `Result` of a run and its time (s): that of the first output with too much drift, else the integrator's last."""
    raw = run.raw
    code = xp.where(raw.status == Status.DONE, Result.successful, failure(raw.status, xp))
    has_drifted = xp.isfinite(raw.first_drifted)
    code = xp.where(has_drifted, xp.where(raw.first_drifted == 0, Result.initial_state_open, Result.drift), code)
    code = xp.where(run.missed, Result.drift, code)
    code = xp.where(run.closed, code, Result.could_not_assemble)
    code = xp.where(run.usable, code, Result.invalid_argument)
    return code, xp.where(has_drifted, run.ts[xp.where(has_drifted, raw.first_drifted, 0).astype(int)], raw.t)


def status_at_end(equations: AbstractSystem, span: Array, status: Array, t: Array, y: Array) -> Array:
    """Return the status of a run that ended in (t, y): `NOT_FINITE` if its step became too small near a non-finite number.

    The non-finite number may occur at t itself, or up to `LOOK_AHEAD` of the span later.
    """
    q, v = jnp.split(y, 2)
    times = t + jnp.array([0.0, LOOK_AHEAD]) * span

    def finite(_: Array) -> Array:
        return jnp.all(jax.lax.map(lambda later: equations.is_finite(later, q + (later - t) * v, v), times))

    is_finite = jax.lax.cond(status != Status.DONE, finite, lambda _: jnp.array(True), 0)
    return jnp.where((status == Status.STEP_TOO_SMALL) & ~is_finite, Status.NOT_FINITE, status)


def counts(raw: IntegratorOutput, projected: bool, outputs: int, xp: ModuleType = jnp) -> dict[str, Int[Array, ""]]:
    """Return the numbers of steps, right-hand sides (-1: unknown) and projections of a run, by name, for `Solution.stats`.

    Args:
        raw: the output of the integrator.
        projected: whether steps and outputs were projected.
        outputs: the number of output times.
        xp: jax.numpy, or NumPy.
    """
    return {
        "steps": raw.tried,
        "accepted": raw.accepted,
        "rejected": raw.tried - raw.accepted,
        "implicit": raw.implicit,
        "right_hand_sides": raw.evaluations,
        "projections": raw.tried + 2 * (outputs - 1) if projected else xp.zeros_like(raw.tried),
    }
