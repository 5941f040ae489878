"""How a run ended and what it took, from what the solver left behind."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.integrate.solution import Result

AHEAD = 1e-6  # of the span: how far beyond the end of a run that stopped one looks for what is not finite


class Run(eqx.Module):
    """A run as the solver leaves it."""

    equations: Any
    result: Any  # diffrax's
    ts: Float[Array, "T"]
    ys: Float[Array, "T 2n"]
    reached: Bool[Array, "T"]
    t_end: Float[Array, ""]
    end: Float[Array, "2n"]
    closed: Bool[Array, ""]
    missed: Bool[Array, ""]  # the closed state takes rows that the method leaves out
    drift_tol: Float[Array, ""]


def outcome(run: Run) -> tuple[Array, Array, Bool[Array, "T"]]:
    """Return the `Result`, the time (s) that belongs to it, and which of the output times count."""
    code = jnp.where(run.result == diffrax.RESULTS.max_steps_reached, Result.step_limit, _stopped(run))
    code = jnp.where(run.result == diffrax.RESULTS.successful, Result.successful, code)
    code, time, reached = _drift(run, code)
    first = jnp.arange(len(run.ts)) == 0
    code = jnp.where(run.missed, Result.drift, code)
    code = jnp.where(run.closed, code, Result.could_not_assemble)
    started = run.closed & ~run.missed
    return code, jnp.where(started, time, run.ts[0]), reached & (started | first)


def _stopped(run: Run) -> Array:
    """Why the step size fell to nothing: a number that is not finite, at the end or right ahead, or something else."""
    q, v = jnp.split(run.end, 2)
    times = run.t_end + jnp.array([0.0, AHEAD]) * (run.ts[-1] - run.ts[0])
    finite = jax.vmap(lambda t: run.equations.is_finite(t, q + (t - run.t_end) * v, v))(times)
    return jnp.where(jnp.all(finite), Result.step_too_small, Result.not_finite)


def _drift(run: Run, code: Array) -> tuple[Array, Array, Bool[Array, "T"]]:
    """The first output time at which a row of Psi is violated, also one that the method leaves out, ends the solution."""
    if not run.equations.constrained:
        return code, run.t_end, run.reached
    q, v = jnp.split(run.ys, 2, axis=1)
    psi = jax.vmap(lambda t, q, v: run.equations.violation(t, q, v)[0])(run.ts, q, v)
    lost = run.reached & ~(jnp.max(jnp.abs(psi), axis=1, initial=0.0) <= run.drift_tol)
    drifted, first = jnp.any(lost), jnp.argmax(lost)
    reached = run.reached & (~drifted | (jnp.arange(len(run.ts)) <= first))
    return jnp.where(drifted, Result.drift, code), jnp.where(drifted, run.ts[first], run.t_end), reached


def counts(stats: dict[str, Any], right_hand_sides: Array, projected: bool, outputs: int) -> dict[str, Any]:
    """Count steps and what follows from them; right-hand sides are -1 where they are not known."""
    steps = stats["num_steps"]
    return {
        "steps": steps,
        "accepted": stats["num_accepted_steps"],
        "rejected": stats["num_rejected_steps"],
        "right_hand_sides": right_hand_sides,
        "projections": steps + 2 * (outputs - 1) if projected else jnp.zeros_like(steps),
    }
