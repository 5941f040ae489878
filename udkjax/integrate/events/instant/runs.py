"""The states and the results of runs with events, the members of a batch.

Arrays have a leading axis of members. Runs by machine code have arrays of NumPy, whose rows change in place; the plain form has
arrays of JAX for one member, which are replaced.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.integrate.solution import Result

# Used instead of the index of an event: conditions are not evaluated yet, at the start of the run or after an event.
AT_START, AFTER_EVENT = -3, -2

MemberIndices = Int[np.ndarray, "b"] | None  # the indices of members; None: all members


class RunState(NamedTuple):
    """The states of runs: time, coordinates, velocities, phase, and the joints that events have added, followed by all sides."""

    t: Float[Any, "*m"]
    q: Float[Any, "*m n"]
    v: Float[Any, "*m n"]
    phase: Bool[Any, "*m C"]
    joints: Any  # joints, with JAX arrays of one member; or NumPy arrays of the numbers of all members, changed in place

    def where(self, mask: Bool[np.ndarray, "m"]) -> "RunState":
        """Return the states of the masked members; `joints` stay as they are."""
        t, q, v, phase, joints = self
        return RunState(t[mask], q[mask], v[mask], phase[mask], joints)


class EventRun(NamedTuple):
    """The outputs and events of a run; states and times that were not reached are infinite.

    In the tangents of a run, fields without derivatives are None.
    """

    q: Float[Any, "*m T n"]
    v: Float[Any, "*m T n"]
    time: Float[Any, "*m"]  # the end of the run
    event_time: Float[Any, "*m K"]
    event_q: Float[Any, "*m K 2 n"]  # before and after the event
    event_v: Float[Any, "*m K 2 n"]
    event_index: Int[Any, "*m K"]  # index of the event; plus E if a contact opens, plus 2 E if it comes to rest
    event_phase: Bool[Any, "*m K C"]  # phase after the event
    together: Bool[Any, "*m K"]  # whether it happens together with the previous event, as one
    contact_state: Int[Any, "*m K E"]  # the states of all contacts, as in `ContactChanges`
    sides: Float[Any, "*m K S"]  # the sides of comparisons after the event
    count: Int[Any, "*m"]  # number of events
    unresolved: Float[Any, "*m E"]  # as in `Events`
    undefined: Bool[Any, "*m E"]  # as in `Events`
    code: Int[Any, "*m"]  # the `Result`
    totals: Int[Any, "*m 5"]  # steps tried, accepted, right-hand sides, projections, implicit steps
    first_phase: Bool[Any, "*m C"]  # phase at the start
    first_sides: Float[Any, "*m S"]  # sides at the start
    end: Float[Any, "*m 2 n"]  # q and v at the end of the run


EVENT_STATES = ("event_time", "event_q", "event_v")
RECORD_FIELDS = (
    *EVENT_STATES,
    "event_index",
    "event_phase",
    "together",
    "contact_state",
    "sides",
)  # fields of `EventRun` with an entry for each event


def shapes_of_run(plan: EventPlan, T: int, n: int, room: int) -> EventRun:
    """Return the shapes of the fields of a run of T output times and n coordinates, with room for `room` events."""
    E, K, C, S = plan.count, room, len(plan.first), plan.side_count
    of_events = (K,), (K, 2, n), (K, 2, n), (K,), (K, C), (K,), (K, E), (K, S)
    return EventRun((T, n), (T, n), (), *of_events, (), (E,), (E,), (), (5,), (C,), (S,), (2, n))


class MemberRuns(NamedTuple):
    """The state of B runs, which the loop over events updates."""

    t: Float[Any, "B"]
    q: Float[Any, "B n"]
    v: Float[Any, "B n"]
    phase: Bool[Any, "B C"]
    joints: Any
    event: Int[Any, "B"]  # index of the event at this time, plus E if a contact opens; or `NO_EVENT`, `AT_START`, `AFTER_EVENT`
    sides: Int[Any, "B 2E"]  # the last side of zero of each condition and contact force: -1 or 1; 0 if unknown
    scale: Float[Any, "B E"]  # scales of conditions, as in `ConditionValues`
    carried: Bool[Any, "B E"]  # the contacts kept at zero by other contacts at rest
    running: Bool[Any, "B"]
    code: Int[Any, "B"]
    undefined: Bool[Any, "B E"]  # the conditions whose NaN ended the run
    totals: Int[Any, "B 5"]
    qs: Float[Any, "B T n"]
    vs: Float[Any, "B T n"]
    count: Int[Any, "B"]  # number of events
    record: tuple[Any, ...]  # fields `RECORD_FIELDS` of `EventRun`, with one more row as a sink for entries without an event
    window: Any  # `Window` of the plain form; else None
    first_phase: Bool[Any, "B C"]  # phase at the start
    first_sides: Float[Any, "B S"]  # sides at the start

    def state(self, members: MemberIndices) -> RunState:
        """Return the states of members."""
        return RunState(
            take(self.t, members), take(self.q, members), take(self.v, members), take(self.phase, members), self.joints
        )

    def kink_count(self, plan: EventPlan, members: MemberIndices) -> Int[Any, "b"]:
        """Return the number of kinks that members have recorded so far."""
        index = take(self.record[RECORD_FIELDS.index("event_index")], members)
        xp = np if isinstance(index, np.ndarray) else jnp
        if not plan.has_kinks:
            return xp.zeros(len(index), int)
        return xp.sum((index >= 0) & (index < plan.count) & xp.asarray(plan.kinks)[index % plan.count], axis=1)

    def put(self, members: MemberIndices, **new: Any) -> "MemberRuns":
        """Return the runs with new values of the named fields for members; NumPy arrays change in place."""
        if members is None:
            return self._replace(**new)
        for name, x in new.items():
            getattr(self, name)[members] = x
        return self

    def note(self, members: MemberIndices, rows: Int[Any, "b k"], *new: Any) -> "MemberRuns":
        """Return the runs with new entries in `rows` of the record: an array (b or 1, k or 1, ...) for each field of a record."""
        column = (np.arange(len(self.t)) if members is None else members)[:, None]
        if isinstance(self.t, np.ndarray):
            for array, x in zip(self.record, new, strict=True):
                array[column, rows] = x
            return self
        return self._replace(record=tuple(x.at[column, rows].set(y) for x, y in zip(self.record, new, strict=True)))


Change = Callable[[MemberRuns, MemberIndices], MemberRuns]


def take(x: Any, members: MemberIndices) -> Any:
    """Return the rows of an array that belong to members."""
    return x if members is None else x[members]


def runs_before(plan: EventPlan, state: RunState, T: int, code: Int[Any, "B"], xp: ModuleType, window: Any = None) -> MemberRuns:
    """Return B runs before their start, in the given states; `code` is the `Result` of each as far as it is known."""
    (B, n), E = state.q.shape, plan.count
    shapes = shapes_of_run(plan, T, n, plan.room + 1)._asdict()
    values = dict.fromkeys(EVENT_STATES, np.inf) | {
        "event_index": -1,
        "event_phase": False,
        "together": False,
        "contact_state": 0,
        "sides": 0.0,
    }
    no = xp.zeros((B, E), bool)
    return MemberRuns(
        *state,
        event=xp.full(B, AT_START),
        sides=xp.zeros((B, 2 * E), int),
        scale=xp.zeros((B, E)),
        carried=no,
        running=code == Result.successful,
        code=code,
        undefined=no.copy(),
        totals=xp.zeros((B, 5), int),
        qs=xp.full((B, *shapes["q"]), np.inf),
        vs=xp.full((B, *shapes["v"]), np.inf),
        count=xp.zeros(B, int),
        record=tuple(xp.full((B, *shapes[name]), value) for name, value in values.items()),
        window=window,
        first_phase=state.phase,
        first_sides=xp.zeros((B, plan.side_count)),
    )


def results(plan: EventPlan, runs: MemberRuns, ts: Float[Any, "B T"], unresolved: Float[Any, "B E"], xp: ModuleType) -> EventRun:
    """Return the results of finished runs; an output at the time of the last state is that state."""
    last, record = (ts == runs.t[:, None])[..., None], (x[:, : plan.room] for x in runs.record)
    q, v = xp.where(last, runs.q[:, None], runs.qs), xp.where(last, runs.v[:, None], runs.vs)
    ends = runs.count, unresolved, runs.undefined, runs.code, runs.totals, runs.first_phase, runs.first_sides
    return EventRun._make([q, v, runs.t, *record, *ends, xp.stack([runs.q, runs.v], axis=1)])
