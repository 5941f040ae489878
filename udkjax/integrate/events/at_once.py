"""Runs of known numbers in which events change nothing: machine code runs from one to the next, and nothing is traced.

That is a run in which nothing happens, or in which all that happens is noted, or stops it. All else, and what cannot be told from
a crossing at once, is left to the loop.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from udkjax.integrate import native_engine
from udkjax.integrate.events.actions import Impact, Log, Stop
from udkjax.integrate.events.condition_program import ConditionPrograms, condition_numbers, condition_programs
from udkjax.integrate.events.crossings import NO_EVENT, ZERO
from udkjax.integrate.events.event import Event
from udkjax.integrate.events.replay import EventRun
from udkjax.integrate.prepare import PreparedRun
from udkjax.integrate.solution import Result
from udkjax.native.conditions import watch_inputs
from udkjax.native.steps import CROSSED, DONE


class Look(NamedTuple):
    """All conditions at one state."""

    sides: np.ndarray  # of zero, or 0 at zero
    floors: np.ndarray  # below which a condition is zero
    clear: np.ndarray  # whether each is a number, and not zero


class PlainRun:
    """A run of a mechanism of known numbers, as far as events change nothing.

    Args:
        run: the run without events.
        events: all events.
        programs: programs of their conditions.
        drift_tol: the violation of the constraints that ends a run.
    """

    def __init__(self, run: PreparedRun, events: Sequence[Event], programs: ConditionPrograms, drift_tol: float):
        self._problem, self._events, self._programs, self._drift_tol = run.problem, events, programs, drift_tol
        self.ts, self._numbers = np.asarray(run.problem.ts), np.array([y for x in condition_numbers(events) for y in np.ravel(x)])
        self.q, self.v = np.full((2, len(self.ts), len(run.problem.q)), np.inf)
        self.t, self.state = float(self.ts[0]), (np.asarray(run.problem.q), np.asarray(run.problem.v))
        self.noted: list[tuple[float, int, np.ndarray, np.ndarray]] = []  # times, events and states
        self.totals = np.zeros(4, int)
        scales = run.problem.textbook.scales
        length, self._rate = float(scales.length), float(run.problem.rate)
        self._slowest, self._unit = float(scales.rate), np.tile([length, length, 1.0], len(run.problem.q) // 3)
        self.look = self._look(np.zeros(len(events)))

    @property
    def may_begin(self) -> bool:
        """True if all conditions are numbers where the run begins, and all contacts open. Others that are zero leave it."""
        impacts = np.array([isinstance(e.action, Impact) for e in self._events])
        return bool(np.all(np.isfinite(self.look.sides)) and np.all(self.look.sides[impacts] > 0))

    def advance(self) -> int | None:
        """Run to the next event, which is returned, or to the end, -1; return None where it is another than such a run has."""
        problem, here = self._problem, self.ts == self.t
        self.q[here], self.v[here] = self.state
        first = int(np.searchsorted(self.ts, self.t, side="right"))
        times = np.append(self.t, self.ts[first:])
        if times[-1] - self.t <= 2 * problem.smallest:
            return None
        E, directions = len(self._events), [e.direction for e in self._events]
        given = watch_inputs(np, [self._numbers], self.look.sides, np.ones(E), self.look.floors, directions, self._slowest)
        piece = replace(problem, ts=times, q=self.state[0], v=self.state[1])
        found = native_engine.watch_known(piece, self._programs.watched, given)
        out, happens = found.output, found.output.status == CROSSED
        rows = out.reached & (times <= found.t)
        if not (happens or out.status == DONE) or not max(out.violation[rows].max(), found.violation) <= self._drift_tol:
            return None
        later = np.flatnonzero(rows)[1:]
        self.q[first - 1 + later], self.v[first - 1 + later] = out.q[later], out.v[later]
        projections = problem.compiled.plan.projected * (int(out.tried) + 2 * len(times) - 2)
        self.totals += [int(out.tried), int(out.accepted), int(out.evaluations), projections]
        self.t, self.state = float(found.t), (found.q, found.v)
        return self._note(int(found.event), found.sides)

    def _note(self, event: int, sides: np.ndarray) -> int | None:
        """Note an event, or the end, at the present state; return None where another condition is zero there, too.

        `sides` are those before it.
        """
        look = self._look(self.look.floors / ZERO)
        if event >= 0:
            if not isinstance(self._events[event].action, Log | Stop):
                return None
            look.sides[event] = -sides[event]
            look.clear[event] = True
            self.noted.append((self.t, event, self.state[0], self.state[1]))
        self.look = look
        return event if look.clear.all() else None

    def _look(self, scales: np.ndarray) -> Look:
        """Look at the conditions; `scales` are those known, which do not become smaller."""
        (q, v), unit, rate = self.state, self._unit, self._rate
        values = self._programs.derivatives([float(x) for x in np.concatenate([[self.t], q, v, self._numbers])])
        g, by_t, by_q, by_v = np.split(np.array(values, float).reshape(len(self._events), -1), [1, 2, 2 + len(q)], axis=1)
        sizes = [by_t * max(1 / rate, abs(self.t)), by_q * np.maximum(unit, np.abs(q)), by_v * np.maximum(unit * rate, np.abs(v))]
        scales = np.maximum(scales, np.max(np.abs(np.concatenate(sizes, axis=1)), axis=1))
        g, floors = g[:, 0], ZERO * scales
        clear = np.isfinite(g) & (np.abs(g) > floors)
        return Look(np.where(np.isfinite(g), np.sign(g) * clear, g), floors, clear)


def run_at_once(
    run: PreparedRun, events: Sequence[Event], names: Sequence[str], drift_tol: float, max_events: int
) -> EventRun | None:
    """Run a mechanism with events by machine code alone; return None where that is not all that is needed.

    Args:
        run: the run without events, of known numbers.
        events: all events.
        names: of the bodies.
        drift_tol: the violation of the constraints that ends a run.
        max_events: most events that may happen.
    """
    programs = condition_programs(events, names)
    if programs is None or not (run.is_usable and run.is_closed) or run.has_missed_rows:
        return None
    plain = PlainRun(run, events, programs, drift_tol)
    event = NO_EVENT if plain.may_begin else None
    while event is not None and len(plain.noted) <= max_events:
        event = plain.advance()
        if event is not None and (event == NO_EVENT or isinstance(events[event].action, Stop)):
            return _finish(plain, events, Result.successful if event == NO_EVENT else Result.event_stop, max_events)
    return None


def _finish(plain: PlainRun, events: Sequence[Event], code: Result, max_events: int) -> EventRun | None:
    count, here = len(plain.noted), plain.ts == plain.t
    if count > max_events:
        return None
    plain.q[here], plain.v[here] = plain.state
    n, E = plain.q.shape[1], len(events)
    q, v = (np.array([[noted[k]] * 2 for noted in plain.noted]).reshape(count, 2, n) for k in (2, 3))
    found: dict[str, Any] = {
        "q": plain.q,
        "v": plain.v,
        "time": np.asarray(plain.t),
        "event_time": np.array([t for t, *_ in plain.noted]),
        "event_q": q,
        "event_v": v,
        "event_index": np.array([event for _, event, *_ in plain.noted], int),
        "event_phase": np.zeros(count, int),
        "together": np.zeros(count, bool),
        "closed": np.zeros((count, E), int),
        "count": np.asarray(count),
        "unresolved": np.full(E, np.inf),
        "undefined": np.zeros(E, bool),
        "code": np.asarray(code.value),
        "totals": plain.totals,
    }
    return EventRun(**found)
