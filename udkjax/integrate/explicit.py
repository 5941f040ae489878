"""Explicit Runge-Kutta methods for q'' = a(t, q, v), many members at once, each with a time, a step and a result of its own.

A method's tableau (A, b, c) is diffrax's. Since q' = v, its stages need the accelerations alone (Hairer, Norsett, Wanner, II.14):

    q_i = q + h c_i v + h^2 sum_j (A A)_ij a_j,        v_i = v + h sum_j A_ij a_j,        a_i = a(t + c_i h, q_i, v_i),

half of what a general state would have to keep. Each accepted step is returned to the constraint manifold. Outputs lie on the
polynomial that has the positions, velocities and accelerations of four consecutive accepted states (of degree 11: interpolated
states are as exact as the states themselves, and cost no evaluation). Where the motion is not smooth a step ends, and the run
starts anew (breakpoints.py).

Arrays are (n, *lanes): lanes are () for one run, or (L,), which fills the vector units. On the CPU, XLA compiles a loop into one
function if it holds no branch; so the loop over the steps, in `march`, holds none: where the accelerations come out as not a
number, because elimination met a pivot that it must not trust, a lane takes a slightly shorter step; where that does not help it
waits, and the loop around takes the step again, by equations that may branch.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from udkjax.integrate.breakpoints import last_end, new_start
from udkjax.integrate.crossing import ahead, around, far, passed
from udkjax.integrate.first_step import first_step
from udkjax.integrate.interpolation import Point, interpolated
from udkjax.integrate.packing import Packing
from udkjax.integrate.pieces import share_before
from udkjax.integrate.record import Record, blank, noted
from udkjax.integrate.step import Task, Trial, attempt, tolerance
from udkjax.integrate.undifferentiated import undifferentiated
from udkjax.native.steps import (
    AIM_ACROSS,
    AIM_BEFORE,
    AIM_BEYOND,
    BEFORE,
    CAUTIOUS,
    CUT,
    DODGE,
    DODGES,
    DONE,
    DOUBTED,
    EDGE,
    EXACT,
    FORESEEN,
    GAP,
    GROW,
    PAST,
    POINTS,
    RUNNING,
    SAFETY,
    SHRINK,
    STEEPEST,
    STEP_LIMIT,
    STEP_TOO_SMALL,
    TRIES,
)
from udkjax.straightline import after, apart, when

BLOCK = 4  # output times that are interpolated together


class March(NamedTuple):
    """Where each lane stands."""

    here: Point
    back: tuple[Point, ...]  # the accepted states before, the latest last
    distances: tuple[Array, ...]  # of accepted states from singular configurations, that of here the last
    h: Array
    rate: Array  # of errors: that of the last accepted step over h to the power of the method's order
    code: Array  # RUNNING, DONE, ...
    doubt: Array  # whether the step has to be taken again with care
    dodged: Array  # how often in a row it was taken a little shorter instead
    tried: Array
    accepted: Array
    evaluations: Array
    written: Array  # how many of the inner output times are behind
    outputs: Array  # (*lanes, T - 2 + BLOCK, 2n): q and v at the inner output times
    record: Record | None  # of one run alone
    steps: Array | None = None  # since the run has started anew, or -1: that it does next; None: it never does
    crossing: Array | None = None  # beside the time when the motion is expected to leave its piece; None: it has no pieces
    aim: Array | None = None  # where beside
    tries: Array | None = None  # how often in a row a step was taken again to end there


def march(task: Task, q: Array, v: Array, number: Array) -> March:
    """Integrate from ts[0] to ts[-1]. The start waits for `number`, one that is there once those of the equations are."""
    lanes = q.shape[1:]
    start = Point(jnp.broadcast_to(task.ts[0], lanes), q, v, jnp.zeros_like(q))
    none, inner = jnp.zeros(lanes, int), len(task.ts) - 2
    outputs = jnp.zeros((*lanes, inner + BLOCK if inner else 0, 2 * len(start.q)), start.q.dtype)
    # The first round is no step: it finds the accelerations, and with them the first step, where the others have their code.
    back, no = (start,) * (POINTS - 2), jnp.zeros(lanes, bool)
    record = blank(start, task.method.stages, task.max_steps) if task.recorded else None
    distances = (jnp.full(lanes, jnp.inf),) * (POINTS - 1)
    counts = none, no, none, none - 1, none - 1, none, none
    steps = None if task.breakpoints is None and task.piece is None else none - 1
    first = March(start, back, distances, jnp.zeros(lanes), jnp.full(lanes, jnp.inf), *counts, outputs, record, steps)
    if task.piece is not None:
        first = first._replace(crossing=jnp.full(lanes, jnp.inf), aim=none, tries=none)

    def running(m: March) -> Array:
        return jnp.any(m.code == RUNNING)

    def quick(m: March) -> March:
        t1, last, lands = _end(task, m)
        trial = attempt(task, m.here, jnp.where(m.code == RUNNING, t1 - m.here.t, 0.0), t1, _begins(m))
        doubt = (m.code == RUNNING) & ~jnp.isfinite(trial.error) & task.doubts
        beside = (m.code == RUNNING) & (trial.error < 1.0) & ~_far(task, m, trial.distance) & ~last
        beside = when(jnp.any(beside), lambda b: b & ~_past(task, m, trial), beside)
        # Those that begin beside a singular configuration have their first stages there, however long they are.
        dodge = (doubt | beside) & _far(task, m, m.distances[-1]) & (m.dodged < DODGES) & _goes_on(m)
        m, doubt = m._replace(dodged=jnp.where(dodge, m.dodged + 1, 0)), doubt & ~dodge
        m = _decide(task, m, trial, last, lands, (m.code == RUNNING) & ~doubt, fallback=False)
        return m._replace(doubt=doubt) if task.fallback else m._replace(code=jnp.where(doubt, DOUBTED, m.code))

    def again(m: March) -> March:
        assert task.fallback is not None
        t1, last, lands = _end(task, m)
        trial = task.fallback(m.doubt, m.here, t1 - m.here.t, t1, _begins(m))
        m = _decide(task, m, trial, last, lands, m.doubt, fallback=True)
        # Rare: as a part of the function of ordinary steps they would take half as long again to compile.
        return m._replace(doubt=jnp.zeros(lanes, bool), tried=apart(m.tried))

    # What a round of a single run costs counts; lanes take a thousand times as long, and a little longer where they are packed.
    packing = None if lanes else Packing(first._replace(outputs=None, record=None))

    def packed(m: March) -> Any:
        return m if packing is None else (packing.pack(m._replace(outputs=None, record=None)), m.outputs, m.record)

    def unpacked(state: Any) -> March:
        if packing is None:
            return state
        small, outputs, record = state
        m = packing.unpack(small)
        h, rate, distances = undifferentiated((m.h, m.rate, m.distances))
        return m._replace(h=h, rate=rate, distances=distances, outputs=outputs, record=record)

    def undoubted(state: Any) -> Any:
        return packed(jax.lax.while_loop(lambda m: running(m) & ~jnp.any(m.doubt), quick, unpacked(state)))

    def rounds(state: Any) -> Any:
        if task.fallback is None:
            return undoubted(state)
        state = undoubted(state) if packing is None else when(running(unpacked(state)), undoubted, state)
        return jax.lax.cond(jnp.any(unpacked(state).doubt), lambda s: packed(again(unpacked(s))), lambda s: s, state)

    begin = packed(first) if packing is None else after(number, packed(first))
    return unpacked(jax.lax.while_loop(lambda s: running(unpacked(s)), rounds, begin))


def _begins(m: March) -> Array:
    """Whether the next round is no step, but finds the accelerations where one begins."""
    return m.tried < 0 if m.steps is None else m.steps < 0


def _goes_on(m: March) -> Array:
    return m.tried >= 0 if m.steps is None else m.steps >= 0


def _end(task: Task, m: March) -> tuple[Array, Array, Array | None]:
    """Where the next step ends, and whether it is the last: that one is stretched a little, not followed by a tiny one.

    And whether it ends at a breakpoint; None where the run never starts anew. It takes enough steps between two starts for its
    outputs to lie on a polynomial through `POINTS` states, also behind the first.
    """
    t1 = m.here.t + m.h
    last = (t1 >= task.ts[-1] - task.smallest) & _goes_on(m)
    if m.steps is None:
        return jnp.where(last, task.ts[-1], t1), last, None
    end = crossing = jnp.full_like(t1, jnp.inf)
    behind = m.here.t
    if task.breakpoints is not None:
        end = last_end(task.breakpoints, m.here.t, task.smallest)
        behind = new_start(task.breakpoints, m.here.t, task.smallest)
    if m.crossing is not None:
        crossing = m.here.t + undifferentiated(m.crossing - m.here.t)
    stop = jnp.where(crossing < end, crossing, end)
    rest = jnp.minimum(stop, task.ts[-1]) - m.here.t
    share = m.here.t + undifferentiated(rest) / jnp.maximum(POINTS - 1 - m.steps, 1)
    several = (m.steps < POINTS - 2) & (t1 > share) & (rest > 2 * POINTS * task.smallest)
    if m.aim is not None:
        several &= m.aim != AIM_ACROSS
    t1 = jnp.where(several, share, t1)
    reaches = (t1 >= stop - 2 * task.smallest) & (stop < task.ts[-1] - task.smallest) & (m.steps >= 0)
    last &= ~reaches & ~several
    final = task.ts[-1] - undifferentiated(jnp.maximum(task.ts[-1] - end, 0.0))  # there may be one at the very end
    t1 = jnp.where(reaches, stop, jnp.where(last, final, t1))
    return jnp.where(m.steps < 0, m.here.t + undifferentiated(behind - m.here.t), t1), last, reaches & (end <= crossing)


def _decide(task: Task, m: March, trial: Trial, last: Array, lands: Array | None, judged: Array, fallback: bool) -> March:
    """Accept or reject a step of the lanes that are `judged`, choose the next one, and write the outputs that are behind."""
    dodge, tried = judged & (m.dodged > 0), m.tried + judged
    accept = judged & (trial.error < 1.0) & ~dodge
    step = undifferentiated(trial.to.t - m.here.t)
    stepped, begun = (tried > 0, judged & (tried == 0)) if m.steps is None else (m.steps >= 0, judged & (m.steps < 0))
    again = None
    if task.piece is not None and lands is not None:
        m, lands, again = _leave(task, m, trial, lands, judged, step)
        accept &= ~again
    factor, rate = _factor(task, m, trial.error, step, accept)
    h = jnp.where(judged, step * jnp.where(dodge, DODGE, factor), m.h)
    failed = judged & ~accept & stepped
    if again is not None:
        h, failed = jnp.where(again, m.h, h), failed & ~again
    h = when(jnp.any(failed), lambda h: jnp.where(failed, _around(task, m, step, h), h), h)
    h = when(jnp.any(begun), lambda h: jnp.where(begun, _first_step(task, trial.to), h), h)
    code = jnp.where(judged & (h < task.smallest), STEP_TOO_SMALL, m.code)
    code = jnp.where((code == RUNNING) & (tried >= task.max_steps), STEP_LIMIT, code)
    code = jnp.where(accept & last, DONE, code)

    old = (*m.back, m.here)
    if m.record is not None and trial.stages is not None:
        m = m._replace(record=noted(m.record, m.accepted + 2, (*old, trial.to), trial.stages, fallback))
    *back, here = jax.tree.map(lambda x, y: jnp.where(accept, x, y), (*old[1:], trial.to), old)
    distances = tuple(jnp.where(accept, x, y) for x, y in zip((*m.distances[1:], trial.distance), m.distances, strict=True))
    rate = jnp.where(accept & stepped, rate, m.rate)
    if lands is not None:
        # What a step was that was cut short, the next one may be again; behind a breakpoint nothing is known of what was before.
        h = jnp.where(accept & stepped & (step < CUT * m.h), jnp.maximum(h, m.h), h)
        h = jnp.where(begun & (tried > 0), CAUTIOUS * m.h, h)
        rate, *before = (jnp.where(begun, jnp.inf, x) for x in (rate, *distances[:-1]))
        distances = *before, distances[-1]
        assert m.steps is not None
        steps = jnp.where(m.steps < 0, m.steps + begun, m.steps + accept)
        m = m._replace(steps=jnp.where(accept & lands, -1, steps))
    m = m._replace(
        distances=distances,
        rate=rate,
        h=h,
        code=code,
        tried=tried,
        accepted=m.accepted + accept,
    )
    m = m._replace(evaluations=m.evaluations + jnp.where(judged, trial.evaluations, 0))
    if len(task.ts) > 2:
        until = jnp.where(accept & (m.accepted > 0), undifferentiated(trial.to.t), -jnp.inf)
        if lands is not None:  # those on a breakpoint, too, between the end of this step and the next start
            enough = ~begun & ((steps >= POINTS - 1) | lands | last)
            beyond = jnp.where(lands, GAP * task.smallest, 0.0)
            until = jnp.where(enough, until + undifferentiated(beyond), -jnp.inf)
        m = _write(task, m, (*old, here), until)
    return m._replace(here=here, back=tuple(back))


def _leave(task: Task, m: March, trial: Trial, lands: Array, judged: Array, step: Array) -> tuple[March, Array, Array]:
    """What becomes of a step that ends in another piece of the motion: whether it lands there, or is taken again.

    It is taken again to end just before the piece does. The next step is a tiny one across, behind which the run starts anew: so
    also what is known of accelerations at the ends of steps, their derivatives, belongs to one piece.
    """
    assert task.piece is not None and m.crossing is not None and m.steps is not None
    assert m.aim is not None and m.tries is not None
    here, to = undifferentiated((m.here, trial.to))
    moved = jnp.any(task.piece(*to[:3]) != task.piece(*here[:3]), axis=0)
    leaves = judged & (m.steps >= 0) & moved & jnp.isfinite(trial.error)
    share = when(jnp.any(leaves), lambda _: share_before(task.piece, here, to), jnp.ones_like(step))
    again = leaves & (m.aim != AIM_ACROSS) & (m.tries < TRIES)
    exact = jnp.minimum(share, 1.0 - share) <= EXACT
    lands |= leaves & ~again
    short = (to.t < m.crossing - task.smallest) & ~lands
    reached = judged & (trial.error < 1.0) & ~leaves & ~short & (m.aim == AIM_BEFORE)
    across = reached | (again & (share <= EDGE))
    aim = jnp.where(again, jnp.where(exact, AIM_BEFORE, AIM_BEYOND), jnp.where(short, m.aim, AIM_BEYOND))
    crossing = here.t + jnp.where(exact, share - EDGE / 2, share + EXACT / 2) * step
    crossing = jnp.where(again, crossing, jnp.where(short, m.crossing, jnp.inf))
    crossing = jnp.where(across, jnp.where(reached, to.t, here.t) + EDGE * m.h, crossing)
    m = m._replace(
        crossing=jnp.where(judged, crossing, m.crossing),
        aim=jnp.where(judged, jnp.where(across, AIM_ACROSS, aim), m.aim),
        tries=jnp.where(again, m.tries + 1, jnp.where(judged & (trial.error < 1.0), 0, m.tries)),
    )
    return m, lands, again


def _factor(task: Task, m: March, error: Array, step: Array, accept: Array) -> tuple[Array, Array]:
    """How many times as long the next step is; and the rate of this one's error."""
    order = task.method.order
    error = jnp.where(jnp.isfinite(error), jnp.maximum(error, 1e-30), 1e30)
    rate = error / step ** int(order)
    foreseen = error * jnp.minimum(rate / m.rate, STEEPEST)
    steep = accept & (foreseen > 1.0)
    aim = jnp.where(steep, foreseen * (SAFETY**order / FORESEEN), error)
    factor = SAFETY * jnp.exp(jnp.log(aim) * (-1.0 / order))
    return jnp.clip(factor, jnp.where(accept & ~steep, 1.0, SHRINK), jnp.where(accept, GROW, SAFETY)), rate


