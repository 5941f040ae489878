"""A run with events, as a function of all its numbers: its loop, and its derivatives through the events."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from udkjax.annotations import TreeDef
from udkjax.integrate.events.instant.impacts import KnownContacts
from udkjax.integrate.events.instant.jumps import apply_event
from udkjax.integrate.events.instant.runs import EventRun, RunState
from udkjax.integrate.events.instant.sticking import modes_of, settle_friction
from udkjax.integrate.events.instant.system import condition_values
from udkjax.integrate.events.law.crossings import NO_EVENT, ZERO_RATE_2_TOL, ZERO_RATE_TOL, ZERO_TOL
from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.integrate.events.run.host_run import run_by_machine_code
from udkjax.integrate.events.run.hybrid import Hybrid, rate_along
from udkjax.integrate.events.run.plain_system import PlainSystem, run_plain, with_member, without_member
from udkjax.integrate.solution import Result
from udkjax.native.watching.conditions import Conditions
from udkjax.programs.control_flow import cond_of_batch
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import defined_along
from udkjax.transforms.gradients import stop_gradients
from udkjax.transforms.traced_numbers import replaced, select

OUTPUTS_PER_PIECE = 32  # per piece


def run_events(hybrid: Hybrid, conditions: Conditions | None) -> EventRun:
    """Run a system with events. Times and states of the result have first derivatives, forward and reverse.

    Args:
        hybrid: the system.
        conditions: conditions of all events, for machine code; None if it cannot run the system.
    """
    arrays, rest = eqx.partition(hybrid, eqx.is_inexact_array)
    xs, tree = jax.tree.flatten(arrays)
    return _run(FixedPart(rest, tree, conditions), xs)


def hybrid_plan(fixed: "FixedPart") -> EventPlan:
    """Return the plan of the events of a system."""
    return jax.tree.unflatten(fixed.tree, [None] * fixed.tree.num_leaves).plan


class FixedPart(eqx.Module):
    """Everything in a `Hybrid` except its numbers, and the conditions of its events for machine code."""

    rest: PyTree
    tree: TreeDef = eqx.field(static=True)
    conditions: Conditions | None = eqx.field(static=True)

    def combine(self, xs: Sequence[Array]) -> Hybrid:
        """Return the `Hybrid` with these numbers."""
        return eqx.combine(jax.tree.unflatten(self.tree, xs), self.rest)


@eqx.filter_custom_jvp
def _run(fixed: FixedPart, xs: list[Array]) -> EventRun:
    hybrid = fixed.combine(xs)
    found = run_plain(hybrid) if fixed.conditions is None else run_by_machine_code(hybrid, fixed.conditions)
    with jax.debug_nans(False):  # outputs after the end of a run are undefined, and so are their derivatives
        q, v = (jnp.where(jnp.isinf(x), jnp.nan, x) for x in (found.q, found.v))
    return found._replace(q=q, v=v)


@_run.def_jvp
def _(primals, tangents):
    fixed, xs = primals
    found = _run(*primals)
    has_tangent = tuple(dx is not None for dx in tangents[1])
    if not any(has_tangent):
        return found, EventRun._make([None] * len(found))
    if jax.tree.unflatten(fixed.tree, has_tangent).ts:
        raise NotImplementedError("a run with events has no derivatives with respect to its output times")

    if hybrid_plan(fixed).changes.any():
        xs = [_differentiate_once(x) for x in xs]

    def replay_from(*active: Array) -> tuple[Array, ...]:
        return _replay(fixed, replaced(xs, has_tangent, active), stop_gradients(found), _zero(active[0]))

    def along(directions: list[Array]) -> Sequence[Array]:
        return jax.jvp(replay_from, select(xs, has_tangent), directions)[1]

    change = defined_along(along, select(tangents[1], has_tangent), found)
    return found, EventRun._make([*change, *(None for _ in found[len(change) :])])


@jax.custom_jvp
def _zero(x: Array) -> Float[Array, ""]:
    """Return a zero that JAX differentiates with respect to x; its derivatives are zero, too."""
    return jnp.zeros(())


@_zero.defjvp
def _(primals, tangents):
    return _zero(*primals), 0.0 * jnp.ravel(tangents[0])[0]


@jax.custom_jvp
def _differentiate_once(x: Array) -> Array:
    """Return x; its derivatives raise an error, since second derivatives of jumps of velocities or constraints are missing."""
    return x


@_differentiate_once.defjvp
def _(primals, tangents):
    raise NotImplementedError("a run with events has first derivatives only: take differences of these")


# --- derivatives
#
# Between events the flow is differentiable with respect to its initial state and all numbers. Let t0 be the time at which an
# event was found, held fixed, and y the state before the event at t0. When numbers change, the condition is met at another time
# t0 + d: h(t0 + d, y + f d) = 0 gives d = -h / h_dot to first order (implicit function theorem). The jump J is applied at that
# time, and the state after it is moved back to t0 along the flow f+:
#
#     y+ = J(t0 + d, y + f d) - f+ d,        dy+ = J_y dy - (J_y f + J_t - f+) h_y dy / h_dot,
#
# with the saltation matrix (Leine and Nijmeijer 2004, section 7.5). The code does not form this matrix: it computes y+ with a d
# whose value is zero, but whose derivatives are not.


# To second order d and the moved states have further terms, d^2/2 times second rates. Their values and first derivatives are
# zero, so that second rates are computed only where second derivatives are asked for.


@eqx.filter_custom_jvp
def _second_order(d: Float[Array, ""], hybrid: Hybrid, at: RunState) -> tuple[Float[Array, "n"], Float[Array, "E"]]:
    """Return d^2/2 times the second rates of velocities and of conditions, at d = 0."""
    return jnp.zeros_like(at.v), jnp.zeros(hybrid.count)


@_second_order.def_jvp
def _(primals, tangents):
    change, found = tangents[0], _second_order(*primals)
    if change is None:
        return found, (None, None)
    return found, tuple(x * change for x in _first_order(*primals))


@eqx.filter_custom_jvp
def _first_order(d: Float[Array, ""], hybrid: Hybrid, at: RunState) -> tuple[Float[Array, "n"], Float[Array, "E"]]:
    """Return d times the second rates, at d = 0."""
    return jnp.zeros_like(at.v), jnp.zeros(hybrid.count)


@_first_order.def_jvp
def _(primals, tangents):
    change, (_, hybrid, at) = tangents[0], primals
    found = _first_order(*primals)
    if change is None:
        return found, (None, None)
    return found, tuple(x * change for x in stop_gradients(hybrid.second_rates(at)))


class PieceStart(NamedTuple):
    """The state in which a piece of a run begins. A piece ends at the next event, or where it has no room for more outputs."""

    state: RunState
    written: Int[Array, ""]  # number of outputs so far
    event: Int[Array, ""]  # index of the next event in the run
    shift: Float[Array, ""]  # the change d of the time of the last event


class PieceOutput(NamedTuple):
    """The outputs of a piece, and the event at its end; indices beyond the arrays mark unused entries."""

    rows: Int[Array, "W"]
    q: Float[Array, "W n"]
    v: Float[Array, "W n"]
    event: Int[Array, ""]
    event_time: Float[Array, ""]
    event_q: Float[Array, "2 n"]
    event_v: Float[Array, "2 n"]


@deferred
def _replay(fixed: FixedPart, xs: Sequence[Array], found: EventRun, zero: Float[Array, ""]) -> tuple[Array, ...]:
    return replay(fixed.combine(xs), found, zero)


def replay(hybrid: Hybrid, found: EventRun, zero: Float[Array, ""]) -> tuple[Array, ...]:
    """Return the smooth results of a run, the first fields of `EventRun`, with their first derivatives.

    The run is integrated again, from event to event of the run `found`. States at the start have the derivatives of `zero`: JAX
    otherwise differentiates the loop twice, first for a loop whose first state has none.
    """
    hybrid = replace(hybrid, replays=True)
    system = PlainSystem(hybrid)
    ts, T, K, n = stop_gradients(hybrid.ts), len(hybrid.ts), len(found.event_time), len(hybrid.q)
    width = min(OUTPUTS_PER_PIECE, T)
    pieces = K + -(-T // (width - 1)) + 2

    def piece(start: PieceStart, _: None) -> tuple[PieceStart, PieceOutput]:
        def skip() -> tuple[PieceStart, PieceOutput]:
            rows = jnp.full(width, T), jnp.zeros((width, n)), jnp.zeros((width, n))
            return start, PieceOutput(*rows, *_no_event(n, K))

        goes_on = (start.state.t < found.time) | (start.event < found.count)
        return cond_of_batch(goes_on, lambda: _integrate_piece(system, ts, found, width, start), skip)

    state = hybrid.first_state()._replace(t=ts[0])
    if system.plan.sticking:
        began = with_member(state._replace(phase=found.first_phase, joints=(*state.joints[:-1], found.first_sides)))
        start, _ = settle_friction(system, None, with_member(state), jnp.array([NO_EVENT]), modes_of(system, None, began))
        state = without_member(start)
    q, v, *joints = (x + zero if eqx.is_inexact_array(x) else x for x in (state.q, state.v, *jax.tree.leaves(state.joints)))
    state = state._replace(q=q, v=v, joints=jax.tree.unflatten(jax.tree.structure(state.joints), joints))
    end, out = jax.lax.scan(piece, PieceStart(state, jnp.array(0), jnp.array(0), zero), None, length=pieces)
    rows = out.rows.ravel()
    q, v = (jnp.full((T, n), jnp.inf).at[rows].set(x.reshape(-1, n), mode="drop") for x in (out.q, out.v))
    last = (ts == found.time)[:, None]
    q, v = jnp.where(last, end.state.q, q), jnp.where(last, end.state.v, v)
    first = jnp.cumsum(~found.together) - 1  # for each event, the index of its group of simultaneous events
    first = jnp.flatnonzero(~found.together, size=K, fill_value=0)[first]
    times = jnp.full(K, jnp.inf).at[out.event].set(out.event_time, mode="drop")[first]
    qs, vs = (jnp.full((K, 2, n), jnp.inf).at[out.event].set(x, mode="drop")[first] for x in (out.event_q, out.event_v))
    stopped = (found.code == Result.event_stop) | (found.code == Result.at_rest)
    time = jnp.where(stopped, times[jnp.maximum(found.count - 1, 0)], found.time)
    return q, v, time, times, qs, vs


def _integrate_piece(
    system: PlainSystem, ts: Float[Array, "T"], found: EventRun, width: int, start: PieceStart
) -> tuple[PieceStart, PieceOutput]:
    """Integrate to the next event, which is then applied, or until there is no room for more outputs."""
    hybrid, (state, written, event, shift) = system.hybrid, start
    T, K = len(ts), len(found.event_time)
    output = written + np.arange(width)
    requested = ts[jnp.minimum(output, T - 1)]
    has_next = event < found.count
    j = jnp.minimum(event, K - 1)
    target = jnp.where(has_next, found.event_time[j], found.time)
    end = jnp.maximum(jnp.where(output[-1] < T - 1, jnp.minimum(target, requested[-1]), target), state.t)
    happens = has_next & (end >= target)
    is_short = end - state.t <= 2 * hybrid.smallest
    times = jnp.concatenate([state.t[None], jnp.clip(requested, state.t, end), end[None]])
    raw = hybrid.flow(jnp.where(is_short, state.t + 100 * hybrid.smallest * np.arange(width + 2), times), state, derivatives=True)
    is_extrapolated = (is_short | (times <= state.t))[:, None]
    q = jnp.where(is_extrapolated, state.q + (times - state.t)[:, None] * state.v, raw.q)
    v = jnp.where(is_extrapolated, state.v, raw.v)
    rows = jnp.where((output < T) & (requested < end), output, T)
    at_end = RunState(end, q[-1], v[-1], state.phase, state.joints)

    def jump() -> tuple[RunState, Array, tuple[Array, Array, Array, Array]]:
        states = (found.event_q[j], at_end.q), (found.event_v[j], at_end.v)
        qs, vs = (jnp.where(jnp.isfinite(x), x, y) for x, y in states)  # finite also in a batch's members without an event
        before = at_end._replace(q=_with_value(at_end.q, qs[0]), v=_with_value(at_end.v, vs[0]))
        after, d, (t, at_q, at_v) = _apply_at_fixed_time(system, found, j, before, shift, is_short)
        # With values that are known, a first pass of reverse mode needs nothing of the jump.
        after = after._replace(q=_with_value(after.q, qs[1]), v=_with_value(after.v, vs[1]))
        return after, _with_value(d, jnp.zeros(())), (j, t, at_q, at_v)

    # Without a checkpoint, the loop over pieces would store all intermediate results of jumps, and zeros of pieces without one.
    # Its body is no place for barriers against common subexpressions: reverse mode has a loop of its own.
    after, shift, record = cond_of_batch(
        happens, jax.checkpoint(jump, prevent_cse=False), lambda: (at_end, shift, _no_event(len(state.q), K))
    )
    group = jnp.cumsum(~found.together)
    event = event + jnp.where(happens, jnp.sum((group == group[j]) & (jnp.arange(K) < found.count)), 0)
    following = PieceStart(after, written + jnp.sum(rows < T), event, shift)
    return following, PieceOutput(rows, q[1:-1], v[1:-1], *record)


def _apply_at_fixed_time(
    system: PlainSystem, found: EventRun, j: Int[Array, ""], state: RunState, shift: Float[Array, ""], again: Array
) -> tuple[RunState, Float[Array, ""], tuple[Array, Array, Array]]:
    """Apply an event that was found at the time of `state`, and return the state after the event at that time.

    Args:
        system: the system.
        found: the run.
        j: the index of the event in the run.
        state: the state before the event.
        shift: the change d of the time of the previous event.
        again: whether no time has passed since the previous event.

    Returns:
        The state after the event at the fixed time, the change d of the event's time, and time and states at the event.
    """
    hybrid, E, index = system.hybrid, system.plan.count, found.event_index[j]
    k = jnp.where(index >= 2 * E, index - 2 * E, index)
    # As d is zero, rates and accelerations count with their values alone in first derivatives.
    first_only = system.plan.changes.any()
    fixed, at = (PlainSystem(stop_gradients(hybrid)), stop_gradients(state)) if first_only else (system, state)
    evaluated = condition_values(fixed, None, with_member(at))
    values, _ = evaluated
    h, rate, a = values.h[0, k % E], values.rate[0, k % E], values.a[0]
    if first_only:
        h = hybrid.conditions(state.joints)(*state[:3])[k % E]
    if system.plan.held_at_rest.any() or system.plan.sticking:
        force = lambda t, q, v: fixed.hybrid.forces(at._replace(t=t, q=q, v=v))[k % E]  # noqa: E731
        of_force = hybrid.forces(state)[k % E], rate_along(force, *at[:3], a)[1]
        h, rate = (jnp.where(k >= E, *x) for x in zip(of_force, (h, rate), strict=True))
    unit = jnp.where(k >= E, hybrid.force, values.scale[0, k % E])
    is_transversal = jnp.abs(stop_gradients(rate)) > ZERO_RATE_TOL * unit * hybrid.rate
    if system.plan.held_at_rest.any():  # a contact comes to rest at the top of a hop, where its rate falls through zero (`hops`)
        of_top, rate_2 = hybrid.conditions_and_rates(state.joints)(*state[:3])[1][k % E], values.rate_2[0, k % E]
        is_top = ~again & ~is_transversal & (index >= 2 * E) & (rate_2 < -ZERO_RATE_2_TOL * unit * hybrid.rate**2)
        h, rate, is_transversal = jnp.where(is_top, of_top, h), jnp.where(is_top, rate_2, rate), is_transversal | is_top
    # An event at the same instant as the event before moves with that event if its condition is stationary, or if the jump of
    # the event before has carried its condition beyond zero, further than the flow does within the shortest step.
    by_flow = ZERO_TOL * unit + 2 * hybrid.smallest * jnp.abs(rate)
    is_transversal &= ~(again & (jnp.abs(stop_gradients(h)) > stop_gradients(by_flow)))
    h = h - stop_gradients(h)
    rate = jnp.where(is_transversal, rate, 1.0)
    d = jnp.where(is_transversal, -h / rate, jnp.where(again, shift, 0.0))
    _, of_h = _second_order(d, hybrid, state)
    d = d - jnp.where(is_transversal, of_h[k % E] / stop_gradients(rate), 0.0)
    before = with_member(_moved(hybrid, state, d, a))
    at_end = with_member(state._replace(phase=found.event_phase[j], joints=(*state.joints[:-1], found.sides[j])))
    modes = modes_of(system, None, at_end) if system.plan.sticking else None
    known = KnownContacts(found.contact_state[j][None], system.plan.held(at_end.phase, jnp))
    after = apply_event(system, None, k[None], before, *evaluated, known, modes).state
    after = without_member(after)._replace(phase=found.event_phase[j])
    after = after._replace(joints=(*after.joints[:-1], found.sides[j]))
    a_after = fixed.hybrid.accelerations(stop_gradients(after) if first_only else after)
    at_time = _moved(hybrid, after, -d, a_after)._replace(t=state.t)
    before = without_member(before)
    return at_time, d, (before.t, jnp.stack([before.q, after.q]), jnp.stack([before.v, after.v]))


def _moved(hybrid: Hybrid, state: RunState, d: Float[Array, ""], a: Float[Array, "n"]) -> RunState:
    """Return the state after a time d = 0, with derivatives of first and second order."""
    of_v, _ = _second_order(d, hybrid, state)
    return state._replace(t=state.t + d, q=state.q + d * (state.v + 0.5 * d * a), v=state.v + d * a + of_v)


def _no_event(n: int, K: int) -> tuple[Array, Array, Array, Array]:
    """Return an index beyond the K events, a time and states as placeholders for a missing event."""
    return jnp.array(K), jnp.zeros(()), jnp.zeros((2, n)), jnp.zeros((2, n))


@jax.custom_jvp
def _with_value(x: Array, value: Array) -> Array:
    """Return `value` with the derivatives of x."""
    del x
    return value


@_with_value.defjvp
def _(primals, tangents):
    return _with_value(*primals), tangents[0]
