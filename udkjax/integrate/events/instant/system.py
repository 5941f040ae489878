"""The interface of the loop to the motion: conditions at states, and the advance to the next crossing."""

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
    """Conditions at states, their derivatives, and the directions of impulses along them."""

    a: Float[Any, "*m n"]
    g: Float[Any, "*m E"]
    rate: Float[Any, "*m E"]
    rate_2: Float[Any, "*m E"]  # 0 for conditions that depend on velocities
    by_t: Float[Any, "*m E"]
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
        end: the last output times (B,).
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
        """Evaluate the conditions of members at states; if `is_free`, no contact is at rest, and no joint sticks.

        Directions of impulses are evaluated if `is_free` or `is_directed`, forces if `has_forces`.
        """
        ...

    def project(
        self, members: MemberIndices, at: RunState, is_free: bool = False
    ) -> tuple[Float[Any, "b n"], Float[Any, "b n"], Float[Any, "b"]]:
        """Return q and v projected to the constraints of their phases, and the largest remaining row of Psi_dot per scale."""
        ...

    def add_joints(self, members: MemberIndices, new: Bool[Any, "b A"], q: Float[Any, "b n"], joints: Any) -> Any:
        """Return the joints that events have added, with new ones, added at q."""
        ...

    def advance(self, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
        """Advance members, at most to the next crossing, which becomes their `event`."""
        ...

    def sides(self, members: MemberIndices, joints: Any) -> Float[Any, "b S"]:
        """Return the sides of the comparisons in forces (kinks.py): the last entry of `joints`."""
        ...

    def with_sides(self, members: MemberIndices, joints: Any, sides: Float[Any, "b S"]) -> Any:
        """Return `joints` with other sides of the comparisons in forces of members."""
        ...

    def turned(self, members: MemberIndices, k: Int[Any, "b"], at: RunState) -> Float[Any, "b S"]:
        """Return the sides of the comparisons in forces of members after event k at their states."""
        ...

    def when(self, mask: Bool[Any, "B"], change: Change, runs: MemberRuns) -> MemberRuns:
        """Return the runs with a change of the masked members."""
        ...

    def repeat(self, change: Callable[[MemberRuns], MemberRuns], runs: MemberRuns) -> MemberRuns:
        """Return the runs after changing them until none is running."""
        ...


def condition_values(
    system: System, members: MemberIndices, state: RunState, is_directed: bool = False
) -> tuple[ConditionValues, StateValues]:
    """Return the conditions of members at their states, and all quantities evaluated in these states."""
    xp, state_values, unit = system.xp, system.look(members, state, is_directed=is_directed), take(system.coordinates, members)
    rate, t = take(system.rate, members)[:, None], state.t[:, None]
    by_q = xp.abs(state_values.by_q) * xp.maximum(unit, xp.abs(state.q))[:, None]
    by_v = xp.abs(state_values.by_v) * xp.maximum(unit * rate, xp.abs(state.v))[:, None]
    scale = xp.maximum(xp.maximum(by_q, by_v).max(2), xp.abs(state_values.by_t) * xp.maximum(1 / rate, xp.abs(t)))
    scale = xp.where(xp.isfinite(scale), scale, 0.0)  # a condition that is NaN has no scale
    scale = scale if xp is np else stop_gradients(scale)
    return ConditionValues(state_values.g, state_values.rate, state_values.rate_2, state_values.a, scale), state_values
