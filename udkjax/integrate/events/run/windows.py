"""Windows of runs with events: one member at a time is integrated over a window, whose nodes tell what happens first.

A window contains output times, and nodes at which conditions and the forces of contacts at rest are evaluated (`detection`). If
the nodes are too coarse for a condition, the window is repeated with an eighth of its length. If a condition crosses zero between
two nodes, that interval becomes the next window. This is repeated until the zero of the cubic is exact up to rounding, where the
last window ends, or until the interval is as short as possible, as where a condition jumps.

A long step may have passed a change of the motion that the shorter steps of a last window resolve. If the condition is not zero
at its end, the run goes on where zero is still ahead; otherwise the window is repeated with another end.

Windows are advanced by JAX for runs in plain form, and by NumPy and machine code where machine code alone cannot resolve a
condition.
"""

from types import ModuleType
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.instant.runs import RunState
from udkjax.integrate.events.law.crossings import NO_EVENT, ZERO_TOL, zero_of
from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.integrate.events.run.detection import NODES, WINDOW_INTERVALS, Nodes, detect
from udkjax.integrate.outcome import failure
from udkjax.integrate.problem import IntegratorOutput
from udkjax.integrate.solution import Result
from udkjax.native.module.steps import SMALLEST_STEP, Status
from udkjax.native.watching.conditions import RESOLUTION

MOST_OUTPUTS = 32  # output times of a window


class Window(NamedTuple):
    """The next window of a run, and facts about the windows before it."""

    reach: Float[Any, ""]  # its largest length (s)
    event: Int[Any, ""]  # the condition whose crossing is being located, or `NO_EVENT`
    high: Float[Any, ""]  # the end of the interval that contains this crossing (s)
    lands: Bool[Any, ""]  # whether the crossing is at that end
    last: Float[Any, ""]  # the time of the last event (s)
    unresolved: Float[Any, "2E"]  # time (s) from which a condition varies too quickly to be resolved; else infinite


class WindowUnits(NamedTuple):
    """Units and tolerances that windows need, for one member."""

    rate: Any  # characteristic rate of the system and the run (1/s)
    scene_rate: Any  # (1/s)
    force: Any  # characteristic force (N)
    smallest: Any  # the smallest step (s)
    atol: Any  # the absolute tolerance


class WatchedConditions(NamedTuple):
    """The conditions and forces (2E) that a window watches, with their last sides of zero and the scales of the conditions."""

    sides: Int[Any, "2E"]  # the last side of zero of each condition, and of each force
    scale: Float[Any, "E"]
    watched: Bool[Any, "2E"]  # mask of those that are watched


class WindowMotion(Protocol):
    """The interface between windows and the motion of one member.

    Attributes:
        xp: jax.numpy, or NumPy.
        plan: the phases and events.
        ts: the output times (s).
        units: units and tolerances of the run.
        projects: whether states are projected after each step.
        breakpoints: times (s) where the motion is not smooth; None if there are none.
    """

    @property
    def xp(self) -> ModuleType: ...
    @property
    def plan(self) -> EventPlan: ...
    @property
    def ts(self) -> Float[Any, "T"]: ...
    @property
    def units(self) -> WindowUnits: ...
    @property
    def projects(self) -> bool: ...
    @property
    def breakpoints(self) -> Float[Any, "k"] | None: ...

    def size(self, v: Float[Any, "n"]) -> Float[Any, ""]:
        """Return the largest component of a change of coordinates, in units of the scene."""
        ...

    def flow(self, times: Float[Any, "T"], state: RunState) -> IntegratorOutput:
        """Integrate from a state over times, which begin with the time of the state."""
        ...

    def watch(self, state: RunState, t: Float[Any, "G"], q: Float[Any, "G n"], v: Float[Any, "G n"]) -> tuple[Any, ...]:
        """Return conditions, their rates, and forces, each (G, E), at times in the phase of a state."""
        ...


