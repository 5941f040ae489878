"""A mechanism with events as a hybrid system: a flow in each phase, conditions along it, and the jumps between phases."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.formulations import Formulation
from udkjax.equations.quantities import equations_of
from udkjax.equations.scales import Scales
from udkjax.equations.textbook import TextbookEquations, prepare
from udkjax.equations.udwadia_kalaba import Baumgarte
from udkjax.integrate import native_engine
from udkjax.integrate.derivatives import differentiable
from udkjax.integrate.events import Event, Impact, Stop, frames_of, sees_velocity
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.impact import jump
from udkjax.integrate.phases import Phases
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.pinv import SVD, Pseudoinverse
from udkjax.scene.joints import Joint

# Of a condition's scale, that is what a displacement of L or a turn of one radian changes in it: below it the condition is zero,
# and so are its first and second rate, per T and T^2. Rounding errors of a state are some 1e-15 of it.
ZERO, ZERO_RATE, ZERO_RATE_2 = 1e-12, 1e-12, 1e-10
# Of that scale per T: an impact slower than this, where the contact is pressed on, is rest. Its rebound rises by 1e-10 of it.
REST = 1e-5
OPEN = 1e-6  # of L, or rad: a joint that is attached must be closed up to that


class Point(NamedTuple):
    """A state: where a run is."""

    t: Array
    q: Float[Array, "n"]
    v: Float[Array, "n"]
    phase: Array
    added: tuple[Joint, ...]


class Values(NamedTuple):
    """The conditions of all events, then what presses on each contact that is held, and their rates, at one state."""

    h: Float[Array, "2E"]
    rate: Float[Array, "2E"]  # 0 of what presses
    rate_2: Float[Array, "2E"]  # 0 of what presses, and of conditions that depend on velocities
    normals: Float[Array, "E n"]  # of the conditions, by q
    a: Float[Array, "n"]
    scale: Float[Array, "2E"]


class Jumped(NamedTuple):
    """What an event leaves."""

    point: Point
    blocked: Bool[Array, ""]  # an impact that the constraints do not leave any motion, or a joint attached that is open


class Hybrid(eqx.Module):
    """All numbers and choices of a run with events, but its initial state and output times."""

    phases: Phases
    events: tuple[Event, ...]
    rtol: Array
    atol: Array
    smallest: Array
    h: Array | None
    length: Array | None
    rate: Array
    method: Pseudoinverse
    baumgarte: Baumgarte | None
    formulation: Formulation | None
    solver: Any = eqx.field(static=True)
    projects: bool = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    engine: str = eqx.field(static=True)

    # --- the flow

    def problem(self, phase: int, ts: Any, q: Any, v: Any, added: Any) -> Problem:
        """What to integrate in a phase."""
        mechanism, analysis = self.phases.with_added(phase, added), self.phases.analyses[phase]
        equations = equations_of(mechanism, self.method, self.baumgarte, self.formulation, analysis)
        given: Any = (equations, ts, q, v, self.rtol, self.atol, self.smallest, self.h, self.length, self.rate)
        projected = equations.constrained and self.projects
        breaks = mechanism.breakpoints
        return Problem(*given, solver=self.solver, projected=projected, max_steps=self.max_steps, breakpoints=breaks)

    def reasons(self) -> tuple[str, ...]:
        """Why machine code cannot integrate each phase; empty where it can."""
        first, added = self.phases.mechanisms[0], self.phases.first_added()
        q, v = first.q0.ravel(), first.v0.ravel()
        return tuple(self._reason_for_diffrax(k, jnp.zeros(2), q, v, added) for k in range(len(self.phases.mechanisms)))

    def first_problem(self) -> Problem:
        """That of the first phase, for what does not depend on its state."""
        first = self.phases.mechanisms[0]
        return self.problem(0, jnp.zeros(2), first.q0.ravel(), first.v0.ravel(), self.phases.first_added())

    def _reason_for_diffrax(self, phase: int, ts: Any, q: Any, v: Any, added: Any) -> str:
        if self.engine == "diffrax":
            return "it was asked for"
        return native_engine.reason_for_diffrax(self.problem(phase, ts, q, v, added))

    def flow(self, ts: Any, point: Point, derivatives: bool) -> IntegratorOutput:
        """Integrate from a state, over times from its own on."""

        def of(phase: int, ts: Any, q: Any, v: Any, added: Any) -> IntegratorOutput:
            native = not self._reason_for_diffrax(phase, ts, q, v, added)
            problem = self.problem(phase, ts, q, v, added)
            if derivatives or not native:
                return differentiable(problem, native)
            return native_engine.solve(problem)

        return self._in(point.phase, of, ts, point.q, point.v, point.added)

    def _in(self, phase: Any, function: Any, *arguments: Any) -> Any:
        """`function(phase, *arguments)` of the phase, which is traced."""
        count = len(self.phases.mechanisms)
        if count == 1:
            return function(0, *arguments)
        branches = [lambda *x, k=k: function(k, *x) for k in range(count)]
        return jax.lax.switch(phase, branches, *arguments)

    # --- conditions

    @property
    def count(self) -> int:
        """How many events there are."""
        return len(self.events)

    def conditions(self, t: Any, q: Any, v: Any) -> Float[Array, "E"]:
        """Those of all events."""
        frames = frames_of(self.names, q, v)
        return jnp.stack([jnp.asarray(e.condition(t, frames), float) for e in self.events])

    def on_grid(self, t: Any, q: Any, v: Any) -> tuple[Array, Array]:
        """Conditions, and the rates of those that depend on positions alone."""
        return _along(self.conditions, t, q, v, jnp.zeros_like(v))

    @property
    def names(self) -> tuple[str, ...]:
        return self.phases.mechanisms[0].body_names

    @property
    def by_velocity(self) -> np.ndarray:
        """Which conditions depend on velocities."""
        return np.array([sees_velocity(e, self.phases.mechanisms[0]) for e in self.events])

    def values(self, point: Point) -> Values:
        """Conditions, what presses on contacts, and their rates."""
        t, q, v, phase, added = point
        a, pressure = self._in(phase, self._loads, t, q, v, added)
        g, g_dot = _along(self.conditions, t, q, v, a)
        rates = lambda t, q, v: _along(self.conditions, t, q, v, jnp.zeros_like(a))[1]  # noqa: E731
        g_ddot = jnp.where(self.by_velocity, 0.0, _along(rates, t, q, v, a)[1])
        by_q = jax.jacfwd(self.conditions, 1)(t, q, v)
        unit, zeros = self.scales.coordinates(len(q)), jnp.zeros(self.count)
        size = jnp.max(jnp.abs(by_q) * jnp.maximum(unit, jnp.abs(q)), axis=1)
        if self.by_velocity.any():
            by_v = jax.jacfwd(self.conditions, 2)(t, q, v)
            size = jnp.maximum(size, jnp.max(jnp.abs(by_v) * jnp.maximum(unit * self.rate, jnp.abs(v)), axis=1))
        force = self.scales.mass * self.scales.length * self.rate**2
        scale = stop_gradients(jnp.append(size, zeros + force))
        return Values(jnp.append(g, pressure), jnp.append(g_dot, zeros), jnp.append(g_ddot, zeros), by_q, a, scale)

    def accelerations(self, point: Point) -> Array:
        """a."""
        t, q, v, phase, added = point
        return self._in(phase, lambda p, t, q, v, added: self._textbook(p, added).accelerations(t, q, v), t, q, v, added)

    def rate_of_pressure(self, k: Any, point: Point, a: Array) -> Array:
        """How fast what presses on a contact that is held changes."""
        t, q, v, phase, added = point

        def of(p: int, t: Any, q: Any, v: Any, added: Any) -> Array:
            if not any(row >= 0 for row in self.phases.tables.held[p]):
                return jnp.zeros(self.count)
            return _along(lambda t, q, v: self._loads(p, t, q, v, added)[1], t, q, v, a)[1]

        return self._in(phase, of, t, q, v, added)[k]

    def _loads(self, phase: int, t: Any, q: Any, v: Any, added: Any) -> tuple[Array, Array]:
        """The accelerations, and what presses on the contacts that a phase holds: minus their multipliers; 1 on all others."""
        equations, held = self._textbook(phase, added), np.array(self.phases.tables.held[phase])
        a, ones = equations.accelerations(t, q, v), jnp.ones(self.count)
        if not np.any(held >= 0):
            return a, ones
        return a, jnp.where(held >= 0, -equations.multipliers(t, q, v)[np.maximum(held, 0)], ones)

    def _textbook(self, phase: int, added: Any) -> TextbookEquations:
        return prepare(self.phases.with_added(phase, added), SVD(), self.baumgarte, self.phases.analyses[phase])

    # --- jumps

    def table(self, name: str) -> Array:
        return jnp.array(getattr(self.phases.tables, name))

    def is_held(self, phase: Any) -> Bool[Array, "E"]:
        """Which contacts a phase holds."""
        return self.table("held")[phase] >= 0

    def is_a(self, *kinds: type) -> np.ndarray:
        """Which events have an action of these kinds."""
        return np.array([isinstance(e.action, kinds) for e in self.events])

    @property
    def restitutions(self) -> Array:
        return jnp.stack([e.action.restitution if isinstance(e.action, Impact) else jnp.zeros(()) for e in self.events])

    def rests(self, k: Any, values: Values) -> Any:
        """Whether an event is an impact that is too slow to rebound, of a contact that is pressed on."""
        e, unit = k % self.count, values.scale[k % self.count] * self.rate
        slow, pressed = jnp.abs(values.rate[e]) < REST * unit, values.rate_2[e] < -ZERO_RATE_2 * unit * self.rate
        return jnp.array(self.restituting)[e] & (k < self.count) & slow & pressed

    def jump(self, k: Any, rests: Any, point: Point, values: Values) -> Jumped:
        """Do what event k does, or, from `count` on, let a contact go."""
        lets_go, e = k >= self.count, k % self.count
        t, q, v, phase, added = point
        blocked, dv = jnp.array(False), jnp.zeros_like(v)
        if self.restituting.any():
            rate = values.rate[e]
            hits = jnp.array(self.restituting)[e] & ~lets_go
            found = self._in(phase, lambda p, *x: jump(self._textbook(p, x[-1]), *x[:-1]), t, q, values.normals[e], rate, added)
            blocked = hits & ~found.free
            dv = jnp.where(hits, (1 + jnp.where(rests, 0.0, self.restitutions[e])) * found.dv, 0.0)
        v = v + dv
        after = jnp.where(rests, self.table("resting")[phase, e], self.table("after")[phase, e])
        after = jnp.where(lets_go, self.table("freed")[phase, e], after)
        if self.phases.added:
            taken = [~lets_go & (e == by) for by, _ in self.phases.added_by]
            new = (self.phases.resolved(i, q) for i in range(len(added)))
            added = tuple(
                jax.tree.map(lambda a, b, is_new=is_new: jnp.where(is_new, a, b), a, b)
                for is_new, a, b in zip(taken, new, added, strict=True)
            )
            adds = jnp.any(jnp.stack(taken))
            q1, v1 = self._in(after, self._closed, t, q, v, added)
            blocked = blocked | (adds & (stop_gradients(self.scales.size(q1 - q)) > OPEN))
            q, v = jnp.where(adds, q1, q), jnp.where(adds, v1, v)
        return Jumped(Point(t, q, v, after, added), blocked)

    def _closed(self, phase: int, t: Any, q: Any, v: Any, added: Any) -> tuple[Array, Array]:
        """A state that a phase allows. Velocities jump to it, so that the derivatives are not those of a small correction."""
        equations = self._textbook(phase, added)
        return uk.project(equations.mechanism, t, q, v, equations.method, equations.weights)

    @property
    def restituting(self) -> np.ndarray:
        """Which events are impacts."""
        return self.is_a(Impact)

    @property
    def stops_at_rest(self) -> np.ndarray:
        """Which of them end the run when they come to rest."""
        return np.array([isinstance(e.action, Impact) and e.action.at_rest == "stop" for e in self.events])

    @property
    def scales(self) -> Scales:
        return self.phases.analyses[0].scales

    @property
    def stops(self) -> np.ndarray:
        """Which events end the run."""
        return self.is_a(Stop)


def _along(f: Any, t: Any, q: Any, v: Any, a: Any) -> tuple[Any, Any]:
    """f(t, q, v) and its rate along the motion."""
    return jax.jvp(f, (jnp.asarray(t, float), q, v), (jnp.ones(()), v, a))
