"""Return states to the constraint manifold."""

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.equations.motion import Motion, Tangential
from udkjax.equations.rank_policy import REFUSE, drop_dependent
from udkjax.integrate.undifferentiated import undifferentiated
from udkjax.native.steps import TAKEN_BACK


class Projection(eqx.Module):
    """Project positions and velocities after each step, by the smallest change in the mass metric (the default stabilization)."""


def project(equations: Motion, t: Any, y: Float[Array, "2n"]) -> Float[Array, "2n"]:
    """(q, v) on the manifold."""
    q, v = jnp.split(y, 2)
    return jnp.concatenate(equations.project(t, q, v))


def lasting(equations: Motion, t: Any, q: Array, v: Array, dq: Array, dv: Array) -> Tangential:
    """The errors dq and dv of a step that ends in q and v, with what projection takes back of them counted by `TAKEN_BACK`.

    Close to dependent rows it need not be exact, and does not branch.
    """
    q, v, dq, dv = undifferentiated((q, v, dq, dv))
    return _counted(undifferentiated(equations.with_policy(drop_dependent())).tangential(t, q, v, dq, dv), dq, dv)


def ended(equations: Motion, t: Any, q: Array, v: Array, dq: Array, dv: Array) -> tuple[Array, Array, Array, Tangential]:
    """The end of a step with errors dq and dv: q and v on the manifold, the accelerations there, and the errors `lasting`."""
    quick = equations.with_policy(REFUSE)
    if not quick.finishes:
        q, v, a = quick.arrived(t, q, v)
        return q, v, a, lasting(equations, t, q, v, dq, dv)
    dq, dv = undifferentiated((dq, dv))
    q, v, a, left = quick.finished(t, q, v, dq, dv)
    return q, v, a, _counted(left, dq, dv)


def _counted(left: Tangential, dq: Array, dv: Array) -> Tangential:
    return Tangential(left.dq + TAKEN_BACK * (dq - left.dq), left.dv + TAKEN_BACK * (dv - left.dv), jnp.asarray(left.distance))


def violation(equations: Motion, t: Any, y: Float[Array, "2n"]) -> Float[Array, ""]:
    """The largest of any row of Psi over its scale, also of those that the method leaves out."""
    if not equations.constrained:
        return jnp.zeros(())
    equations, t, y = undifferentiated((equations, t, y))
    return equations.excess(equations.violation(t, *jnp.split(y, 2))[0])


def project_all(equations: Any, ts: Float[Array, "T"], ys: Float[Array, "T 2n"]) -> Float[Array, "T 2n"]:
    """States at many times, each returned to the manifold.

    An interpolated state lies off it by the error of the interpolation: it takes one projection more than a step.
    """

    quick = jax.vmap(lambda t, y: _twice(equations.with_policy(REFUSE), t, y))(ts, ys)
    if not equations.branches:
        return quick
    doubts = ~jnp.all(jnp.isfinite(quick), axis=1)

    def one(member):
        t, y, projected, doubt = member
        return jax.lax.cond(doubt, lambda: _twice(equations, t, y), lambda: projected)

    return jax.lax.cond(eqxi.unvmap_any(doubts), lambda: jax.lax.map(one, (ts, ys, quick, doubts)), lambda: quick)


def _twice(equations: Motion, t: Any, y: Any) -> Any:
    return jax.lax.scan(lambda y, _: (project(equations, t, y), None), y, None, length=2)[0]
