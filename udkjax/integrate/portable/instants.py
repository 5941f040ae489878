"""Instants of runs with events, for pages: everything that a run does between two stretches of motion, as WebAssembly.

The code is that of all runs (integrate/events/instant), traced for one member and lowered. The module exports `settle`, which
applies the events at the present time, and, if joints may stick, `begin`, which decides which of them do at the start. Both take
the address of a block of numbers (native/wasm/hosted.py), and ask their host about a state:

    look        the conditions, with their rates, slopes, directions of impulses and forces
    project     q and v projected onto the constraints of the phase, and the violation that is left
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.events.instant.listing import listing
from udkjax.integrate.events.instant.loop import begin, settle
from udkjax.integrate.events.instant.runs import (
    AT_START,
    RECORD_FIELDS,
    Change,
    EventRun,
    MemberIndices,
    MemberRuns,
    RunState,
    runs_before,
)
from udkjax.integrate.events.instant.system import StateValues
from udkjax.integrate.events.law.actions import NUMBERS_OF_ACTIONS
from udkjax.integrate.events.law.event import Event
from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.integrate.events.law.phases import Phases
from udkjax.integrate.events.run.added_joints import AddedJoint
from udkjax.integrate.events.run.phase_code import ValuesLayout

# The parts of a run that an instant changes, `joints` one after another; and of its record only what the next event needs.
CHANGED_FIELDS = "t q v phase joints event sides scale carried running code undefined".split()
LAST_EVENT_FIELDS = "event_time", "event_index", "contact_state"


@dataclass(frozen=True)
class Instants:
    """The code of the instants of the runs of a scene with events.

    Attributes:
        plan: the phases and events, with room for the events of one instant.
        added: the joints that events add.
        values: the layout of the values of conditions.
        n: the number of coordinates.
        listed: all events, and the phases, for `listing`.
    """

    plan: EventPlan
    added: tuple[AddedJoint, ...]
    values: ValuesLayout
    n: int
    listed: tuple[tuple[Event, ...], Phases]

    @property
    def widths(self) -> list[int]:
        """The number of numbers of each joint that events add, then of all sides."""
        return [*(len(joint.program.outputs) for joint in self.added), self.plan.side_count]

    @property
    def inputs(self) -> dict[str, tuple[int, ...]]:
        """The shapes of the inputs of the functions, by name."""
        n, E, C = self.n, self.plan.count, len(self.plan.first)
        numbers = sum(len(joint.program.inputs) - n for joint in self.added)
        of_state = {"t": (), "q": (n,), "v": (n,), "phase": (C,), "joints": (sum(self.widths),), "event": (), "sides": (2 * E,)}
        of_state |= {"scale": (E,), "carried": (E,), "running": (), "code": (), "undefined": (E,)}
        of_state |= {f"last_{name}": (E,) if name == "contact_state" else () for name in LAST_EVENT_FIELDS}
        constant = {"end": (), "rate": (), "coordinates": (n,), "inverse_mass": (n,)}
        return of_state | constant | {"of_actions": (len(NUMBERS_OF_ACTIONS), E), "joint_numbers": (numbers,)}

    @property
    def starts(self) -> dict[str, list[float]]:
        """The values of those inputs that are not zero at the start of a run, by name."""
        return {"event": [float(AT_START)], "running": [1.0], "phase": [float(x) for x in self.plan.first]} | {
            "last_event_index": [-1.0]
        }

    @property
    def functions(self) -> dict[str, Callable[..., dict[str, Array]]]:
        """The functions that the module exports, by name, for `hosted_module`."""
        applied = {"settle": settle} | ({"begin": begin} if self.plan.sticking else {})
        return {name: partial(self._outputs, apply) for name, apply in applied.items()}

    def _outputs(
        self, apply: Callable[[Any, MemberRuns], MemberRuns], host: Mapping[str, Callable[..., Array]], *arrays: Array
    ) -> dict[str, Array]:
        """Return the outputs of a function by name: new values of inputs, a mask of watched conditions, and the listed events."""
        given, plan = dict(zip(self.inputs, arrays, strict=True)), self.plan
        joints = tuple(x[None] for x in jnp.split(given["joints"], np.cumsum(self.widths)[:-1]))
        t, q, v = (given[name][None] for name in ("t", "q", "v"))
        state = RunState(t, q, v, given["phase"][None] > 0.5, joints)
        before = runs_before(plan, state, 0, jnp.round(given["code"][None]).astype(int), jnp)
        integers = {name: jnp.round(given[name][None]).astype(int) for name in ("event", "sides")}
        masks = {name: given[name][None] > 0.5 for name in ("carried", "running", "undefined")}
        last = {name: given[f"last_{name}"] for name in LAST_EVENT_FIELDS}
        record: dict[str, Any] = dict(zip(RECORD_FIELDS, before.record, strict=True))
        record |= {name: record[name].at[0, 0].set(x.astype(record[name].dtype)) for name, x in last.items()}
        before = before._replace(
            **integers, **masks, scale=given["scale"][None], count=jnp.ones(1, int), record=tuple(record.values())
        )
        after = apply(InstantMotion(self, host, given), before)
        record = dict(zip(RECORD_FIELDS, after.record, strict=True))
        of_state = {name: getattr(after, name)[0].astype(float) for name in CHANGED_FIELDS if name != "joints"}
        of_state["joints"] = jnp.concatenate([x[0] for x in after.joints])
        of_state |= {f"last_{name}": record[name][0, after.count[0] - 1].astype(float) for name in LAST_EVENT_FIELDS}
        watched = plan.watched(after.phase, after.carried, jnp)[0].astype(float)
        return of_state | {"watched": watched} | self._listed(before, after)

    def _listed(self, before: MemberRuns, after: MemberRuns) -> dict[str, Array]:
        """Return the events of the instant as `listing` lists them: number, indices of their names, times, and states before."""
        of_instant = {name: x[0, 1:] for name, x in zip(RECORD_FIELDS, after.record, strict=True)}
        others = dict.fromkeys(EventRun._fields) | {
            "count": after.count[0] - 1,
            "unresolved": jnp.zeros(self.plan.count),
            "undefined": jnp.zeros(self.plan.count, bool),
            "first_phase": before.phase[0],
            "first_sides": before.joints[-1][0],
        }
        run = listing(EventRun(**others | of_instant), jnp.zeros(0), *self.listed, self.plan.room, jnp).run
        rows = {"name": run.event_index, "time": run.event_time, "q": run.event_q[:, 0], "v": run.event_v[:, 0]}
        return {"events": run.count.astype(float)} | {f"events_{name}": x.astype(float) for name, x in rows.items()}

    @property
    def imports(self) -> dict[str, tuple[dict[str, tuple[int, ...]], int]]:
        """The functions that the module imports from its host: shapes of the inputs and size of the output, by name."""
        state = {f"at_{name}": self.inputs[name] for name in ("t", "q", "v", "phase", "joints")}
        return {"look": (state, self.values.size), "project": (state, 2 * self.n + 1)}


class InstantMotion:
    """The motion of one member, a `system.System`, that asks its host for everything that depends on the equations of motion."""

    xp = jnp

    def __init__(self, instants: Instants, host: Mapping[str, Callable[..., Array]], given: dict[str, Array]):
        self._of, self.plan, self._host, self._given = instants, instants.plan, host, given
        self.end, self.rate = given["end"][None], given["rate"][None]
        self.coordinates, self.inverse_mass = given["coordinates"][None], given["inverse_mass"][None]

    def numbers_of_actions(self, members: MemberIndices) -> Float[Array, "1 N E"]:
        """Return the numbers of the actions."""
        return self._given["of_actions"][None]

    def look(
        self, members: MemberIndices, at: RunState, is_free: bool = False, is_directed: bool = False, has_forces: bool = False
    ) -> StateValues:
        """Return the values of the conditions at a state; see `System.look`."""
        return self._of.values.values(self._ask("look", at)[None], jnp)

    def project(self, members: MemberIndices, at: RunState, is_free: bool = False) -> tuple[Array, Array, Array]:
        """Return q and v projected onto the constraints of the phase, and the largest remaining |Psi_dot_i| over its scale."""
        found, n = self._ask("project", at)[None], self._of.n
        return found[:, :n], found[:, n:-1], found[:, -1]

    def _ask(self, name: str, at: RunState) -> Array:
        joints = jnp.concatenate([x[0] for x in at.joints])
        return self._host[name](at.t[0], at.q[0], at.v[0], at.phase[0].astype(float), joints)

    def add_joints(self, members: MemberIndices, new: Bool[Array, "1 A"], q: Float[Array, "1 n"], joints: Any) -> Any:
        """Return `joints` in which the joints that are masked in `new` are added at the positions q."""
        found, start = [], 0
        for k, (joint, numbers) in enumerate(zip(self._of.added, joints[:-1], strict=True)):
            count = len(joint.program.inputs) - self._of.n
            values = joint.program([*q[0], *self._given["joint_numbers"][start : start + count]])
            found.append(jnp.where(new[:, k, None], jnp.stack([jnp.asarray(x, float) for x in values]), numbers))
            start += count
        return (*found, joints[-1])

    def sides(self, members: MemberIndices, joints: Any) -> Float[Array, "1 S"]:
        """Return all sides (1, S): the last entry of `joints`."""
        return joints[-1]

    def with_sides(self, members: MemberIndices, joints: Any, sides: Float[Array, "1 S"]) -> Any:
        """Return `joints` with other sides, their last entry."""
        return (*joints[:-1], sides)

    def turned(self, members: MemberIndices, k: Int[Array, "1"], at: RunState) -> Float[Array, "1 S"]:
        """Return all sides after an event: unchanged, since a page has no events at kinks."""
        return self.sides(members, at.joints)

    def when(self, mask: Bool[Array, "1"], change: Change, runs: MemberRuns) -> MemberRuns:
        """Return the run after a change if the mask is true, else unchanged."""
        return jax.lax.cond(mask[0], lambda runs: change(runs, None), lambda runs: runs, runs)

    def advance(self, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
        """Raise `NotImplementedError`: the host advances the run between two instants."""
        raise NotImplementedError

    def repeat(self, change: Callable[[MemberRuns], MemberRuns], runs: MemberRuns) -> MemberRuns:
        """Raise `NotImplementedError`: the host calls one instant after another."""
        raise NotImplementedError
