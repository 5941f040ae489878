"""The interface between the loop and the motion: conditions at states, and the advance to the next crossing."""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.instant.runs import Change, MemberIndices, MemberRuns, RunState, take
from udkjax.integrate.events.law.crossings import ConditionValues
from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.transforms.gradients import stop_gradients


class StateValues(NamedTuple):
    """The conditions of E events at states, their derivatives, and the directions of impulses along the conditions."""

    a: Float[Any, "*m n"]  # accelerations
    g: Float[Any, "*m E"]  # values of the conditions
    rate: Float[Any, "*m E"]  # first rates along the motion
    rate_2: Float[Any, "*m E"]  # second rates; 0 for conditions that depend on velocities
    by_t: Float[Any, "*m E"]  # partial derivatives with respect to t, q and v
    by_q: Float[Any, "*m E n"]
    by_v: Float[Any, "*m E n"]
    directions: Float[Any, "*m E n"]  # directions of impulses; arbitrary for events that are not impacts
    mobilities: Float[Any, "*m E n"]  # of a system, M^(-1) g_q: the directions without constraints
    forces: Float[Any, "*m E"]  # forces of contacts, and reserves of joints that stick; arbitrary for others
    has_safe_forces: Bool[Any, "*m"]  # whether machine code could compute the forces, whose pivots may be too small


class System(Protocol):
    """The motion of the members of a batch by machine code and NumPy, or of one member by JAX.

    Attributes:
        xp: jax.numpy, or NumPy.
        plan: the phases and events.
        end: the last output time of each member (B,).
        rate: characteristic rate of the system and the run (1/s) (B,).
        coordinates: the units of all coordinates (B, n).
        inverse_mass: one over the mass of each coordinate (B, n).
    """

    xp: ModuleType
    plan: EventPlan
    end: Float[Any, "B"]
    rate: Float[Any, "B"]
    coordinates: Float[Any, "B n"]
    inverse_mass: Float[Any, "B n"]

    def numbers_of_actions(self, members: MemberIndices) -> Float[Any, "b N E"]:
        """Return the numbers of the actions of members (`actions.numbers_of_actions`)."""
        ...

    def look(
        self, members: MemberIndices, at: RunState, is_free: bool = False, is_directed: bool = False, has_forces: bool = False
    ) -> StateValues:
        """Return the values of the conditions of members at states.

        Directions of impulses are evaluated if `is_free` (the phases have no contact at rest and no joint that sticks) or
        `is_directed`, forces if `has_forces`; fields that are not requested are arbitrary.
        """
        ...

    def project(
        self, members: MemberIndices, at: RunState, is_free: bool = False
    ) -> tuple[Float[Any, "b n"], Float[Any, "b n"], Float[Any, "b"]]:
        """Return q and v projected onto the constraints of their phases, and the largest remaining |Psi_dot_i| over its scale."""
        ...

    def add_joints(self, members: MemberIndices, new: Bool[Any, "b A"], q: Float[Any, "b n"], joints: Any) -> Any:
        """Return `joints` in which the joints that are masked in `new` are added at the positions q."""
        ...

    def advance(self, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
        """Return the runs with members advanced, at most to their next crossing, which becomes their `event`."""
        ...

    def sides(self, members: MemberIndices, joints: Any) -> Float[Any, "b S"]:
        """Return the sides of each member, which `joints`, as in a `RunState`, ends with.

        Those of joints that may stick come first, then those of comparisons in forces (kinks.py).
        """
        ...

    def with_sides(self, members: MemberIndices, joints: Any, sides: Float[Any, "b S"]) -> Any:
        """Return `joints` with other sides of members."""
        ...

    def turned(self, members: MemberIndices, k: Int[Any, "b"], at: RunState) -> Float[Any, "b S"]:
        """Return all sides of members after event k at their states."""
        ...

    def when(self, mask: Bool[Any, "B"], change: Change, runs: MemberRuns) -> MemberRuns:
        """Return the runs after `change(runs, members)` of the masked members."""
        ...

    def repeat(self, change: Callable[[MemberRuns], MemberRuns], runs: MemberRuns) -> MemberRuns:
        """Return the runs after repeating a change until none of them is running."""
        ...


def condition_values(
    system: System, members: MemberIndices, state: RunState, is_directed: bool = False
) -> tuple[ConditionValues, StateValues]:
    """Return the conditions of members at states with their scales, and all quantities that `System.look` evaluates there."""
    xp, state_values, unit = system.xp, system.look(members, state, is_directed=is_directed), take(system.coordinates, members)
    rate, t = take(system.rate, members)[:, None], state.t[:, None]
    by_q = xp.abs(state_values.by_q) * xp.maximum(unit, xp.abs(state.q))[:, None]
    by_v = xp.abs(state_values.by_v) * xp.maximum(unit * rate, xp.abs(state.v))[:, None]
    scale = xp.maximum(xp.maximum(by_q, by_v).max(2), xp.abs(state_values.by_t) * xp.maximum(1 / rate, xp.abs(t)))
    scale = xp.where(xp.isfinite(scale), scale, 0.0)  # a condition that is NaN has no scale
    scale = scale if xp is np else stop_gradients(scale)
    return ConditionValues(state_values.g, state_values.rate, state_values.rate_2, state_values.a, scale), state_values