def _far(task: Task, m: March, distance: Array, rounding: float = BEFORE) -> Array:
    """Whether a step as long as the one that is tried may begin so far away from singular configurations."""
    return far(distance, m.h * task.rate, undifferentiated(tolerance(task, m.here.v)), rounding)


def _past(task: Task, m: March, trial: Trial) -> Array:
    """Whether a step ends behind the singular configuration ahead, far enough."""
    return passed(_ahead(m), m.h, m.distances[-1], trial.distance) & _far(task, m, trial.distance, PAST)


def _around(task: Task, m: March, step: Array, otherwise: Array) -> Array:
    """In place of a step that failed, one around the singular configuration ahead, or else `otherwise`."""
    low, _ = task.method.clearings
    left = _ahead(m)
    return around(task.method, left, step, _far(task, m, m.distances[-1] * low * step / left), otherwise)


def _ahead(m: March) -> Array:
    return ahead(tuple(undifferentiated(point.t) for point in (*m.back, m.here)), m.distances)


def _first_step(task: Task, start: Point) -> Array:
    """The first step: as given, or chosen."""
    span = task.ts[-1] - task.ts[0]
    if task.h is not None:
        return jnp.minimum(task.h, undifferentiated(span))
    y, slope = jnp.concatenate([start.q, start.v]), jnp.concatenate([start.v, start.a])
    return first_step(y, slope, span, task.rtol, task.atol, jnp.concatenate(task.units))


