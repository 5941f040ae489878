"""Runs with events by machine code as functions of arrays, called directly or from compiled programs of JAX."""

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

from udkjax.annotations import TreeDef
from udkjax.arrays import is_array
from udkjax.integrate.compiled_mechanism import CompiledMechanism
from udkjax.integrate.events.instant.loop import run_loop
from udkjax.integrate.events.instant.runs import EventRun, RunState, results, runs_before, shapes_of_run
from udkjax.integrate.events.law.actions import numbers_of_actions
from udkjax.integrate.events.law.event import Event
from udkjax.integrate.events.law.event_plan import EventPlan, event_plan
from udkjax.integrate.events.law.kinks import FREE_SIDE, places_of_kinks
from udkjax.integrate.events.law.phases import SCENE, Phases
from udkjax.integrate.events.run.added_joints import added_joints, joint_numbers
from udkjax.integrate.events.run.condition_program import condition_numbers, with_forces
from udkjax.integrate.events.run.hybrid import Hybrid, inverse_mass_of
from udkjax.integrate.events.run.machine_system import MachinePlan, MachineSystem, MemberUnits
from udkjax.integrate.events.run.phase_code import PhaseCode, phase_arrays, phase_plan
from udkjax.integrate.events.run.plain_system import run_plain
from udkjax.integrate.problem import Problem
from udkjax.native.host.host_function import call_host
from udkjax.native.watching.conditions import Conditions
from udkjax.programs.identity_cache import cached_by_identity, cached_by_size
from udkjax.programs.numpy_program import Meter, numpy_program
from udkjax.transforms.gradients import stop_gradients
from udkjax.wording import quote

SHARED_ARRAYS, NUMBERS_INDEX = 9, 5  # number of arrays before those of the phases, and index of the numbers of conditions


