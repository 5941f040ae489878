"""What an integrator is given, and what it leaves: the same for all of them."""

from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from udkjax.equations.motion import Motion
from udkjax.integrate.pieces import Pieces

RUNNING, DONE, STEP_LIMIT, STEP_TOO_SMALL, DOUBTED = range(5)  # what a run may be


class Problem(eqx.Module):
    """What to integrate: q'' = a(t, q, v) of some equations from ts[0] to ts[-1]. Its arrays may be batched."""

    equations: Motion
    ts: Float[Array, "T"]
    q: Float[Array, "n"]
    v: Float[Array, "n"]
    rtol: Array
    atol: Array
    smallest: Array  # step (s)
    h: Array | None  # the first step; None: chosen
    solver: Any = eqx.field(static=True)
    projected: bool = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    careful: bool = eqx.field(static=True, default=True)  # whether steps that want care get it; else a run ends as `DOUBTED`
    breakpoints: Float[Array, "k"] | None = None  # the times where the motion is not smooth, in any order; None: it is
    pieces: Pieces | None = None  # in which the motion is smooth, of those that have some; None: nothing has


class Raw(NamedTuple):
    """A run as an integrator leaves it: `status` is one of those above, from `DONE` on."""

    q: Any  # (T, n), not yet reached ones of any value
    v: Any
    violation: Any  # (T,) the largest of any row of Psi there (m, rad)
    reached: Any  # (T,)
    status: Any
    t: Any
    y: Any  # (2n,) at t
    tried: Any
    accepted: Any
    evaluations: Any
