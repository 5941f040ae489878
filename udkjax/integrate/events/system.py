"""The interface of the loop to the motion: conditions at states, and the advance to the next crossing."""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple, Protocol

from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.event_plan import EventPlan
from udkjax.integrate.events.impacts import Contacts
from udkjax.integrate.events.runs import Change, MemberIndices, MemberRuns, RunState


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

    def contacts(self, members: MemberIndices) -> Contacts:
        """Return the contacts of members."""
        ...

    def look(self, members: MemberIndices, at: RunState, is_free: bool = False) -> StateValues:
        """Evaluate the conditions of members at states; if `is_free`, the phases have no contacts at rest."""
        ...

    def project(self, members: MemberIndices, at: RunState, is_free: bool = False) -> tuple[Float[Any, "b n"], Float[Any, "b n"]]:
        """Return the states projected to the constraints of their phases."""
        ...

    def add_joints(self, members: MemberIndices, event: Int[Any, "b"], q: Float[Any, "b n"], joints: Any) -> Any:
        """Return the joints that events have added, with those that `event` adds at q; -1: no event."""
        ...

    def advance(self, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
        """Advance members, at most to the next crossing, which becomes their `event`."""
        ...

    def sides(self, members: MemberIndices, joints: Any) -> Float[Any, "b S"]:
        """Return the sides of comparisons (kinks.py), the last of the joints."""
        ...

    def with_sides(self, members: MemberIndices, joints: Any, sides: Float[Any, "b S"]) -> Any:
        """Return the joints that events have added, with other sides of members."""
        ...

    def turned(self, members: MemberIndices, k: Int[Any, "b"], at: RunState) -> Float[Any, "b S"]:
        """Return the sides of members after event k at their states."""
        ...

    def when(self, mask: Bool[Any, "B"], change: Change, runs: MemberRuns) -> MemberRuns:
        """Return the runs with a change of the masked members."""
        ...

    def repeat(self, change: Callable[[MemberRuns], MemberRuns], runs: MemberRuns) -> MemberRuns:
        """Return the runs after changing them until none is running."""
        ...
