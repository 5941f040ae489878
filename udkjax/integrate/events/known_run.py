"""Runs with events by machine code, as functions of arrays: called at once, or from compiled programs of JAX."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udkjax.equations.scales import mass_of
from udkjax.expressions.numpy_program import Meter, numpy_program
from udkjax.integrate.compiled_mechanism import CompiledMechanism
from udkjax.integrate.events.actions import Impact, Log, Stop
from udkjax.integrate.events.added_joints import added_joints, joint_numbers
from udkjax.integrate.events.condition_program import condition_numbers
from udkjax.integrate.events.driver import run
from udkjax.integrate.events.event import Event
from udkjax.integrate.events.event_run import EventRun, RunInput, run_plain
from udkjax.integrate.events.hybrid import Hybrid
from udkjax.integrate.events.phase_code import PhaseCode, phase_arrays, phase_plan
from udkjax.integrate.events.phases import Phases
from udkjax.integrate.events.run_members import EventPlan, MemberUnits, RunMembers
from udkjax.integrate.gradients import TreeDef, stop_gradients
from udkjax.integrate.problem import Problem
from udkjax.native.conditions import Conditions
from udkjax.native.host_function import call_host
from udkjax.scene.identity_cache import cached_by_identity

SHARED = 9  # arrays of a run besides those of its phases


@dataclass(frozen=True)
class PlainForm:
    """A run in its plain form, as a function of arrays: what is asked where machine code cannot tell what happens."""

    tree: TreeDef  # of the system and its input
    others: tuple[Any, ...]  # their leaves that are no arrays, None for each that is one
    shapes: tuple[tuple[tuple[int, ...], np.dtype], ...]  # of the arrays, and their types
    max_events: int

    def run(self, *arrays: Array) -> EventRun:
        """Return the run of some arrays."""
        known = iter(arrays)
        hybrid, given = jax.tree.unflatten(self.tree, [next(known) if x is None else x for x in self.others])
        return run_plain(hybrid, given, self.max_events)

    def __call__(self, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
        given = [x.astype(dtype) for x, (_, dtype) in zip(arrays, self.shapes, strict=True)]
        with np.errstate(all="ignore"):
            return numpy_program(_plain_program(self))(Meter(math.inf), given)


@lru_cache(maxsize=64)
def _plain_program(plain: PlainForm) -> Any:
    return jax.jit(plain.run).trace(*(jax.ShapeDtypeStruct(shape, kind) for shape, kind in plain.shapes)).jaxpr


def run_by_machine_code(hybrid: Hybrid, given: RunInput, conditions: Conditions, max_events: int) -> EventRun:
    """Run a system with events by machine code, within a program that is traced.

    Args:
        hybrid: the system.
        given: the initial state, and the output times.
        conditions: conditions of all events.
        max_events: most events that may happen.
    """
    added = hybrid.phases.first_added()
    problems = [hybrid.problem(k, given.ts, given.q, given.v, added) for k in range(len(hybrid.plans))]
    compiled = [problem.compiled for problem in problems]
    plan = event_plan(hybrid.phases, hybrid.events, compiled, conditions, hybrid.max_steps, max_events)
    leaves, tree = jax.tree.flatten((hybrid, given))
    arrays = [jnp.asarray(x) for x in leaves if isinstance(x, jax.Array | np.ndarray)]
    others = tuple(None if isinstance(x, jax.Array | np.ndarray) else x for x in leaves)
    plain = PlainForm(tree, others, tuple((x.shape, np.dtype(x.dtype)) for x in arrays), max_events)
    inputs = [
        *event_arrays(plan, hybrid.events, hybrid.phases, problems, given.code, given.drift_tol),
        *(x[None] for x in arrays),
    ]
    found = EventRun(*(x[0] for x in call_host(KnownRun(plan, len(given.ts), len(given.q), plain), stop_gradients(inputs))))
    whole = ("event_index", "event_phase", "closed", "count", "code", "totals")
    found = found._replace(**{name: getattr(found, name).astype(int) for name in whole})
    return found._replace(together=found.together > 0.5, undefined=found.undefined > 0.5)


@dataclass(frozen=True)
class KnownRun:
    """Runs of the members of a batch, as a function of arrays of NumPy (native/host_function.py).

    Attributes:
        plan: common part of all runs.
        times: number of output times.
        coordinates: n.
        plain: the plain form of one member; None: members that it is to be asked for are left with the code -1.
    """

    plan: EventPlan
    times: int
    coordinates: int
    plain: PlainForm | None = None

    def shapes(self, members: int) -> list[tuple[int, ...]]:
        """Return the shapes of the fields of `EventRun`, with the members in front."""
        T, n, K, E = self.times, self.coordinates, self.plan.max_events, len(self.plan.directions)
        of_one = (T, n), (T, n), (), (K,), (K, 2, n), (K, 2, n), (K,), (K,), (K,), (K, E), (), (E,), (E,), (), (4,)
        return [(members, *shape) for shape in of_one]

    def __call__(self, *inputs: np.ndarray) -> list[np.ndarray]:
        B = max(len(x) for x in inputs)
        ts, q, v, code, units, numbers, restitution, inverse_mass, of_joints = inputs[:SHARED]
        given, phases = list(inputs[SHARED:]), []
        joints = [np.full((B, len(joint.program.outputs)), np.nan) for joint in self.plan.added]
        for plan in self.plan.phases:
            phases.append(PhaseCode(plan, given[: plan.count], numbers, inverse_mass, B, joints))
            given = given[plan.count :]
        spread = (ts, q, v, code, units, restitution, inverse_mass, of_joints)
        ts, q, v, code, units, restitution, inverse_mass, of_joints = (np.broadcast_to(x, (B, *x.shape[1:])) for x in spread)
        members = RunMembers(
            plan=self.plan,
            phases=phases,
            ts=ts,
            q=q,
            v=v,
            code=code[:, 0],
            units=MemberUnits(*units.T),
            restitution=restitution,
            inverse_mass=inverse_mass,
            joints=joints,
            joint_numbers=of_joints,
        )
        run(members)
        found = _results(members)
        for b in np.flatnonzero(members.unsure):
            if self.plain is None:
                found.code[b] = -1
            else:
                for to, x in zip(found, self.plain([x[b if len(x) > 1 else 0] for x in given]), strict=True):
                    to[b] = x
        return list(found)


def _results(members: RunMembers) -> EventRun:
    K, E = members.plan.max_events, members.event_count
    return EventRun(
        q=members.qs,
        v=members.vs,
        time=members.t,
        event_time=members.event_time[:, :K],
        event_q=members.event_q[:, :K],
        event_v=members.event_v[:, :K],
        event_index=members.event_index[:, :K],
        event_phase=members.event_phase[:, :K],
        together=members.together[:, :K],
        closed=members.closed[:, :K],
        count=members.count,
        unresolved=np.full((len(members.t), E), np.inf),
        undefined=members.undefined,
        code=members.code,
        totals=members.totals,
    )


def event_plan(
    phases: Phases,
    events: Sequence[Event],
    compiled: Sequence[CompiledMechanism],
    conditions: Conditions,
    max_steps: int,
    max_events: int,
) -> EventPlan:
    """Return the common part of runs.

    Args:
        phases: the phases.
        events: all events.
        compiled: the mechanism of each phase.
        conditions: conditions of all events.
        max_steps: the largest number of steps that are tried.
        max_events: most events that may happen.
    """
    impacts = tuple(isinstance(e.action, Impact) for e in events)
    at_rest = [e.action.at_rest if isinstance(e.action, Impact) else "" for e in events]
    of_phase = [int(k) for k in np.flatnonzero(impacts)]
    added = [name for _, name in phases.added_by]
    plans = [phase_plan(m, conditions, held, of_phase, added) for m, held in zip(compiled, phases.tables.held, strict=True)]
    return EventPlan(
        phases=tuple(plans),
        tables=phases.tables,
        directions=tuple(e.direction for e in events),
        by_velocity=conditions.by_velocity,
        impacts=impacts,
        hold=tuple(x == "hold" for x in at_rest),
        stop_at_rest=tuple(x == "stop" for x in at_rest),
        changes=tuple(not isinstance(e.action, Log | Stop) for e in events),
        stops=tuple(isinstance(e.action, Stop) for e in events),
        max_steps=max_steps,
        max_events=max_events,
        added=added_joints(phases),
    )


@cached_by_identity
def known_event_plan(phases: Phases, conditions: Conditions, max_steps: int, max_events: int, *others: Any) -> EventPlan:
    """Return the same for all events, and the compiled mechanisms behind them, of known numbers."""
    count = len(others) - len(phases.mechanisms)
    return event_plan(phases, others[:count], others[count:], conditions, max_steps, max_events)


def event_arrays(
    plan: EventPlan,
    events: Sequence[Event],
    phases: Phases,
    problems: Sequence[Problem],
    code: Int[Any, ""],
    drift_tol: Float[Any, ""],
    xp: ModuleType = jnp,
) -> list[Any]:
    """Return the arrays of one run, with the member first.

    Args:
        plan: common part of all runs.
        events: all events.
        phases: the phases.
        problems: the run in each phase.
        code: the `Result` that is known before.
        drift_tol: the violation of the constraints that ends it.
        xp: jax.numpy, or NumPy.
    """
    first, scales = problems[0], problems[0].textbook.scales
    units = MemberUnits(first.smallest, first.rate, scales.length, scales.rate, scales.mass, drift_tol)
    of_run = [xp.asarray(x, float)[None] for x in (first.ts, first.q, first.v, _stack([code], xp), _stack(units, xp))]
    of_phases = [phase_arrays(p, x, xp) for p, x in zip(problems, plan.phases, strict=True)]
    of_events = (_known_numbers if xp is np else _numbers)(xp, phases, *events)
    return [*of_run, *of_events, *(x for phase in of_phases for x in phase)]


def _stack(numbers: Sequence[Any], xp: ModuleType) -> Any:
    return xp.stack([xp.asarray(x, float) for x in numbers])


def _numbers(xp: ModuleType, phases: Phases, *events: Event) -> list[Any]:
    """Return the arrays that no state and no choice decides: of conditions, of impacts, of masses and of joints."""
    restitution = [e.action.restitution if isinstance(e.action, Impact) else 0.0 for e in events]
    of_conditions, of_joints = (
        xp.concatenate([*(xp.ravel(xp.asarray(x, float)) for x in numbers), xp.zeros(0)])
        for numbers in (condition_numbers(events), joint_numbers(phases))
    )
    return [x[None] for x in (of_conditions, _stack(restitution, xp), 1 / mass_of(phases.mechanisms[0], xp), of_joints)]


_known_numbers = cached_by_identity(_numbers)
