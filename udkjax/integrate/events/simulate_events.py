"""Simulate with events: prepare the hybrid system of a mechanism, run it, and return the solution."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.arrays import is_within_jit, make_module, number, put_arrays
from udkjax.complementarity.stick_or_slip import SIDES
from udkjax.devices import computing_on_host, on_host
from udkjax.equations.friction.directed_friction import DirectedFriction
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.rows.analysis import Analysis
from udkjax.integrate.compiled_mechanism import compile_concrete, compile_mechanism
from udkjax.integrate.events.instant.changes import scene_changes
from udkjax.integrate.events.instant.listing import listing, names_of_events
from udkjax.integrate.events.instant.runs import EventRun
from udkjax.integrate.events.law.event import (
    Event,
    Events,
    EventsLike,
    ExpandsToEvents,
    expand_events,
    has_usable_numbers,
    listed_events,
)
from udkjax.integrate.events.law.event_plan import event_plan
from udkjax.integrate.events.law.kinks import FREE_SIDE, renewed_sides, with_held_forces
from udkjax.integrate.events.law.phases import SCENE, Phases, events_and_phases
from udkjax.integrate.events.run.condition_program import watched_conditions, with_cached_functions
from udkjax.integrate.events.run.host_run import HostRun, concrete_plan, event_arrays
from udkjax.integrate.events.run.hybrid import Hybrid
from udkjax.integrate.events.run.replay import run_events
from udkjax.integrate.prepare import Choices, prepare_run
from udkjax.integrate.problem import Problem
from udkjax.integrate.projection import violation
from udkjax.integrate.solution import Result, Solution
from udkjax.integrate.time_derivatives import moved
from udkjax.native.watching.conditions import Conditions
from udkjax.positions.assembling.assembly import Closure, State
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity, is_concrete
from udkjax.transforms.gradients import stop_gradients
from udkjax.wording import quote

UNRESOLVED_WARNING = "conditions of events vary too quickly for the shortest window, 1e-9 T; crossings may be missed: {}"


class Given(NamedTuple):
    """The arguments of a run with events: the phases of its mechanism, the events, the initial state and the choices."""

    phases: Phases
    events: tuple[Event, ...]  # the user's events, then the kinks of forces
    ts: Float[Array, "T"]
    state: State | None
    closure: Closure | None  # the assembled guess, instead of a state
    choices: Choices
    max_events: int  # largest number of listed events
    conditions: Conditions | None  # conditions of all events, for machine code; None if it cannot run them
    moves: bool  # whether times may have derivatives, which only runs without events of the user have


def simulate_events(
    mechanism: Any,
    events: EventsLike | None,
    analysis: Analysis | None,
    ts: Any,
    state: State | None,
    closure: Closure | None,
    choices: Choices,
    max_events: int,
    all_concrete: bool,
) -> tuple[Solution, tuple[Any, Any]]:
    """Run a mechanism with events; return the solution, and the time and the state (q, v) at the end of the run.

    Args:
        mechanism: the scene, or a system of traced functions.
        events: the events, as for `simulate`; None: only kinks of forces and joints that stick are located.
        analysis: the `Analysis` of the mechanism; None for a system.
        ts: the output times (s).
        state: the initial state; None: the state of `closure`.
        closure: the assembled initial guess.
        choices: the other arguments of `simulate`.
        max_events: the largest number of events.
        all_concrete: whether no number of the other arguments, except the events, is traced.

    Raises:
        ValueError: the events do not fit the mechanism, or machine code was requested but cannot run the system.
    """
    listed, phases = _prepare(mechanism, events, analysis)
    runs_at_once = all_concrete and not is_within_jit() and is_concrete(phases, *listed)
    conditions = None if choices.take_diffrax else watched_conditions(listed, phases.mechanisms[SCENE])
    if conditions is not None:
        listed = with_cached_functions(listed, conditions)
    ts = ts if isinstance(ts, Tracer) else np.asarray(ts, float)
    moves = isinstance(ts, Tracer) and events is None
    given = Given(phases, listed, ts, state, closure, choices, max_events, conditions, moves)
    result = _run_at_once(given) if runs_at_once else None
    if result is None:
        given = given._replace(ts=number(ts), choices=choices.arrays())
        result = (_run if is_within_jit() else _compiled_run if choices.take_diffrax else _deferred_run)(given)
    found, reasons = result
    end = found.time, found.end.ravel()
    if not runs_at_once:
        return (_solution if is_within_jit() else _compiled_solution)(mechanism, given, found, reasons), end
    found = EventRun(*map(np.asarray, found))  # JAX would compile a program for each operation
    names = tuple(e.name for e in listed if e.action.turn is None)
    if np.isfinite(found.unresolved[: len(names)]).any():
        fast = [f"{quote(name)} from {t:.6g} s on" for name, t in zip(names, found.unresolved) if np.isfinite(t)]
        warnings.warn(UNRESOLVED_WARNING.format(", ".join(fast)), stacklevel=3)
    return put_arrays(_solution(mechanism, given, found, reasons, np)), end


def _run_at_once(given: Given) -> tuple[EventRun, tuple[str, ...]] | None:
    """Return the result of `_run` for concrete numbers; None if machine code alone cannot compute it."""
    if given.conditions is None or jax.config.jax_disable_jit:
        return None
    phases, choices = given.phases, given.choices
    compiled = [compile_concrete(m, a, *choices.of_mechanism) for m, a in zip(phases.mechanisms, phases.analyses, strict=True)]
    if not all(x.plan.is_native for x in compiled):
        return None
    run = prepare_run(compiled[0], phases.analyses[SCENE], given.ts, given.state, given.closure, choices, np)
    code = Result.successful if run.is_closed else Result.could_not_assemble
    code = Result.invalid_argument if not run.is_usable else Result.drift if run.has_missed_rows else code
    problems = [replace(run.problem, compiled=x) for x in compiled]
    settings = choices.max_steps, given.max_events
    plan = concrete_plan(phases, given.conditions, *settings, *given.events, *compiled)
    arrays = event_arrays(plan, given.events, phases, problems, np.asarray(code.value), choices.drift_tol, np)
    found = EventRun(*(x[0] for x in HostRun(plan, len(run.ts), len(run.problem.q))(*arrays)))
    return None if found.code < 0 else (found, tuple(x.plan.why_not_native for x in compiled))


Prepared = tuple[tuple[Event, ...], Phases]


def _prepare(mechanism: Any, events: EventsLike | None, analysis: Analysis | None) -> Prepared:
    """Return all events, with unique names, and the phases that they lead to; cached if all numbers are concrete."""
    listed = None if events is None else listed_events(events)
    if not is_concrete(mechanism, analysis, *(listed or ())):
        return _expand(mechanism, listed, analysis)
    return _expand_concrete(mechanism, analysis, listed is None, *(listed or ()))


@cached_by_identity
def _expand_concrete(mechanism: Any, analysis: Analysis | None, has_none: bool, *events: ExpandsToEvents) -> Prepared:
    with jax.ensure_compile_time_eval(), computing_on_host():
        return _expand(mechanism, None if has_none else events, analysis)


def _expand(mechanism: Any, events: Sequence[ExpandsToEvents] | None, analysis: Analysis | None) -> Prepared:
    found = () if events is None else expand_events(events, mechanism)
    directed, found, phases = events_and_phases(mechanism, found, analysis)
    smooth, held, kinks = with_held_forces(directed, SIDES * len(phases.sticking))
    return ((*found, *kinks), phases.with_kinks(smooth, held, len(kinks))) if held else (found, phases)


def _run(given: Given) -> tuple[EventRun, tuple[str, ...]]:
    """Run a mechanism with events, and return the result.

    Also return, for each mechanism of the phases, the reason why machine code cannot integrate it; "" if it can.
    """
    phases, events, ts, state, closure, choices, max_events, conditions, moves = given
    compiled = [compile_mechanism(m, a, *choices.of_mechanism) for m, a in zip(phases.mechanisms, phases.analyses, strict=True)]
    run = prepare_run(compiled[0], phases.analyses[SCENE], ts, state, closure, choices)
    problem, stabilization, ts = run.problem, choices.stabilization, run.problem.ts
    if moves:
        fixed = replace(problem, ts=stop_gradients(ts))
        q, v = moved(fixed, ts[0], problem.q, problem.v, fixed.ts[0] - ts[0])
        problem = replace(fixed, q=q, v=v)
    code = jnp.where(run.is_closed, Result.successful, Result.could_not_assemble)
    if closure is None:
        y = jnp.concatenate([problem.q, problem.v])
        is_open = ~(violation(problem.equations, problem.ts[0], y) <= choices.drift_tol)
        code = jnp.where(is_open, Result.initial_state_open, code)
    code = jnp.where(run.has_missed_rows, Result.drift, code)
    hybrid = Hybrid(
        phases=phases,
        events=events,
        sides=_first_sides(phases, problem),
        ts=problem.ts,
        q=problem.q,
        v=problem.v,
        code=jnp.where(run.is_usable & stop_gradients(has_usable_numbers(events)), code, Result.invalid_argument),
        drift_tol=choices.drift_tol,
        rtol=problem.rtol,
        atol=problem.atol,
        smallest=problem.smallest,
        h=problem.h,
        length=problem.length,
        rate=problem.rate,
        method=choices.method,
        baumgarte=stabilization if isinstance(stabilization, Baumgarte) else None,
        formulation=choices.formulation,
        plan=event_plan(phases, events, choices.max_steps, max_events),
        plans=tuple(x.plan for x in compiled),
    )
    if not all(x.plan.is_native for x in compiled):
        conditions = None
    found = run_events(hybrid, conditions)
    if moves:
        reached = jnp.isfinite(found.q[:, :1])
        q, v = (jnp.where(reached, y, 0.0) for y in (found.q, found.v))
        q, v = jax.vmap(partial(moved, problem))(problem.ts, q, v, ts - problem.ts)
        found = found._replace(**{name: jnp.where(reached, y, jnp.inf) for name, y in (("q", q), ("v", v))})
    return found, tuple(x.plan.why_not_native for x in compiled)


def _first_sides(phases: Phases, problem: Problem) -> Float[Array, "S"]:
    """Return all sides (kinks.py) at the start: of the comparisons in forces, and zeros for joints that may stick."""
    of_kinks = jnp.full(sum(held.smooth.count for held in phases.held), FREE_SIDE)
    free = jnp.concatenate([jnp.zeros(SIDES * len(phases.sticking)), of_kinks])
    at = problem.ts[0], problem.q, problem.v, free
    return stop_gradients(renewed_sides(phases.held, phases.mechanisms[SCENE], *at))


_compiled_run, _deferred_run = on_host(eqx.filter_jit(_run)), deferred(_run)


def _solution(mechanism: Any, given: Given, found: EventRun, reasons: tuple[str, ...], xp: ModuleType = jnp) -> Solution:
    """Return the solution of a run, with its listed events; if their number is traced (jax.numpy), padded to `max_events`."""
    names = names_of_events(given.events, given.phases)
    changes = scene_changes(found, given.ts, given.events, given.phases, xp)
    found, kinks, sticking = listing(found, given.ts, given.events, given.phases, given.max_events, xp)
    count = int(found.count) if xp is np else None
    choices, bodies = given.choices, (-1, *mechanism.state_shape())

    def trim(x: Array, padding: float = np.inf) -> Array:
        if count is not None:
            return x[:count]
        is_event = (jnp.arange(given.max_events) < found.count).reshape(-1, *[1] * (x.ndim - 1))
        return jnp.where(is_event, x, padding)

    event_q, event_v = trim(found.event_q), trim(found.event_v)
    events = make_module(
        Events,
        time=trim(found.event_time),
        index=trim(found.event_index, -1),
        q_before=event_q[:, 0].reshape(*bodies),
        v_before=event_v[:, 0].reshape(*bodies),
        q_after=event_q[:, 1].reshape(*bodies),
        v_after=event_v[:, 1].reshape(*bodies),
        count=found.count,
        unresolved=found.unresolved,
        undefined=found.undefined,
        names=names,
    )
    stats = {
        "steps": found.totals[0],
        "accepted": found.totals[1],
        "rejected": found.totals[0] - found.totals[1],
        "implicit": found.totals[4],
        "right_hand_sides": found.totals[2],
        "projections": found.totals[3],
        **({"events": found.count} if names else {}),
        **({} if kinks is None else {"kinks": kinks.count}),
    }
    why = next(filter(None, reasons), "")
    engine = f"{choices.integrator}: {why}" if all(reasons) else f"native, in some phases diffrax: {why}" if why else "native"
    settings = dict(choices.settings(why)) | {"engine": engine}
    settings |= {"max_events": str(given.max_events)} if names else {}
    sticking = _with_joints_held_by_drivers(mechanism, given, found, sticking, xp)
    with jax.debug_nans(False):  # NaN stands for outputs after the end of a run
        q, v = (xp.where(xp.isinf(x), xp.nan, x).reshape(len(x), *bodies[1:]) for x in (found.q, found.v))
    return make_module(
        Solution,
        ts=given.ts,
        q=q,
        v=v,
        code=found.code,
        time=found.time,
        stats=stats,
        rtol=choices.rtol,
        atol=choices.atol,
        bodies=mechanism.body_names,
        choices=tuple(settings.items()),
        events=events if names else None,
        unlocated=None if kinks is None else kinks.unlocated,
        sticking=sticking,
        scene_changes=changes,
        found_cause=None,
    )


def _with_joints_held_by_drivers(
    mechanism: Any, given: Given, found: EventRun, sticking: dict[str, Array] | None, xp: ModuleType
) -> dict[str, Array] | None:
    """Return masks of the output times at which joints stick, by joint, including those at which drivers hold joints at rest."""
    names = [x.name for x in given.phases.sticking if x.contact < 0]  # without rubbing contacts, which no driver holds
    analysis = given.phases.analyses[SCENE]
    if not sticking or not names or not mechanism.drivers or analysis is None:
        return sticking
    # Outputs after the end of a run are infinite or NaN: nothing sticks there.
    reached = xp.isfinite(found.q).all(axis=1, keepdims=True)
    q, v = (xp.where(reached, x, 0.0) for x in (found.q, found.v))
    held = reached & xp.asarray(DirectedFriction.put_in(mechanism).held_by_drivers(analysis, given.ts, q, v))
    return sticking | {name: sticking[name] | held[:, k] for k, name in enumerate(names)}


_compiled_solution = deferred(_solution)
