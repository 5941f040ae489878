"""`Problem` and `IntegratorOutput`: the input and the output that all integrators share."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from udkjax.equations.laws.abstract_system import AbstractSystem
from udkjax.integrate.compiled_mechanism import CompiledMechanism
from udkjax.transforms.gradients import stop_gradients


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Problem:
    """An initial value problem: q'' = a(t, q, v) from the state (q, v) at ts[0] to ts[-1], with outputs at all `ts`.

    The arrays may be batched.
    """

    compiled: CompiledMechanism
    ts: Float[Array, "T"]
    q: Float[Array, "n"]
    v: Float[Array, "n"]
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    smallest: Float[Array, ""]  # smallest step (s)
    h: Float[Array, ""] | None  # the first step (s); None: chosen automatically
    # Characteristic length (m), to which `atol` is relative; None: coordinates are of order one.
    length: Float[Array, ""] | None
    rate: Float[Array, ""]  # characteristic rate of the system and the run (1/s)
    max_steps: Int[ArrayLike, ""]
    drift_tol: Float[Array, ""]  # violation of Psi, relative to the scales of the rows, beyond which a run has failed
    stepper: Any = None  # a step size controller of diffrax; None: the default
    stabilization: Any = None  # a user-defined `Stabilization`
    marks: Float[Array, "m"] | None = None  # marks or weights of the rows of Psi (`mark_rows`); None: machine code needs none
    # Capacity of the record for reverse mode, in accepted steps; None: a default, larger with more breakpoints.
    points: int | None = field(default=None, metadata={"static": True})

    @property
    def equations(self) -> AbstractSystem:
        """The equations of motion, including those of a formulation that wraps the mechanism's own."""
        return self.compiled.equations

    @property
    def textbook(self) -> Any:
        """The equations of the mechanism or user-defined system itself, without a formulation that may wrap them."""
        return self.compiled.textbook

    def units(self) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
        """Return the units of `atol` for coordinates (`length` or rad; 1 if it is None) and velocities (these times `rate`)."""
        unit = jnp.ones(len(self.q))
        if self.length is not None:
            unit = jnp.where(np.arange(len(self.q)) % 3 == 2, unit, self.length)
        return stop_gradients((unit, unit * self.rate))


class IntegratorOutput(NamedTuple):
    """The output of an integrator: states at the output times, and the end of the run.

    `status` is a `Status` of native/module/steps.py: `DONE`, or the reason of a failure.
    """

    q: Float[Array, "T n"]  # NaN at times not reached, or after the first drifted one
    v: Float[Array, "T n"]
    reached: Bool[Array, "T"]  # whether the integrator came to each output time
    first_drifted: Float[Array, ""]  # index of the first output where Psi is violated by more than `drift_tol`, or infinite
    status: Int[Array, ""]
    t: Float[Array, ""]  # the time of the end (s)
    y: Float[Array, "2n"]  # the state at t
    tried: Int[Array, ""]  # number of steps tried
    accepted: Int[Array, ""]  # number of steps accepted
    evaluations: Int[Array, ""]  # number of right-hand sides; -1: unknown
    implicit: Int[Array, ""]  # number of accepted steps by the implicit method of a default run

    @property
    def kept(self) -> Bool[Array, "T"]:
        """A mask of the outputs that were reached, up to the first that has drifted, which is included."""
        return self.reached & (np.arange(self.reached.shape[-1]) <= self.first_drifted)
