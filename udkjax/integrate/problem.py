"""The input and the output of an integrator: the same for all of them."""

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
    """An initial value problem: q'' = a(t, q, v) of some equations from ts[0] to ts[-1]. Its arrays may be batched."""

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
    marks: Float[Array, "m"] | None = None  # 1 for each independent row of Psi, else 0; None: machine code contains the marks
    # Capacity of a record for reverse mode; None: by breakpoints.
    points: int | None = field(default=None, metadata={"static": True})

    @property
    def equations(self) -> AbstractSystem:
        """The equations of motion."""
        return self.compiled.equations

    @property
    def textbook(self) -> Any:
        """The equations, without the formulation that may contain them."""
        return self.compiled.textbook

    def units(self) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
        """Return the units of `atol` for coordinates and for velocities."""
        unit = jnp.ones(len(self.q))
        if self.length is not None:
            unit = jnp.where(np.arange(len(self.q)) % 3 == 2, unit, self.length)
        return stop_gradients((unit, unit * self.rate))


class IntegratorOutput(NamedTuple):
    """A run as an integrator returns it: `status` is one of `native.steps`, from `DONE` on."""

    q: Float[Array, "T n"]  # NaN at times not reached, or after the first lost output
    v: Float[Array, "T n"]
    reached: Bool[Array, "T"]
    lost: Float[Array, ""]  # index of the first output where Psi is violated by more than `drift_tol`, or infinite
    status: Int[Array, ""]
    t: Float[Array, ""]  # the time of the end (s)
    y: Float[Array, "2n"]  # the state at t
    tried: Int[Array, ""]  # steps
    accepted: Int[Array, ""]
    evaluations: Int[Array, ""]
    implicit: Int[Array, ""]  # accepted steps by the implicit method of a default run

    @property
    def kept(self) -> Bool[Array, "T"]:
        """True for outputs that were reached, up to the first lost one."""
        return self.reached & (np.arange(self.reached.shape[-1]) <= self.lost)
