"""A run with events, as a function of all its numbers: its loop, and its derivatives through the events."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.integrate.derivatives import replaced, select
from udkjax.integrate.event_loop import run_loop
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.hybrid import ZERO_RATE, Hybrid, Point
from udkjax.integrate.solution import Result


class Trace(NamedTuple):
    """What a run with events has come to, NaN where it did not get."""

    q: Any  # (T, n)
    v: Any  # (T, n)
    time: Any  # the end of the run
    event_time: Any  # (K,)
    event_q: Any  # (K, 2, n) before and after
    event_v: Any
    event_index: Any
    event_phase: Any
    count: Any
    code: Any
    tallies: Any


class Start(NamedTuple):
    """Where a run with events begins, and its output times."""

    ts: Float[Array, "T"]
    q: Float[Array, "n"]
    v: Float[Array, "n"]
    code: Array  # a `Result` that is known before
    drift_tol: Array


def trace(hybrid: Hybrid, start: Start, max_events: int) -> Trace:
    """Run. What is smooth in the result has first derivatives, forward and reverse."""
    arrays, rest = eqx.partition((hybrid, start), eqx.is_inexact_array)
    xs, tree = jax.tree.flatten(arrays)
    return _trace(Numbers(rest, tree, max_events), xs)


class Numbers(eqx.Module):
    """What a run depends on besides its numbers."""

    rest: Any
    tree: Any = eqx.field(static=True)
    max_events: int = eqx.field(static=True)

    def combined(self, xs: Sequence[Array]) -> tuple[Hybrid, Start]:
        """The run with its numbers."""
        return eqx.combine(jax.tree.unflatten(self.tree, xs), self.rest)


@eqx.filter_custom_jvp
def _trace(numbers: Numbers, xs: list[Array]) -> Trace:
    hybrid, start = numbers.combined(xs)
    point = Point(start.ts[0], start.q, start.v, jnp.array(0), hybrid.phases.first_added())
    loop = run_loop(hybrid, start.ts, point, start.code, start.drift_tol, numbers.max_events)
    noted, smooth = loop.noted, (loop.q, loop.v, loop.point.t)
    return Trace(*smooth, noted.t, noted.q, noted.v, noted.index, noted.phase, loop.count, loop.code, loop.tallies)


@_trace.def_jvp
def _(primals, tangents):
    numbers, xs = primals
    found = _trace(*primals)
    moving = tuple(dx is not None for dx in tangents[1])
    if not any(moving):
        return found, Trace(*[None] * len(found))
    if jax.tree.unflatten(numbers.tree, moving)[1].ts:
        raise NotImplementedError("a run with events has no derivatives by its output times")

    xs = [_differentiated_once(x) for x in xs]

    def replayed(*some: Array) -> tuple[Array, ...]:
        hybrid, start = numbers.combined(replaced(xs, moving, some))
        return replay(hybrid, start, stop_gradients(found))

    change = jax.jvp(replayed, select(xs, moving), select(tangents[1], moving))[1]
    return found, Trace(*change, *(None for _ in found[len(change) :]))


@jax.custom_jvp
def _differentiated_once(x: Array) -> Array:
    """A number that the first derivatives depend on: they are right at fixed event times, and so have no derivatives."""
    return x


@_differentiated_once.defjvp
def _(primals, tangents):
    raise NotImplementedError("a run with events has first derivatives only: take differences of these")


# --- derivatives
#
# Between events the flow has derivatives of its own, along the state in which it begins and all numbers. At an event the state
# y before it, taken at the time t0 at which it was found, and so at a fixed time, meets the condition a little later or earlier:
# h(t0 + d, y + f d) = 0 gives d = -h / h_dot to first order (the theorem of implicit functions). The jump J is done there, and
# the state that it leaves is taken back to t0 with the flow f+ behind it:
#
#     y+ = J(t0 + d, y + f d) - f+ d,        dy+ = J_y dy - (J_y f + J_t - f+) h_y dy / h_dot,
#
# the saltation matrix (Leine and Nijmeijer 2004, section 7.5), written without forming it: d is zero, and has derivatives.

OUTPUTS = 32  # of one piece


def replay(hybrid: Hybrid, start: Start, found: Trace) -> tuple[Array, ...]:
    """What is smooth in a run that is known, as a function with its first derivatives."""
    ts, T, K = stop_gradients(start.ts), len(start.ts), len(found.event_time)
    width = min(OUTPUTS, T)
    pieces = K + -(-T // (width - 1)) + 2
    first = Point(ts[0], start.q, start.v, jnp.array(0), hybrid.phases.first_added())
    n = len(start.q)

    def piece(carry: Any, _: Any) -> tuple[Any, Any]:
        def run() -> tuple[Any, Any]:
            return _piece(hybrid, ts, found, width, carry)

        def skip() -> tuple[Any, Any]:
            rows = jnp.full(width, T), jnp.zeros((width, n)), jnp.zeros((width, n))
            return carry, (rows, _nothing(n, K))

        point, _, event, _ = carry
        return jax.lax.cond((point.t < found.time) | (event < found.count), run, skip)

    zero = jnp.zeros(())
    (end, *_), ((where, q, v), noted) = jax.lax.scan(piece, (first, jnp.array(0), jnp.array(0), zero), None, length=pieces)
    where = where.ravel()
    q, v = (jnp.full((T, n), jnp.nan).at[where].set(x.reshape(-1, n), mode="drop") for x in (q, v))
    last = (ts == found.time)[:, None]
    q, v = jnp.where(last, end.q, q), jnp.where(last, end.v, v)
    k, t, qs, vs = noted
    times = jnp.full(K, jnp.nan).at[k].set(t, mode="drop")
    qs, vs = (jnp.full((K, 2, n), jnp.nan).at[k].set(x, mode="drop") for x in (qs, vs))
    stopped = (found.code == Result.event_stop) | (found.code == Result.at_rest)
    time = jnp.where(stopped, times[jnp.maximum(found.count - 1, 0)], found.time)
    return q, v, time, times, qs, vs


def _piece(hybrid: Hybrid, ts: Array, found: Trace, width: int, carry: Any) -> tuple[Any, Any]:
    """Integrate to the next event, or as far as there is room for outputs, and do what happens there."""
    point, written, event, before = carry
    T, K = len(ts), len(found.event_time)
    number = written + np.arange(width)
    due = ts[jnp.minimum(number, T - 1)]
    comes = event < found.count
    j = jnp.minimum(event, K - 1)
    aim = jnp.where(comes, found.event_time[j], found.time)
    end = jnp.maximum(jnp.where(number[-1] < T - 1, jnp.minimum(aim, due[-1]), aim), point.t)
    happens = comes & (end == aim)
    short = end - point.t <= 2 * hybrid.smallest
    times = jnp.concatenate([point.t[None], jnp.clip(due, point.t, end), end[None]])
    raw = hybrid.flow(jnp.where(short, point.t + 100 * hybrid.smallest * np.arange(width + 2), times), point, derivatives=True)
    own = (short | (times <= point.t))[:, None]
    q = jnp.where(own, point.q + (times - point.t)[:, None] * point.v, raw.q)
    v = jnp.where(own, point.v, raw.v)
    where = jnp.where((number < T) & (due < end), number, T)
    arrived = Point(end, q[-1], v[-1], point.phase, point.added)

    def jumped() -> tuple[Point, Array, Any]:
        known = arrived._replace(q=_valued(arrived.q, found.event_q[j, 0]), v=_valued(arrived.v, found.event_v[j, 0]))
        after, shift, noted = _jumped(hybrid, found.event_index[j], known, before, short)
        t, qs, vs = noted
        return after, shift, (j, t, qs, vs)

    after, shift, noted = jax.lax.cond(happens, jumped, lambda: (arrived, before, _nothing(len(point.q), K)))
    written = written + jnp.sum(where < T)
    return (after, written, event + happens, shift), ((where, q[1:-1], v[1:-1]), noted)


def _jumped(hybrid: Hybrid, index: Array, point: Point, before: Array, again: Array) -> tuple[Point, Array, Any]:
    """The state after an event, taken back to the time at which the event was found, and the change d of that time."""
    E = hybrid.count
    rests, k = index >= 2 * E, jnp.where(index >= 2 * E, index - 2 * E, index)
    values = hybrid.values(point)
    rate = values.rate[k]
    if any(row >= 0 for rows in hybrid.phases.tables.held for row in rows):
        rate = jnp.where(k >= E, hybrid.rate_of_pressure(k % E, point, values.a), rate)
    h, rate = values.h[k] - stop_gradients(values.h[k]), stop_gradients(rate)
    moves = jnp.abs(rate) > ZERO_RATE * values.scale[k] * hybrid.rate
    # What happens again at the same instant, where the condition stands still, happens when the first event does.
    shift = jnp.where(moves, -h / jnp.where(moves, rate, 1.0), jnp.where(again, before, 0.0))
    there = point._replace(t=point.t + shift, q=point.q + shift * point.v, v=point.v + shift * values.a)
    after = hybrid.jump(k, rests, there, hybrid.values(there)).point
    back = after._replace(t=point.t, q=after.q - shift * after.v, v=after.v - shift * hybrid.accelerations(after))
    return back, shift, (there.t, jnp.stack([there.q, after.q]), jnp.stack([there.v, after.v]))


def _nothing(n: int, K: int) -> Any:
    """Instead of an event."""
    return jnp.array(K), jnp.zeros(()), jnp.zeros((2, n)), jnp.zeros((2, n))


def _valued(x: Array, value: Array) -> Array:
    """A known value, with the derivatives of x."""
    return x + stop_gradients(jnp.where(jnp.isfinite(value), value, x) - x)
