"""Runs with events in their plain form, by JAX: a single member, window by window.

A window contains output times, and nodes at which conditions and the forces of contacts at rest are evaluated (`detection`). If
the nodes are too coarse for a condition, the window is repeated with an eighth of its length. If a condition crosses zero between
two nodes, that interval becomes the next window. This is repeated until the zero of the cubic is exact up to rounding, where the
last window ends, or until the interval is as short as possible, as where a condition jumps.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.equations import udwadia_kalaba as uk
from udkjax.integrate.events.crossings import NO_EVENT
from udkjax.integrate.events.detection import INTERVALS, NODES, Nodes, detect
from udkjax.integrate.events.hybrid import Hybrid, inverse_mass_of
from udkjax.integrate.events.impacts import Contacts
from udkjax.integrate.events.loop import run_loop
from udkjax.integrate.events.phases import SCENE, Added
from udkjax.integrate.events.runs import Change, EventRun, MemberIndices, MemberRuns, RunState, results, runs_before
from udkjax.integrate.events.system import StateValues
from udkjax.integrate.outcome import failure
from udkjax.integrate.problem import IntegratorOutput
from udkjax.integrate.solution import Result
from udkjax.native.base.steps import SMALLEST_STEP, Status
from udkjax.native.watching.conditions import RESOLUTION

MOST_OUTPUTS = 32  # output times of a window


class Window(NamedTuple):
    """The next window of a run, and the results of the windows before."""

    reach: Float[Array, ""]  # its largest length (s)
    event: Int[Array, ""]  # the condition whose crossing is being located, or `NO_EVENT`
    high: Float[Array, ""]  # the end of the interval that contains this crossing (s)
    lands: Bool[Array, ""]  # whether the crossing is at that end
    last: Float[Array, ""]  # the time of the last event (s)
    unresolved: Float[Array, "2E"]  # time (s) from which a condition varies too quickly to be resolved; else infinite


def run_plain(hybrid: Hybrid) -> EventRun:
    """Run a system with events, window by window."""
    system, ts, never = PlainSystem(hybrid), hybrid.ts, jnp.full(2 * hybrid.count, jnp.inf)
    window = Window(ts[-1] - ts[0], jnp.array(NO_EVENT), ts[0], jnp.array(False), ts[0], never)
    start = with_member(hybrid.first_state())
    runs = run_loop(system, runs_before(hybrid.plan, start, len(ts), hybrid.code[None], jnp, window))
    # A condition may vary quickly before it becomes NaN, but the result of the run already reports the NaN.
    unresolved = jnp.where(runs.undefined, jnp.inf, runs.window.unresolved[: hybrid.count])
    return jax.tree.map(lambda x: x[0], results(hybrid.plan, runs, ts[None], unresolved, jnp))


def with_member(state: RunState) -> RunState:
    """Return a state with a leading axis for its one member."""
    t, q, v, phase, joints = state
    return RunState(t[None], q[None], v[None], phase[None], joints)


def without_member(state: RunState) -> RunState:
    """Return a state without the leading axis of its one member."""
    t, q, v, phase, joints = state
    return RunState(t[0], q[0], v[0], phase[0], joints)


class PlainSystem:
    """The motion of one member by JAX, a `system.System`, with plain forms of all operations of machine code."""

    xp = jnp

    def __init__(self, hybrid: Hybrid):
        self.hybrid, self.plan = hybrid, hybrid.plan
        self.end, self.rate = hybrid.ts[-1:], hybrid.rate[None]
        self.coordinates = hybrid.scales.coordinates(len(hybrid.q))[None]
        self.inverse_mass = inverse_mass_of(hybrid.phases.mechanisms[SCENE], len(hybrid.q), jnp)[None]

    def contacts(self, members: MemberIndices) -> Contacts:
        """Return the contacts."""
        plan = self.plan
        e = [jnp.asarray(e.action.rebound, float) for e in self.hybrid.events]
        friction = [jnp.asarray(0.0 if e.action.friction is None else e.action.friction, float) for e in self.hybrid.events]
        numbers = jnp.stack(e)[None], jnp.stack(friction)[None], self.rate
        return Contacts(plan.impacts, plan.held_at_rest, plan.stops_at_rest, plan.tangents, *numbers)

    def look(
        self, members: MemberIndices, at: RunState, is_free: bool = False, is_directed: bool = False, has_forces: bool = False
    ) -> StateValues:
        """Evaluate a state."""
        return jax.tree.map(lambda x: x[None], self.hybrid.values(without_member(at), is_free, is_directed, has_forces))

    def project(self, members: MemberIndices, at: RunState, is_free: bool = False) -> tuple[Array, Array]:
        """Return positions and velocities that the phase of a state allows."""
        hybrid = self.hybrid
        # A replay without joints that move bodies as they are attached corrects nothing: one step has all derivatives.
        steps = 1 if hybrid.replays and hybrid.plan.has_only_contacts else 2

        def of_mechanism(which: int, at: RunState) -> tuple[Array, Array]:
            # Velocities jump, so `equations.project`, whose derivatives hold for small corrections, cannot be used.
            equations = hybrid.textbook(which, at)
            return uk.project(equations.mechanism, *at[:3], equations.method, equations.weights, steps)

        state = without_member(at)
        q, v = hybrid.in_phase(state.phase, of_mechanism, state, is_free=is_free)
        return q[None], v[None]

    def add_joints(self, members: MemberIndices, new: Bool[Array, "1 A"], q: Float[Array, "1 n"], joints: Added) -> Added:
        """Return the joints that events have added, with new ones, added at q."""
        phases, sides = self.hybrid.phases, joints[-1]
        added = (phases.joint_at(i, q[0]) for i in range(len(joints) - 1))
        chosen = (
            jax.tree.map(lambda x, y, chosen=chosen: jnp.where(chosen, x, y), x, y)
            for chosen, x, y in zip(new[0], added, joints[:-1], strict=True)
        )
        return (*chosen, sides)

    def sides(self, members: MemberIndices, joints: Added) -> Float[Array, "1 S"]:
        """Return the sides of comparisons."""
        return joints[-1][None]

    def with_sides(self, members: MemberIndices, joints: Added, sides: Float[Array, "1 S"]) -> Added:
        """Return the joints that events have added, with other sides."""
        return (*joints[:-1], sides[0])

    def turned(self, members: MemberIndices, k: Int[Array, "1"], at: RunState) -> Float[Array, "1 S"]:
        """Return the sides after event k."""
        return self.hybrid.turned(without_member(at), k[0])[None]

    def when(self, mask: Bool[Array, "1"], change: Change, runs: MemberRuns) -> MemberRuns:
        """Return the run with a change if the mask is true, else unchanged."""
        return jax.lax.cond(mask[0], lambda runs: change(runs, None), lambda runs: runs, runs)

    def repeat(self, change: Callable[[MemberRuns], MemberRuns], runs: MemberRuns) -> MemberRuns:
        """Return the run after changing it until it stops."""
        return jax.lax.while_loop(lambda runs: runs.running[0], change, runs)

    def advance(self, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
        """Integrate a window: to its end, to the last node before a certain or possible crossing, or to the crossing itself."""
        hybrid, ts, window, state = self.hybrid, self.hybrid.ts, runs.window, without_member(runs.state(None))
        t, E, T = state.t, hybrid.count, len(ts)
        output = jnp.searchsorted(ts, t) + np.arange(min(MOST_OUTPUTS, T))
        requested = ts[jnp.minimum(output, T - 1)]
        speed = jnp.maximum(hybrid.scales.rate, hybrid.scales.size(state.v))
        full = jnp.where(speed > 0, INTERVALS / RESOLUTION.per_time / jnp.where(speed > 0, speed, 1.0), ts[-1] - ts[0])
        zooms = window.event != NO_EVENT
        end = jnp.where(zooms, window.high, t + jnp.minimum(full, window.reach))
        end = jnp.minimum(end, jnp.minimum(requested[-1], ts[-1]))
        if (breakpoints := hybrid.phases.mechanisms[SCENE].breakpoints) is not None:
            # The cubics of a window belong to one piece of the motion.
            end = jnp.min(jnp.where(breakpoints > t + 2 * hybrid.smallest, breakpoints, jnp.inf), initial=end)
        nodes = (t + (end - t) * NODES).at[-1].set(end)
        times = jnp.sort(jnp.concatenate([nodes, jnp.clip(requested, t, end)]))
        length = end - t
        # Windows too short to integrate; under vmap, windows of members at another stage have length zero.
        is_short = length <= 2 * hybrid.smallest
        solver_times = jnp.where(is_short, t + 100 * hybrid.smallest * np.arange(len(times)), times)
        raw = hybrid.flow(solver_times, state, derivatives=False)
        is_extrapolated = (is_short | (times <= t))[:, None]
        q = jnp.where(is_extrapolated, state.q + (times - t)[:, None] * state.v, raw.q)
        v = jnp.where(is_extrapolated, state.v, raw.v)
        lands = window.lands & (np.arange(2 * E) == window.event)
        good = jnp.cumsum(~(is_extrapolated[:, 0] | (raw.reached & (np.arange(len(times)) < raw.lost)))) == 0

        at = jnp.searchsorted(times, nodes)
        g, g_dot = jax.vmap(hybrid.conditions_and_rates(state.joints))(nodes, q[at], v[at])
        forces = jax.vmap(lambda t, q, v: hybrid.forces(state._replace(t=t, q=q, v=v)))(nodes, q[at], v[at])
        hit = detect(
            Nodes(nodes, jnp.concatenate([g, forces], axis=1), jnp.concatenate([g_dot, 0 * g_dot], axis=1), good[at]),
            has_rates=np.append(~np.array(self.plan.by_velocity), np.zeros(E, bool)),
            direction=self.plan.both_directions,
            sides=runs.sides[0],
            scale=jnp.append(runs.scale[0], jnp.zeros(E) + hybrid.force),
            located=window.event,
            watched=self.plan.watched(runs.phase, runs.carried, jnp)[0] & ~lands,
            is_short=length * hybrid.rate <= RESOLUTION.short,
            unresolved=jnp.isfinite(window.unresolved) | zooms,  # an interval that is being refined was fine enough
        )
        place, width = hit.place, nodes[hit.behind] - nodes[hit.place]
        root = nodes[place] + hit.root * width
        is_shortest = length <= jnp.maximum(RESOLUTION.finest / hybrid.rate, 100 * len(times) * hybrid.smallest)
        undefined = hit.is_coarse & is_shortest & hit.undefined[:E]
        stays = hit.is_found | hit.is_coarse
        fails = (~jnp.all(good) & ~stays) | jnp.any(undefined)
        has_landed, jumps = (
            zooms & window.lands & ~stays & ~fails & (end == window.high),
            width <= 2 / SMALLEST_STEP * hybrid.smallest,
        )
        is_located = has_landed | (hit.is_found & jumps)

        node = jnp.where(stays, jnp.where(hit.is_coarse, hit.last_sure, place), len(nodes) - 1)
        last_good = jnp.where(jnp.all(good), len(times) - 1, jnp.maximum(jnp.sum(good) - 1, 0))
        # Where a condition jumps, the event happens at the first time after the jump.
        k = jnp.where(stays, at[jnp.where(is_located, hit.behind, node)], last_good)
        t_new = times[k]
        rows = jnp.where((output < T) & (requested < t_new), output, T)
        of_outputs = jnp.searchsorted(times, jnp.clip(requested, t, end))
        code = jnp.where(jnp.any(undefined), Result.undefined_condition, _failure(raw))
        reach = jnp.where(
            hit.is_coarse, length / RESOLUTION.finer, jnp.where(zooms | hit.is_found, window.reach, 2 * window.reach)
        )
        since = t_new - window.last
        is_unresolved = hit.is_coarse & is_shortest & hit.coarse & ~hit.undefined
        projections = hybrid.projects * (raw.tried + 2 * len(times) - 2)
        return runs._replace(
            t=t_new[None],
            q=q[k][None],
            v=v[k][None],
            event=jnp.where(has_landed, window.event, jnp.where(is_located, hit.event, NO_EVENT))[None],
            sides=jnp.where(lands, runs.sides[0], hit.sides[node])[None],
            running=~fails[None],
            code=jnp.where(fails, code, Result.successful)[None],
            undefined=undefined[None],
            totals=runs.totals + jnp.stack([raw.tried, raw.accepted, raw.evaluations, projections, raw.implicit]),
            qs=runs.qs.at[0, rows].set(q[of_outputs], mode="drop"),
            vs=runs.vs.at[0, rows].set(v[of_outputs], mode="drop"),
            window=Window(
                reach=jnp.where(is_located & (since > 0), jnp.minimum(reach, 2 * since), reach),
                event=jnp.where(hit.is_found & ~is_located, hit.event, jnp.where(end < window.high, window.event, NO_EVENT)),
                high=jnp.where(hit.is_found, jnp.where(hit.is_exact, root, nodes[hit.behind]), window.high),
                lands=jnp.where(hit.is_found, hit.is_exact, window.lands),
                last=jnp.where(is_located, t_new, window.last),
                unresolved=jnp.where(is_unresolved & jnp.isinf(window.unresolved), t_new, window.unresolved),
            ),
        )


def _failure(raw: IntegratorOutput) -> Int[Array, ""]:
    return jnp.where(raw.status == Status.DONE, Result.drift, failure(raw.status))
