"""A mechanism with events as a hybrid system: a flow in each phase, and conditions along it. `jumps` leads between phases."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.equations.formulations import Formulation
from udkjax.equations.quantities import equations_of
from udkjax.equations.scales import Scales
from udkjax.equations.textbook import TextbookEquations, prepare
from udkjax.equations.udwadia_kalaba import Baumgarte
from udkjax.integrate import native_engine
from udkjax.integrate.compiled_mechanism import CompiledMechanism, RunPlan
from udkjax.integrate.derivatives import differentiable
from udkjax.integrate.events.actions import Action, Impact, Log, Stop
from udkjax.integrate.events.condition_program import conditions_of
from udkjax.integrate.events.conditions import Gap, WithinLimit
from udkjax.integrate.events.crossings import ConditionValues
from udkjax.integrate.events.event import Event, sees_velocity
from udkjax.integrate.events.impacts import Contacts
from udkjax.integrate.events.phases import Phases
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.pinv import SVD, Pseudoinverse
from udkjax.scene.joints import Joint

T = TypeVar("T")
Added = tuple[Joint, ...]  # the joints that events add, with the numbers that they have now
Condition = Callable[[Float[Array, ""], Float[Array, "n"], Float[Array, "n"]], Float[Array, "k"]]  # of t, q and v


class RunState(NamedTuple):
    """The state of a run: time, coordinates, velocities, phase."""

    t: Float[Array, ""]
    q: Float[Array, "n"]
    v: Float[Array, "n"]
    phase: Int[Array, ""]
    added: Added


class Hybrid(eqx.Module):
    """All numbers and choices of a run with events, but its initial state and output times."""

    phases: Phases
    events: tuple[Event, ...]
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    smallest: Float[Array, ""]  # step (s)
    h: Float[Array, ""] | None  # the first step (s)
    length: Float[Array, ""] | None
    rate: Float[Array, ""]  # of the system and the run (1/s)
    method: Pseudoinverse
    baumgarte: Baumgarte | None
    formulation: Formulation | None
    max_steps: int = eqx.field(static=True)
    plans: tuple[RunPlan, ...] = eqx.field(static=True)  # of each phase

    # --- what is known of the events

    @property
    def count(self) -> int:
        """The number E of events."""
        return len(self.events)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the bodies."""
        return self.phases.mechanisms[0].body_names

    @property
    def projects(self) -> bool:
        """True if states are projected after each step."""
        return any(plan.projected for plan in self.plans)

    @property
    def scales(self) -> Scales:
        """The characteristic length, time and mass of the scene."""
        return self.phases.analyses[0].scales

    @property
    def has_usable_numbers(self) -> Bool[Array, ""]:
        """True if the numbers of events are what they must be: restitutions from 0 to 1, limits in order, contacts finite.

        Those that are known were checked before; those that were traced then are looked at here.
        """
        found, limits = jnp.array(True), {}
        for e in self.events:
            if isinstance(e.condition, WithinLimit):
                limits[e.name] = e.condition.limit
            if isinstance(e.action, Impact):
                found &= (e.action.restitution >= 0) & (e.action.restitution <= 1)
            if isinstance(e.condition, WithinLimit | Gap):
                found &= jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(e.condition)]))
            if isinstance(e.condition, Gap):
                found &= jnp.any(e.condition.normal != 0)
        both = (name[: -len(".lower")] for name in limits if name.endswith(".lower"))
        return reduce(jnp.logical_and, (limits[f"{n}.lower"] <= limits.get(f"{n}.upper", jnp.inf) for n in both), found)

    def mask(self, *actions: type[Action]) -> Bool[np.ndarray, "E"]:
        """Return a mask of the events with an action of these kinds."""
        return np.array([isinstance(e.action, actions) for e in self.events])

    @property
    def impacts(self) -> Bool[np.ndarray, "E"]:
        """True for each event that is an impact."""
        return self.mask(Impact)

    def rests(self, at_rest: str) -> Bool[np.ndarray, "E"]:
        """Return a mask of the events that are impacts with this choice for contacts at rest."""
        return np.array([isinstance(e.action, Impact) and e.action.at_rest == at_rest for e in self.events])

    @property
    def contacts(self) -> Contacts:
        """The contacts among the events."""
        e = [e.action.restitution if isinstance(e.action, Impact) else jnp.zeros(()) for e in self.events]
        return Contacts(self.impacts, self.rests("hold"), self.rests("stop"), jnp.stack(e), self.rate)

    @property
    def by_velocity(self) -> Bool[np.ndarray, "E"]:
        """True for each condition that depends on velocities."""
        return np.array([sees_velocity(e, self.phases.mechanisms[0]) for e in self.events])

    @property
    def directions(self) -> Int[np.ndarray, "2E"]:
        """The directions in which the zeros of conditions count, and those of contact forces: they fall below it."""
        return np.array([*(e.direction for e in self.events), *(-1 for _ in self.events)])

    def changes_motion(self, k: Int[Array, ""]) -> Bool[Array, ""]:
        """Tell whether event k, from E on a contact that lets go, does more than to take note or to stop."""
        return (k >= self.count) | jnp.array(~self.mask(Log, Stop))[k % self.count]

    def table(self, name: str) -> Int[Array, "phases E"]:
        """Return one of the tables of the phases."""
        return jnp.array(getattr(self.phases.tables, name))

    def is_held(self, phase: Int[Array, ""]) -> Bool[Array, "E"]:
        """Return a mask of the contacts at rest in a phase."""
        return self.table("held")[phase] >= 0

    def without_contacts(self, phase: Int[Array, ""]) -> Int[Array, ""]:
        """Return the phase that follows when all contacts at rest let go."""
        freed = self.table("freed")
        for k in np.flatnonzero(self.impacts):
            phase = freed[phase, k]
        return phase

    def with_contacts(self, phase: Int[Array, ""], held: Bool[Array, "E"]) -> Int[Array, ""]:
        """Return the phase that follows when contacts come to rest."""
        resting = self.table("resting")
        for k in np.flatnonzero(self.impacts):
            phase = jnp.where(held[k], resting[phase, k], phase)
        return phase

    # --- the flow

    def problem(self, phase: int, ts: Array, q: Array, v: Array, added: Added) -> Problem:
        """Return the system to integrate in a phase."""
        mechanism, analysis = self.phases.with_added(phase, added), self.phases.analyses[phase]
        equations = equations_of(mechanism, self.method, self.baumgarte, self.formulation, analysis)
        compiled = CompiledMechanism(equations, mechanism.breakpoints, self.plans[phase])
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
            max_steps=self.max_steps,
            marks=native_engine.mark_rows(compiled, ts[0], q, v, self.length, self.rate),
        )

    def flow(self, ts: Float[Array, "T"], state: RunState, derivatives: bool) -> IntegratorOutput:
        """Integrate from a state over the times `ts`, from its own on."""

        def of_phase(phase: int, ts: Array, q: Array, v: Array, added: Added) -> IntegratorOutput:
            problem = self.problem(phase, ts, q, v, added)
            if derivatives or not self.plans[phase].is_native:
                return differentiable(problem)
            return native_engine.integrate(problem)

        return self.in_phase(state.phase, of_phase, ts, state.q, state.v, state.added)

    @property
    def contact_free_phases(self) -> tuple[int, ...]:
        """The phases in which no contact is at rest."""
        return tuple(k for k, held in enumerate(self.phases.tables.held) if max(held) < 0)

    def in_phase(
        self, phase: Int[Array, ""], function: Callable[..., T], *arguments: object, among: Sequence[int] | None = None
    ) -> T:
        """Return `function(phase, *arguments)`, with the phase as a Python int for each branch.

        Args:
            phase: the phase.
            function: function to compute.
            *arguments: its arrays.
            among: the phases that there can be; None: all.
        """
        among = range(len(self.phases.mechanisms)) if among is None else among
        if len(among) == 1:
            return function(among[0], *arguments)
        branches = [lambda *x, k=k: function(k, *x) for k in among]
        return jax.lax.switch(jnp.searchsorted(np.array(among), phase), branches, *arguments)

    def textbook(self, phase: int, added: Added) -> TextbookEquations:
        """Return the equations of a phase, solved by SVD."""
        return prepare(self.phases.with_added(phase, added), SVD(), self.baumgarte, self.phases.analyses[phase])

    def accelerations(self, state: RunState, among: Sequence[int] | None = None) -> Float[Array, "n"]:
        """Return a in one state, whose phase is `among` some."""
        t, q, v, phase, added = state
        of_phase = lambda p, t, q, v, added: self.textbook(p, added).accelerations(t, q, v)  # noqa: E731
        return self.in_phase(phase, of_phase, t, q, v, added, among=among)

    # --- conditions

    def conditions(self, t: Float[Array, ""], q: Float[Array, "n"], v: Float[Array, "n"]) -> Float[Array, "E"]:
        """Return the conditions of all events."""
        return conditions_of(self.events, self.names, t, q, v)

    def conditions_and_rates(self, t: Array, q: Array, v: Array) -> tuple[Float[Array, "E"], Float[Array, "E"]]:
        """Return the conditions, and the rates of those that depend on positions alone."""
        return _with_rate(self.conditions, t, q, v, jnp.zeros_like(v))

    def second_rates(self, t: Array, q: Array, v: Array, a: Array) -> Float[Array, "E"]:
        """Return the second rates of the conditions that depend on positions alone, with accelerations a; 0 of others."""
        rates = lambda t, q, v: self.conditions_and_rates(t, q, v)[1]  # noqa: E731
        return jnp.where(self.by_velocity, 0.0, _with_rate(rates, t, q, v, a)[1])

    def values(self, state: RunState) -> ConditionValues:
        """Return conditions, contact forces, and their rates."""
        t, q, v, phase, added = state
        a, pressure = self.in_phase(phase, self._accelerations_and_pressures, t, q, v, added)
        g, g_dot = _with_rate(self.conditions, t, q, v, a)
        g_ddot = self.second_rates(t, q, v, a)
        by_q = jax.jacfwd(self.conditions, 1)(t, q, v)
        unit, zeros = self.scales.coordinates(len(q)), jnp.zeros(self.count)
        by_t = jax.jacfwd(self.conditions, 0)(jnp.asarray(t, float), q, v)
        size = jnp.max(jnp.abs(by_q) * jnp.maximum(unit, jnp.abs(q)), axis=1)
        size = jnp.maximum(size, jnp.abs(by_t) * jnp.maximum(1 / self.rate, jnp.abs(t)))
        if self.by_velocity.any():
            by_v = jax.jacfwd(self.conditions, 2)(t, q, v)
            size = jnp.maximum(size, jnp.max(jnp.abs(by_v) * jnp.maximum(unit * self.rate, jnp.abs(v)), axis=1))
        force = self.scales.mass * self.scales.length * self.rate**2
        scale = stop_gradients(jnp.append(size, zeros + force))
        return ConditionValues(jnp.append(g, pressure), jnp.append(g_dot, zeros), jnp.append(g_ddot, zeros), a, scale)

    def rate_of_pressure(self, k: Int[Array, ""], state: RunState, a: Float[Array, "n"]) -> Float[Array, ""]:
        """Return the rate of the contact force of event k, whose contact is at rest."""
        t, q, v, phase, added = state

        def of_phase(p: int, t: Array, q: Array, v: Array, added: Added) -> Array:
            if not any(row >= 0 for row in self.phases.tables.held[p]):
                return jnp.zeros(self.count)
            return _with_rate(lambda t, q, v: self._accelerations_and_pressures(p, t, q, v, added)[1], t, q, v, a)[1]

        return self.in_phase(phase, of_phase, t, q, v, added)[k]

    def _accelerations_and_pressures(self, phase: int, t: Array, q: Array, v: Array, added: Added) -> tuple[Array, Array]:
        """Return a, and minus the multipliers of the contacts at rest in a phase, 1 for all other events."""
        return self.textbook(phase, added).accelerations(t, q, v), self._pressures(phase, t, q, v, added)

    def _pressures(self, phase: int, t: Array, q: Array, v: Array, added: Added) -> Float[Array, "E"]:
        held, ones = np.array(self.phases.tables.held[phase]), jnp.ones(self.count)
        if not np.any(held >= 0):
            return ones
        return jnp.where(held >= 0, -self.textbook(phase, added).multipliers(t, q, v)[np.maximum(held, 0)], ones)

    def pressures(
        self, t: Float[Array, "G"], q: Float[Array, "G n"], v: Float[Array, "G n"], at: RunState
    ) -> Float[Array, "G E"]:
        """Return the contact forces at some states in the phase of another, 1 for events whose contact is not at rest."""
        of_phase = lambda p, t, q, v, added: jax.vmap(lambda t, q, v: self._pressures(p, t, q, v, added))(t, q, v)  # noqa: E731
        return self.in_phase(at.phase, of_phase, t, q, v, at.added)


def _with_rate(f: Condition, t: Array, q: Array, v: Array, a: Array) -> tuple[Float[Array, "k"], Float[Array, "k"]]:
    """Return f(t, q, v) and its rate along the motion."""
    return jax.jvp(f, (jnp.asarray(t, float), q, v), (jnp.ones(()), v, a))