class WindowEnd(NamedTuple):
    """The end of a window, or of the part of it in which all crossings are certain; its outputs, and the next window."""

    t: Float[Any, ""]
    q: Float[Any, "n"]
    v: Float[Any, "n"]
    event: Int[Any, ""]  # the condition that crosses zero here, or `NO_EVENT`
    sides: Int[Any, "2E"]
    goes_on: Bool[Any, ""]
    code: Int[Any, ""]  # the `Result` if the run does not go on
    undefined: Bool[Any, "E"]  # the conditions whose NaN ends the run
    totals: Int[Any, "5"]  # as in `EventRun`
    rows: Int[Any, "k"]  # the indices of the outputs; beyond the last one for times that were not reached
    outputs: tuple[Float[Any, "k n"], Float[Any, "k n"]]  # q and v of these outputs
    window: Window  # the next window


def first_window(ts: Float[Any, "T"], t: Any, E: int, xp: ModuleType) -> Window:
    """Return the window in which a run goes on at the time t."""
    return Window(ts[-1] - ts[0], xp.asarray(NO_EVENT), t, xp.asarray(False), t, xp.full(2 * E, xp.inf))


def advance_window(motion: WindowMotion, window: Window, state: RunState, given: WatchedConditions) -> WindowEnd:
    """Integrate over a window: to its end, to the last node before a certain or possible crossing, or to the crossing itself."""
    xp, ts, units, plan, t = motion.xp, motion.ts, motion.units, motion.plan, state.t
    E, T, smallest = plan.count, len(ts), units.smallest
    output = xp.searchsorted(ts, t) + np.arange(min(MOST_OUTPUTS, T))
    requested = ts[xp.minimum(output, T - 1)]
    speed = xp.maximum(units.scene_rate, motion.size(state.v))
    full = xp.where(speed > 0, WINDOW_INTERVALS / RESOLUTION.per_time / xp.where(speed > 0, speed, 1.0), ts[-1] - ts[0])
    zooms = window.event != NO_EVENT
    end = xp.where(zooms, window.high, t + xp.minimum(full, window.reach))
    end = xp.minimum(end, xp.minimum(requested[-1], ts[-1]))
    if (breakpoints := motion.breakpoints) is not None:
        # The cubics of a window belong to one piece of the motion.
        end = xp.min(xp.where(breakpoints > t + 2 * smallest, breakpoints, xp.inf), initial=end)
    nodes = xp.append((t + (end - t) * NODES)[:-1], end)
    times = xp.sort(xp.concatenate([nodes, xp.clip(requested, t, end)]))
    length = end - t
    # Windows too short to integrate; under vmap, windows of members at another stage have length zero.
    is_short = length <= 2 * smallest
    solver_times = xp.where(is_short, t + 100 * smallest * np.arange(len(times)), times)
    raw = motion.flow(solver_times, state)
    is_extrapolated = (is_short | (times <= t))[:, None]
    q = xp.where(is_extrapolated, state.q + (times - t)[:, None] * state.v, raw.q)
    v = xp.where(is_extrapolated, state.v, raw.v)
    lands = window.lands & (np.arange(2 * E) == window.event)
    good = xp.cumsum(~(is_extrapolated[:, 0] | (raw.reached & (np.arange(len(times)) < raw.first_drifted)))) == 0

    at = xp.searchsorted(times, nodes)
    g, g_dot, forces = motion.watch(state, nodes, q[at], v[at])
    hit = detect(
        Nodes(nodes, xp.concatenate([g, forces], axis=1), xp.concatenate([g_dot, 0 * g_dot], axis=1), good[at]),
        has_rates=np.append(~np.array(plan.by_velocity), np.zeros(E, bool)),
        direction=plan.both_directions,
        sides=given.sides,
        scale=xp.append(given.scale, xp.zeros(E) + units.force),
        zero=xp.append(zero_of(plan.slides, units.atol, xp), xp.full(E, ZERO_TOL)),
        located=window.event,
        watched=given.watched & ~lands,
        is_short=length * units.rate <= RESOLUTION.short,
        late=RESOLUTION.late / units.rate,
        unresolved=xp.isfinite(window.unresolved) | zooms,  # an interval that is being refined was fine enough
        xp=xp,
    )
    place, width = hit.place, nodes[hit.next_node] - nodes[hit.place]
    root = nodes[place] + hit.root * width
    is_shortest = length <= xp.maximum(RESOLUTION.finest / units.rate, 100 * len(times) * smallest)
    undefined = hit.is_coarse & is_shortest & hit.undefined[:E]
    stays = hit.is_found | hit.is_coarse
    fails = (~xp.all(good) & ~stays) | xp.any(undefined)
    jumps, reaches = width <= 2 / SMALLEST_STEP * smallest, zooms & ~stays & ~fails & (end == window.high)
    arrives = reaches & window.lands
    change, is_ahead = _change_to_zero(plan, given, window.event, g[-1], g_dot[-1], xp)
    is_off = arrives & (change != 0)
    returns = is_off & ~is_ahead & (change < 0) & (end + change > t + 100 * len(times) * smallest)
    # In a very short window the values of a condition may differ by rounding from those by which it crossed zero.
    is_lost = reaches & ~window.lands & (length * units.rate <= RESOLUTION.late)
    has_landed = (arrives & ~returns & ~(is_off & is_ahead)) | is_lost
    is_located = has_landed | (hit.is_found & jumps)

    # The node at which the next window begins: the last one before a crossing or an unclear interval, the first one if the motion
    # goes back beyond zero, otherwise the end.
    node = xp.where(stays, xp.where(hit.is_coarse, hit.last_sure, place), xp.where(returns, 0, len(nodes) - 1))
    last_good = xp.where(xp.all(good), len(times) - 1, xp.maximum(xp.sum(good) - 1, 0))
    # Where a condition jumps, the event happens at the first time after the jump.
    k = xp.where(stays | returns, at[xp.where(is_located, hit.next_node, node)], last_good)
    t_new = times[k]
    rows = xp.where((output < T) & (requested < t_new), output, T)
    of_outputs = xp.searchsorted(times, xp.clip(requested, t, end))
    code = xp.where(xp.any(undefined), Result.undefined_condition, _failure(raw, xp))
    reach = xp.where(hit.is_coarse, length / RESOLUTION.finer, xp.where(zooms | hit.is_found, window.reach, 2 * window.reach))
    since = t_new - window.last
    is_unresolved = hit.is_coarse & is_shortest & hit.coarse & ~hit.undefined
    projections = motion.projects * (raw.tried + 2 * len(times) - 2)
    return WindowEnd(
        t=t_new,
        q=q[k],
        v=v[k],
        event=xp.where(has_landed, window.event, xp.where(is_located, hit.event, NO_EVENT)),
        sides=xp.where(lands, given.sides, hit.sides[node]),
        goes_on=~fails,
        code=xp.where(fails, code, Result.successful),
        undefined=undefined,
        totals=xp.stack([raw.tried, raw.accepted, raw.evaluations, projections, raw.implicit]),
        rows=rows,
        outputs=(q[of_outputs], v[of_outputs]),
        window=Window(
            reach=xp.where(is_located & (since > 0), xp.minimum(reach, 2 * since), reach),
            event=xp.where(
                hit.is_found & ~is_located, hit.event, xp.where((end < window.high) | returns, window.event, NO_EVENT)
            ),
            high=xp.where(
                hit.is_found, xp.where(hit.is_exact, root, nodes[hit.next_node]), window.high + xp.where(returns, change, 0.0)
            ),
            lands=xp.where(hit.is_found, hit.is_exact, window.lands),
            last=xp.where(is_located, t_new, window.last),
            unresolved=xp.where(is_unresolved & xp.isinf(window.unresolved), t_new, window.unresolved),
        ),
    )


def _change_to_zero(
    plan: EventPlan, given: WatchedConditions, event: Int[Any, ""], g: Float[Any, "E"], rate: Float[Any, "E"], xp: ModuleType
) -> tuple[Float[Any, ""], Bool[Any, ""]]:
    """Return the time (s) from a state to the zero of an event's condition, and whether the zero is still ahead.

    The time is zero if the condition is zero, and for forces and conditions of velocities, whose rates are not known.
    """
    k = xp.clip(event, 0, len(g) - 1)
    has_rate = (event == k) & ~xp.asarray(plan.by_velocity)[k] & (rate[k] != 0)
    side, is_zero = given.sides[k], xp.abs(g[k]) <= ZERO_TOL * given.scale[k]
    change = xp.where(has_rate & ~is_zero & (side != 0), -g[k] / xp.where(has_rate, rate[k], 1.0), 0.0)
    return change, g[k] * side > 0


def _failure(raw: IntegratorOutput, xp: ModuleType) -> Int[Any, ""]:
    return xp.where(raw.status == Status.DONE, Result.drift, failure(raw.status, xp))
