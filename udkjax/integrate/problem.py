"""What an integrator is given, and what it leaves: the same for all of them."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.equations.abstract_system import AbstractSystem
from udkjax.integrate.gradients import stop_gradients


class Problem(eqx.Module):
    """What to integrate: q'' = a(t, q, v) of some equations from ts[0] to ts[-1]. Its arrays may be batched."""

    equations: AbstractSystem
    ts: Float[Array, "T"]
    q: Float[Array, "n"]
    v: Float[Array, "n"]
    rtol: Array
    atol: Array
    smallest: Array  # step (s)
    h: Array | None  # the first step; None: chosen
    length: Array | None  # of the system, which `atol` is relative to (m); None: its coordinates are of order one as they are
    rate: Array  # of the system and the run (1/s)
    solver: Any = eqx.field(static=True)
    projected: bool = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    breakpoints: Float[Array, "k"] | None = None  # the times where the motion is not smooth, in any order; None: it is

    def units(self) -> tuple[Any, Any]:
        """What `atol` is relative to, of coordinates and of velocities (n,)."""
        one = jnp.ones(len(self.q))
        if self.length is not None:
            one = jnp.where(np.arange(len(self.q)) % 3 == 2, one, self.length)
        return stop_gradients((one, one * self.rate))


class IntegratorOutput(NamedTuple):
    """A run as an integrator leaves it: `status` is one of those above, from `DONE` on."""

    q: Any  # (T, n), not yet reached ones of any value
    v: Any
    violation: Any  # (T,) the largest of any row of Psi there, over its scale
    reached: Any  # (T,)
    status: Any
    t: Any
    y: Any  # (2n,) at t
    tried: Any
    accepted: Any
    evaluations: Any