# --- outputs


def _write(task: Task, m: March, points: tuple[Point, ...], until: Array) -> March:
    """Interpolate between accepted states at the output times that are not yet written."""
    inner, lanes = len(task.ts) - 2, m.code.shape
    times = jnp.concatenate([task.ts[1:-1], jnp.broadcast_to(task.ts[-1], (BLOCK, *task.ts.shape[1:]))])

    def block(written: Array) -> Array:
        if times.ndim == 1:
            return times[written + jnp.arange(BLOCK).reshape(BLOCK, *[1] * len(lanes))]
        return jnp.take_along_axis(times, written + jnp.arange(BLOCK)[:, None], axis=0)

    def behind(written: Array) -> Array:
        number = written + jnp.arange(BLOCK).reshape(BLOCK, *[1] * len(lanes))
        return jnp.sum((block(written) <= until) & (number < inner), axis=0)

    def due(state: tuple[Array, Array]) -> tuple[Array, Array]:
        # What XLA does not know to be the points themselves: else it would make polynomials of them where no output is due, too.
        known = jax.tree.map(lambda x: jnp.where(state[0] >= 0, x, 0.0), points)
        return jax.lax.while_loop(lambda state: jnp.any(behind(state[0]) > 0), partial(more, known), state)

    def more(points: tuple[Point, ...], state: tuple[Array, Array]) -> tuple[Array, Array]:
        written, outputs = state
        states = interpolated(points, block(written))
        if not lanes:
            return written + behind(written), jax.lax.dynamic_update_slice(outputs, states, (written, 0))

        def lane(k, outputs):
            block = jax.lax.dynamic_index_in_dim(states, k, axis=-1, keepdims=False)
            return jax.lax.dynamic_update_slice(outputs, block[None], (k, written[k], 0))

        return written + behind(written), jax.lax.fori_loop(0, lanes[0], lane, outputs)

    state = m.written, m.outputs
    written, outputs = when(jnp.any(behind(m.written) > 0), due, state)
    return m._replace(written=written, outputs=outputs)