@dataclass(frozen=True)
class PlainForm:
    """A run in its plain form, by JAX, as a function of arrays: the fallback for members that machine code cannot resolve."""

    tree: TreeDef  # structure of the system
    others: tuple[Any, ...]  # leaves of the system that are not arrays, None in place of arrays
    shapes: tuple[tuple[tuple[int, ...], np.dtype], ...]  # shapes and types of the arrays

    def run(self, *arrays: Array) -> EventRun:
        """Run the system with these arrays."""
        remaining = iter(arrays)
        return run_plain(jax.tree.unflatten(self.tree, [next(remaining) if x is None else x for x in self.others]))

    def __call__(self, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
        inputs = [x.astype(dtype) for x, (_, dtype) in zip(arrays, self.shapes, strict=True)]
        with np.errstate(all="ignore"):
            return numpy_program(_plain_program(self))(Meter(math.inf), inputs)


@lru_cache(maxsize=64)
def _plain_program(plain: PlainForm) -> Any:
    return jax.jit(plain.run).trace(*(jax.ShapeDtypeStruct(shape, kind) for shape, kind in plain.shapes)).jaxpr


def run_by_machine_code(hybrid: Hybrid, conditions: Conditions) -> EventRun:
    """Run a system with events by machine code, within a traced program; `conditions` are those of all events."""
    start = hybrid.first_state()
    problems = [hybrid.problem(k, hybrid.ts, start) for k in range(len(hybrid.plans))]
    plan = machine_plan(hybrid.plan, hybrid.phases, hybrid.events, [problem.compiled for problem in problems], conditions)
    leaves, tree = jax.tree.flatten(hybrid)
    arrays = [jnp.asarray(x) for x in leaves if is_array(x)]
    others = tuple(None if is_array(x) else x for x in leaves)
    plain = PlainForm(tree, others, tuple((x.shape, np.dtype(x.dtype)) for x in arrays))
    inputs = [
        *event_arrays(plan, hybrid.events, hybrid.phases, problems, hybrid.code, hybrid.drift_tol),
        *(x[None] for x in arrays),
    ]
    run = EventRun(*(x[0] for x in call_host(HostRun(plan, len(hybrid.ts), len(hybrid.q), plain), stop_gradients(inputs))))
    integers, masks = (
        ("event_index", "contact_state", "count", "code", "totals"),
        ("event_phase", "together", "undefined", "first_phase"),
    )
    run = run._replace(**{name: getattr(run, name).astype(int) for name in integers})
    return run._replace(**{name: getattr(run, name) > 0.5 for name in masks})


@dataclass(frozen=True)
class HostRun:
    """Runs with events of the members of a batch, a `HostFunction` of NumPy arrays (native/host/host_function.py).

    Attributes:
        plan: static part of all runs.
        times: number of output times.
        coordinates: number n of coordinates.
        plain: the plain form of a run of one member. If it is None, members that machine code cannot resolve get the code -1.
    """

    plan: MachinePlan
    times: int
    coordinates: int
    plain: PlainForm | None = None

    @property
    def needed_by(self) -> str:
        """The reason why a run calls Python, with the cure, for messages."""
        joints = [quote(joint.name) for joint in self.plan.events.sticking if joint.contact < 0]
        if joints:
            return f'joints stick ({", ".join(joints)}): give their friction law="smooth"'
        return "runs have events, contacts or forces with kinks of the state: leave out events, and make forces smooth"

    @property
    def description(self) -> str:
        """A text that tells this function from others in all processes: the events, and the structure of the system."""
        return f"{self.plan.events} {self.times} {self.plain and (self.plain.tree, self.plain.others, self.plain.shapes)}"

    def shapes(self, members: int) -> list[tuple[int, ...]]:
        """Return the shapes of the fields of `EventRun`, with a leading axis of members."""
        plan = self.plan.events
        return [(members, *shape) for shape in shapes_of_run(plan, self.times, self.coordinates, plan.room)]

    def __call__(self, *inputs: np.ndarray) -> list[np.ndarray]:
        B, plan = max(len(x) for x in inputs), self.plan
        numbers, further, phases = inputs[NUMBERS_INDEX], list(inputs[SHARED_ARRAYS:]), []
        widths = [*(len(joint.program.outputs) for joint in plan.added), plan.events.side_count]
        of_joints = np.full((B, sum(widths)), np.nan)  # of joints that events add, then all sides
        joints = np.split(of_joints, np.cumsum(widths)[:-1], axis=1)  # views
        joints[-1][:] = FREE_SIDE
        shared = (np.broadcast_to(x, (B, *x.shape[1:])) for x in inputs[:SHARED_ARRAYS])
        ts, q, v, code, units, _, of_actions, inverse_mass, joint_numbers = shared
        for phase in plan.phases:
            phases.append(
                PhaseCode(phase, plan.events.switches, further[: phase.count], numbers, inverse_mass, of_joints, widths)
            )
            further = further[phase.count :]
        system = MachineSystem(plan, phases, ts, MemberUnits(*units.T), of_actions, inverse_mass, joint_numbers, numbers)
        state = RunState(ts[:, 0].copy(), q.copy(), v.copy(), np.tile(plan.events.first, (B, 1)), joints)
        joints[-1][:] = system.first_sides(state)
        runs = run_loop(system, runs_before(plan.events, state, self.times, code[:, 0].astype(int), np))
        outputs = results(plan.events, runs, ts, system.unresolved_from(runs), np)
        for member in np.flatnonzero(system.unresolved):
            if self.plain is None:
                outputs.code[member] = -1
            else:
                for array, x in zip(outputs, self.plain([x[member if len(x) > 1 else 0] for x in further]), strict=True):
                    array[member] = x
        return list(outputs)


def machine_plan(
    plan: EventPlan, phases: Phases, events: Sequence[Event], compiled: Sequence[CompiledMechanism], conditions: Conditions
) -> MachinePlan:
    """Return the static part of runs by machine code.

    Args:
        plan: the plan of the events.
        phases: the phases.
        events: all events.
        compiled: the mechanisms of the phases, compiled.
        conditions: conditions of all events.
    """
    added, of_kinks = added_joints(phases), places_of_kinks(events, phases.held)
    rows = [x.plan.operation.code.row_count for x in compiled if x.plan.operation is not None]
    with_rows = [with_forces(conditions, events, phases.switches, m) for m in rows]
    plans = [phase_plan(which, plan, phases, m, with_rows[which], added, of_kinks) for which, m in enumerate(compiled)]
    return MachinePlan(plan, tuple(plans), added, tuple(zip(phases.held, of_kinks.elements, strict=True)))


PLAN_BYTES = 2**16  # memory of the plan of a phase, with the programs of its conditions
_plan_for_structure = cached_by_size(lambda plan: PLAN_BYTES * len(plan.phases), by_structure=True)(machine_plan)


@cached_by_identity
def concrete_plan(phases: Phases, conditions: Conditions, max_steps: int, max_events: int, *others: Any) -> MachinePlan:
    """Return the static part of runs with concrete numbers; `others` are all events, then the compiled mechanisms."""
    count = len(others) - len(phases.mechanisms)
    events, compiled = others[:count], others[count:]
    plan = event_plan(phases, events, max_steps, max_events, conditions.by_velocity)
    return _plan_for_structure(plan, phases, events, compiled, conditions)


def event_arrays(
    plan: MachinePlan,
    events: Sequence[Event],
    phases: Phases,
    problems: Sequence[Problem],
    code: Int[Any, ""],
    drift_tol: Float[Any, ""],
    xp: ModuleType = jnp,
) -> list[Any]:
    """Return the inputs of `HostRun` for one run, each with a leading axis for its one member.

    Args:
        plan: static part of all runs.
        events: all events.
        phases: the phases.
        problems: the problem of each mechanism of the phases.
        code: the `Result` as far as it is known before the run.
        drift_tol: the violation of the constraints that ends the run.
        xp: jax.numpy, or NumPy.
    """
    first, scales = problems[0], problems[0].textbook.scales
    units = MemberUnits(first.rate, scales.length, scales.rate, scales.mass, drift_tol)
    of_run = [xp.asarray(x, float)[None] for x in (first.ts, first.q, first.v, _stack([code], xp), _stack(units, xp))]
    of_phases = [phase_arrays(p, x, xp) for p, x in zip(problems, plan.phases, strict=True)]
    of_events = (_concrete_numbers if xp is np else _numbers)(xp, phases, *events)
    return [*of_run, *of_events, *(x for phase in of_phases for x in phase)]


def _stack(numbers: Sequence[Any], xp: ModuleType) -> Any:
    return xp.stack([xp.asarray(x, float) for x in numbers])


def _numbers(xp: ModuleType, phases: Phases, *events: Event) -> list[Any]:
    """Return the numbers of conditions, actions, masses and joints, which depend neither on states nor on choices."""
    of_conditions, of_joints = (
        xp.concatenate([*(xp.ravel(xp.asarray(x, float)) for x in numbers), xp.zeros(0)])
        for numbers in (condition_numbers(events), joint_numbers(phases))
    )
    inverse_mass = inverse_mass_of(phases.mechanisms[SCENE], xp)
    of_actions = numbers_of_actions([e.action for e in events], xp)
    return [x[None] for x in (of_conditions, of_actions, inverse_mass, of_joints)]


_concrete_numbers = cached_by_identity(_numbers)
