"""Runs with events in their plain form, by JAX: a single member, window by window (windows.py)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from udkjax.equations import udwadia_kalaba as uk
from udkjax.integrate.events.instant.loop import run_loop
from udkjax.integrate.events.instant.runs import Change, EventRun, MemberIndices, MemberRuns, RunState, results, runs_before
from udkjax.integrate.events.instant.system import StateValues
from udkjax.integrate.events.law.actions import numbers_of_actions
from udkjax.integrate.events.law.phases import SCENE, Added
from udkjax.integrate.events.run.hybrid import Hybrid, inverse_mass_of
from udkjax.integrate.events.run.windows import WatchedConditions, WindowUnits, advance_window, first_window
from udkjax.integrate.problem import IntegratorOutput
from udkjax.transforms.gradients import stop_gradients


def run_plain(hybrid: Hybrid) -> EventRun:
    """Run a system with events, window by window."""
    system, ts = PlainSystem(hybrid), hybrid.ts
    window = first_window(ts, ts[0], hybrid.count, jnp)
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
        self.inverse_mass = inverse_mass_of(hybrid.phases.mechanisms[SCENE], jnp)[None]

    def numbers_of_actions(self, members: MemberIndices) -> Float[Array, "1 N E"]:
        """Return the numbers of the actions."""
        return numbers_of_actions([e.action for e in self.hybrid.events], jnp)[None]

    def look(
        self, members: MemberIndices, at: RunState, is_free: bool = False, is_directed: bool = False, has_forces: bool = False
    ) -> StateValues:
        """Return the values of the conditions at a state; see `System.look`."""
        return jax.tree.map(lambda x: x[None], self.hybrid.values(without_member(at), is_free, is_directed, has_forces))

    def project(self, members: MemberIndices, at: RunState, is_free: bool = False) -> tuple[Array, Array, Array]:
        """Return q and v projected onto the constraints of the phase, and the largest remaining |Psi_dot_i| over its scale."""
        hybrid = self.hybrid
        # A replay without joints that move bodies as they are attached corrects nothing: one step has all derivatives.
        steps = 1 if hybrid.replays and hybrid.plan.has_only_contacts else 2

        def of_mechanism(which: int, at: RunState) -> tuple[Array, Array, Array]:
            # Velocities jump, so `equations.project`, whose derivatives hold for small corrections, cannot be used.
            equations = hybrid.textbook(which, at)
            q, v = uk.project(equations.mechanism, *at[:3], equations.method, equations.weights, steps)
            return q, v, stop_gradients(equations.violation_size(equations.violation(at.t, q, v)[1]))

        state = without_member(at)
        q, v, left = hybrid.in_phase(state.phase, of_mechanism, state, is_free=is_free)
        return q[None], v[None], left[None]

    def add_joints(self, members: MemberIndices, new: Bool[Array, "1 A"], q: Float[Array, "1 n"], joints: Added) -> Added:
        """Return `joints` in which the joints that are masked in `new` are added at the positions q."""
        phases, sides = self.hybrid.phases, joints[-1]
        added = (phases.joint_at(i, q[0]) for i in range(len(joints) - 1))
        chosen = (
            jax.tree.map(lambda x, y, chosen=chosen: jnp.where(chosen, x, y), x, y)
            for chosen, x, y in zip(new[0], added, joints[:-1], strict=True)
        )
        return (*chosen, sides)

    def sides(self, members: MemberIndices, joints: Added) -> Float[Array, "1 S"]:
        """Return all sides (1, S): the last entry of `joints`."""
        return joints[-1][None]

    def with_sides(self, members: MemberIndices, joints: Added, sides: Float[Array, "1 S"]) -> Added:
        """Return `joints` with other sides, their last entry."""
        return (*joints[:-1], sides[0])

    def turned(self, members: MemberIndices, k: Int[Array, "1"], at: RunState) -> Float[Array, "1 S"]:
        """Return all sides (1, S) after event k at a state."""
        return self.hybrid.turned(without_member(at), k[0])[None]

    def when(self, mask: Bool[Array, "1"], change: Change, runs: MemberRuns) -> MemberRuns:
        """Return the run after a change if the mask is true, else unchanged."""
        return jax.lax.cond(mask[0], lambda runs: change(runs, None), lambda runs: runs, runs)

    def repeat(self, change: Callable[[MemberRuns], MemberRuns], runs: MemberRuns) -> MemberRuns:
        """Return the run after changing it until it stops."""
        return jax.lax.while_loop(lambda runs: runs.running[0], change, runs)

    def advance(self, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
        """Return the run after its next window, or after the part of the window in which all crossings are certain."""
        watched = self.plan.watched(runs.phase, runs.carried, jnp)[0]
        state = without_member(runs.state(None))
        end = advance_window(
            PlainMotion(self.hybrid), runs.window, state, WatchedConditions(runs.sides[0], runs.scale[0], watched)
        )
        return runs._replace(
            t=end.t[None],
            q=end.q[None],
            v=end.v[None],
            event=end.event[None],
            sides=end.sides[None],
            running=end.goes_on[None],
            code=end.code[None],
            undefined=end.undefined[None],
            totals=runs.totals + end.totals,
            qs=runs.qs.at[0, end.rows].set(end.outputs[0], mode="drop"),
            vs=runs.vs.at[0, end.rows].set(end.outputs[1], mode="drop"),
            window=end.window,
        )


class PlainMotion:
    """The motion of one member by JAX, a `windows.WindowMotion`."""

    xp = jnp

    def __init__(self, hybrid: Hybrid):
        self.hybrid, self.plan, self.ts, self.projects = hybrid, hybrid.plan, hybrid.ts, hybrid.projects
        self.units = WindowUnits(hybrid.rate, hybrid.scales.rate, hybrid.force, hybrid.smallest, hybrid.atol)
        self.breakpoints = hybrid.phases.mechanisms[SCENE].breakpoints

    def size(self, v: Float[Array, "n"]) -> Float[Array, ""]:
        """Return the largest component of a change of coordinates, in units of the scene."""
        return self.hybrid.scales.size(v)

    def flow(self, times: Float[Array, "T"], state: RunState) -> IntegratorOutput:
        """Integrate from a state over times."""
        return self.hybrid.flow(times, state, derivatives=False)

    def watch(self, state: RunState, t: Float[Array, "G"], q: Float[Array, "G n"], v: Float[Array, "G n"]) -> tuple[Array, ...]:
        """Return conditions, their rates, and forces, each (G, E), at times in the phase of a state."""
        g, g_dot = jax.vmap(self.hybrid.conditions_and_rates(state.joints))(t, q, v)
        return g, g_dot, jax.vmap(lambda t, q, v: self.hybrid.forces(state._replace(t=t, q=q, v=v)))(t, q, v)
