"""A mechanism with events as a hybrid system, by JAX: a flow in each phase, and conditions along it."""

from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.equations.laws.formulations import Formulation
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.programs.scales import Scales
from udkjax.equations.states.quantities import equations_of
from udkjax.equations.terms.loads import mass_of
from udkjax.integrate import native_engine
from udkjax.integrate.compiled_mechanism import CompiledMechanism, RunPlan
from udkjax.integrate.derivatives import differentiable
from udkjax.integrate.events.instant.impacts import contact_rows
from udkjax.integrate.events.instant.runs import RunState
from udkjax.integrate.events.instant.system import StateValues
from udkjax.integrate.events.law.event import Event
from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.integrate.events.law.kinks import renewed_sides, with_sides
from udkjax.integrate.events.law.phases import SCENE, SWITCHED, Added, Phases
from udkjax.integrate.events.law.sticking_joints import forces_of
from udkjax.integrate.events.run.condition_program import conditions_of
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.pinv import SVD, Pseudoinverse
from udkjax.transforms.gradients import stop_gradients

T = TypeVar("T")
Condition = Callable[[Float[Array, ""], Float[Array, "n"], Float[Array, "n"]], Float[Array, "k"]]  # of t, q and v


class Hybrid(eqx.Module):
    """A run with events as a pytree: the phases of the mechanism, events, output times, initial state and tolerances."""

    phases: Phases
    events: tuple[Event, ...]
    ts: Float[Array, "T"]  # output times (s)
    sides: Float[Array, "S"]  # sides of the comparisons in forces, at the start
    q: Float[Array, "n"]  # initial positions
    v: Float[Array, "n"]  # initial velocities
    code: Int[Array, ""]  # a `Result` that is known before the run
    drift_tol: Float[Array, ""]
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    smallest: Float[Array, ""]  # smallest step (s)
    h: Float[Array, ""] | None  # the first step (s)
    length: Float[Array, ""] | None
    rate: Float[Array, ""]  # characteristic rate of the system and the run (1/s)
    method: Pseudoinverse
    baumgarte: Baumgarte | None
    formulation: Formulation | None
    plan: EventPlan = eqx.field(static=True)
    plans: tuple[RunPlan, ...] = eqx.field(static=True)  # for each mechanism
    replays: bool = eqx.field(static=True, default=False)  # whether only derivatives are computed

    # --- events

    @property
    def count(self) -> int:
        """The number E of events."""
        return len(self.events)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the bodies; empty for a system."""
        return self.phases.mechanisms[SCENE].body_names

    @property
    def projects(self) -> bool:
        """True if states are projected after each step."""
        return any(plan.projected for plan in self.plans)

    @property
    def scales(self) -> Scales:
        """The characteristic length, time and mass of the scene."""
        analysis, model = self.phases.analyses[SCENE], self.phases.mechanisms[SCENE]
        return equations_of(model).scales if analysis is None else analysis.scales  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def force(self) -> Float[Array, ""]:
        """The characteristic force (N) of the scene and the run, the scale of contact forces."""
        return self.scales.mass * self.scales.length * self.rate**2

    # --- the flow

    def first_state(self) -> RunState:
        """Return the state in which the run begins."""
        return RunState(self.ts[0], self.q, self.v, jnp.array(self.plan.first), (*self.phases.first_added(), self.sides))

    def problem(self, which: int, ts: Float[Array, "T"], start: RunState) -> Problem:
        """Return the problem to integrate the mechanism `which`, SCENE or SWITCHED, over the times `ts` from a state."""
        _, q, v, phase, added = start
        mechanism, analysis = self.phases.mechanism(which, phase, added), self.phases.analyses[which]
        equations = equations_of(mechanism, self.method, self.baumgarte, self.formulation, analysis)
        compiled = CompiledMechanism(equations, mechanism.breakpoints, self.plans[which])
        switches = self.plan.switches
        may_be_independent, on = (switches.independent(phase, jnp), switches.on(phase)) if which == SWITCHED else (None, None)
        return Problem(
            compiled=compiled,
            ts=ts,
            q=q,
            v=v,
            rtol=self.rtol,
            atol=self.atol,
            smallest=self.smallest,
            h=self.h,
            length=self.length,
            rate=self.rate,
            max_steps=self.plan.max_steps,
            drift_tol=self.drift_tol,
            marks=native_engine.mark_rows(compiled, ts[0], q, v, self.length, self.rate, among=may_be_independent, on=on),
        )

    def flow(self, ts: Float[Array, "T"], state: RunState, derivatives: bool) -> IntegratorOutput:
        """Integrate from a state over the times `ts`, the first of which is that of the state; with `derivatives` or without."""

        def of_mechanism(which: int, ts: Array, state: RunState) -> IntegratorOutput:
            problem = self.problem(which, ts, state)
            if derivatives:  # the run is known to continue, whatever its drift
                return differentiable(replace(problem, drift_tol=jnp.inf), has_fixed_times=True)
            if not self.plans[which].is_native:
                return differentiable(problem)
            return native_engine.integrate(problem)

        return self.in_phase(state.phase, of_mechanism, ts, state, integrates=True)

    def in_phase(
        self,
        phase: Bool[Array, "C"],
        function: Callable[..., T],
        *arguments: object,
        is_free: bool = False,
        integrates: bool = False,
    ) -> T:
        """Return `function(which, *arguments)`, with the mechanism of a phase, SCENE or SWITCHED, as `which`.

        Args:
            phase: the phase.
            function: the function to call.
            *arguments: its other arguments, which have arrays.
            is_free: whether the phase is known to have no contact at rest.
            integrates: whether the function integrates, which takes less time with the mechanism of the scene. In a replay where
                all switches are contacts and locks, other functions are traced once only: all switches are off in the first
                phase, so that the mechanism SWITCHED serves all phases.
        """
        if len(self.phases.mechanisms) == 1 or (is_free and self.plan.has_only_contacts):
            return function(SCENE, *arguments)
        if self.replays and not integrates and self.plan.has_only_contacts:
            return function(SWITCHED, *arguments)
        branches = [lambda *x, which=which: function(which, *x) for which in (SWITCHED, SCENE)]
        return jax.lax.switch(self.plan.is_first(phase).astype(int), branches, *arguments)

    def textbook(self, which: int, at: RunState) -> Any:
        """Return the equations of the mechanism `which`, SCENE or SWITCHED, in the phase of a state; SVD solves them."""
        mechanism = self.phases.mechanism(which, at.phase, at.joints)
        return equations_of(mechanism, SVD(), self.baumgarte, analysis=self.phases.analyses[which])

    # --- conditions

    def conditions(self, added: Added) -> Condition:
        """Return the conditions of all events as a function of t, q and v; the last entry of `added` has all sides."""
        events = with_sides(self.events, added[-1], self.phases.held)
        return lambda t, q, v: conditions_of(events, self.names, t, q, v)

    def conditions_and_rates(self, added: Added) -> Callable[..., tuple[Float[Array, "E"], Float[Array, "E"]]]:
        """Return a function of t, q and v for the conditions and their rates, right for conditions of positions alone."""
        conditions = self.conditions(added)
        return lambda t, q, v: rate_along(conditions, t, q, v, jnp.zeros_like(v))

    def turned(self, at: RunState, k: Int[Array, ""]) -> Float[Array, "S"]:
        """Return all sides (S,) after event k at a state."""
        factor, shift = (jnp.asarray(x)[k] for x in self.plan.side_changes)
        sides = at.joints[-1] * factor + shift
        return stop_gradients(renewed_sides(self.phases.held, self.phases.mechanisms[SCENE], at.t, at.q, at.v, sides))

    def values(self, at: RunState, is_free: bool = False, is_directed: bool = False, has_forces: bool = False) -> StateValues:
        """Return the conditions and their derivatives at a state; for the arguments see `System.look`."""
        t, q, v, _, added = at
        conditions = self.conditions(added)
        by_t, by_q, by_v = jax.jacfwd(conditions, (0, 1, 2))(t, q, v)

        def of_mechanism(which: int, normals: Array, at: RunState) -> tuple[Array, Array, Array]:
            (t, q, v, *_), equations = at, self.textbook(which, at)
            mobilities = directions = jnp.zeros_like(normals)
            if is_free and not self.plan.has_bodies:
                mobilities, directions = jax.vmap(lambda normal: equations.unit_impulse_response(t, q, v, normal))(normals)
            elif is_free or is_directed:
                directions = contact_rows(equations, t, q, normals).directions
            return equations.accelerations(t, q, v), mobilities, directions

        normals = jnp.where(np.array(self.plan.slides)[:, None], by_v, by_q)
        a, mobilities, directions = self.in_phase(at.phase, of_mechanism, normals, at, is_free=is_free)
        g, rate = rate_along(conditions, t, q, v, a)
        rates = lambda t, q, v: self.conditions_and_rates(added)(t, q, v)[1]  # noqa: E731
        rate_2 = jnp.where(np.array(self.plan.by_velocity), 0.0, rate_along(rates, t, q, v, a)[1])
        forces = self.forces(at) if has_forces else jnp.ones(self.count)
        return StateValues(a, g, rate, rate_2, by_t, by_q, by_v, directions, mobilities, forces, jnp.array(True))

    def accelerations(self, at: RunState) -> Float[Array, "n"]:
        """Return the accelerations in a state."""
        return self.in_phase(at.phase, lambda which, x: self.textbook(which, x).accelerations(*x[:3]), at)

    def second_rates(self, at: RunState) -> tuple[Float[Array, "n"], Float[Array, "E"]]:
        """Return the rate of the accelerations along the motion, and the second rates of all conditions, at a state."""
        t, q, v, _, added = at
        conditions = self.conditions(added)

        def accelerations(t: Array, q: Array, v: Array) -> Array:
            return self.accelerations(at._replace(t=t, q=q, v=v))

        def rates(t: Array, q: Array, v: Array) -> tuple[Array, Array]:
            a = accelerations(t, q, v)
            return a, rate_along(conditions, t, q, v, a)[1]

        return jax.jvp(rates, (t, q, v), (jnp.ones(()), v, accelerations(t, q, v)))[1]

    def forces(self, at: RunState) -> Float[Array, "E"]:
        """Return the forces of contacts at rest, and the reserves of joints that stick, in a state; 1 for all other events."""
        switches, ones = self.plan.switches, jnp.ones(self.count)

        def of_mechanism(which: int, at: RunState) -> Array:
            if max(switches.rows, default=-1) < 0 or (which == SCENE and not self.plan.has_sticking_joints):
                return ones
            multipliers = self.textbook(which, at).multipliers(*at[:3])
            forces = forces_of(self.events, switches.rows, switches.joint_rows, multipliers)
            counts = self.plan.held(at.phase, jnp) | np.array(self.plan.slides)
            return jnp.where(counts, jnp.stack([jnp.asarray(forces.get(k, 1.0), float) for k in range(self.count)]), ones)

        return self.in_phase(at.phase, of_mechanism, at)


def rate_along(f: Condition, t: Array, q: Array, v: Array, a: Array) -> tuple[Float[Array, "k"], Float[Array, "k"]]:
    """Return f(t, q, v) and its rate along the motion."""
    return jax.jvp(f, (t, q, v), (jnp.ones(()), v, a))


def inverse_mass_of(model: Any, xp: ModuleType) -> Float[Any, "n"]:
    """Return one over the mass of each coordinate of a mechanism; ones for a system, whose M is a function."""
    return 1 / mass_of(model, xp) if model.has_bodies else xp.ones(model.coordinate_count)
