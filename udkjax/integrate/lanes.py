"""Which engine a run by an explicit Runge-Kutta method gets: one march, or, under vmap, marches in lanes.

A batch is cut into chunks of lanes that fill the vector units and stay in the cache; chunk follows chunk, so that a member waits
for the slowest of its own chunk alone. The rare step that needs care is taken by one lane at a time, behind a branch.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from udkjax.equations.motion import Motion, Tangential
from udkjax.equations.rank_policy import REFUSE, drop_within
from udkjax.integrate.batched import CHUNKED, batched
from udkjax.integrate.explicit import March, march
from udkjax.integrate.interpolation import Point
from udkjax.integrate.norms import largest
from udkjax.integrate.outcome import stopped
from udkjax.integrate.pieces import Pieces
from udkjax.integrate.problem import Problem, Raw
from udkjax.integrate.projection import ended, lasting, violation
from udkjax.integrate.step import Task, Trial, errors, judged, stage_state
from udkjax.integrate.tableau import is_explicit, method_of
from udkjax.integrate.undifferentiated import undifferentiated
from udkjax.native.steps import DONE
from udkjax.straightline import Loop, apart, cut, when

ROUND = 8  # lanes: what the widest vector units hold
STEPS = 7  # to an output: where two branches of the manifold meet, Newton's method halves the distance in each
FEW_STEPS = 3  # the last of which usually moves nothing
LANES = 64  # with 16 or 32 a lane of the paper's linkage takes longer, with 128 no less
# A single run has its outputs projected side by side, too, where that fills vectors and does not take long to compile.
FEW_OUTPUTS, FEW_BODIES = 16, 12
FEW_NUMBERS = 10**6  # of outputs: far below the gigabyte from which on XLA makes no function of a loop


def serves(problem: Problem) -> bool:
    """Whether a problem can be integrated here: by an explicit Runge-Kutta method with an error estimate, all of q and v."""
    return is_explicit(problem.solver) and type(problem.equations).rates is Motion.rates


def solve(problem: Problem) -> Raw:
    """Integrate one problem; under vmap, as many as there are."""
    return batched(problem, _single, _many)


def _single(problem: Problem) -> Raw:
    return _marched(problem, Lanes(problem.equations))


def _many(arrays: Any, batched: Any, static: Any, size: int) -> Raw:
    """Chunks of lanes, one after another; the last is filled up with copies of the last member."""
    chunks = -(-size // LANES)
    lanes = min(-(-size // (chunks * ROUND)) * ROUND, LANES)
    places = jnp.minimum(jnp.arange(chunks * lanes), size - 1).reshape(chunks, lanes)
    axes = jax.tree.map(lambda b: 0 if b else None, batched)

    def chunk(places: Array) -> Raw:
        places = apart(places)
        members = jax.tree.map(lambda x, b: x[places] if b else x, arrays, batched)
        return _in_lanes(eqx.combine(members, static), eqx.combine(axes, static), lanes)

    raw = jax.lax.map(chunk, places)
    # One by one: what nobody uses is not kept. What is done to each of them as it is XLA does in place.
    return Raw(*(cut([x.reshape(-1, *x.shape[2:])[:size]])[0] for x in raw))


def _in_lanes(problem: Problem, axes: Any, size: int) -> Raw:
    """A chunk: what differs from lane to lane has the lanes first, and so has the result."""

    def last(x: Array, axis: int | None) -> Array:
        return x if axis is None else jnp.moveaxis(x, 0, -1)

    def every(x: Array, axis: int | None) -> Array:
        return jnp.broadcast_to(x[..., None], (*x.shape, size)) if axis is None else last(x, axis)

    lanes = Lanes(problem.equations, axes.equations, size, axes_of_pieces=axes.pieces)
    problem = dataclasses.replace(problem, ts=last(problem.ts, axes.ts), q=every(problem.q, axes.q), v=every(problem.v, axes.v))
    if problem.breakpoints is not None:
        problem = dataclasses.replace(problem, breakpoints=last(problem.breakpoints, axes.breakpoints))
    raw = _marched(problem, lanes)
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), raw)


class Lanes:
    """Equations evaluated for one state, or for lanes of states (n, L), with equations of their own where `axes` says so."""

    def __init__(
        self,
        equations: Motion,
        axes: Any = None,
        size: int | None = None,
        loop: Loop | None = None,
        axes_of_pieces: Any = None,
    ):
        self.equations, self.size, self.shape = equations, size, () if size is None else (size,)
        self._arrays, self._static = eqx.partition(equations, eqx.is_array)
        self._axes, self._loop, self._axes_of_pieces = axes, loop, axes_of_pieces

    def within(self, loop: Loop | None) -> "Lanes":
        """The same, whose programs run in this loop where they are evaluated for all lanes."""
        return Lanes(self.equations, self._axes, self.size, loop, self._axes_of_pieces)

    def over(self, function: Callable, *states: Array) -> Any:
        """`function(equations, t, q, v)` of each lane."""

        def lane(arrays, *state):
            equations = eqx.combine(arrays, self._static)
            return function(equations if self._loop is None else equations.within(self._loop), *state)

        if self.size is None:
            return lane(self._arrays, *states)
        return jax.vmap(lane, in_axes=(self._axes, *[-1] * len(states)), out_axes=-1)(self._arrays, *states)

    def piece(self, pieces: Pieces, *states: Array) -> Array:
        """In which pieces the state of each lane is."""
        if self.size is None:
            return pieces(*states)
        arrays, static = eqx.partition(pieces, eqx.is_array)
        axes = jax.tree.map(lambda axis: axis if type(axis) is int else None, self._axes_of_pieces)
        lane = lambda arrays, *state: eqx.combine(arrays, static)(*state)  # noqa: E731
        return jax.vmap(lane, in_axes=(axes, *[-1] * len(states)), out_axes=-1)(arrays, *states)

    def each(self, which: Array, function: Callable, otherwise: Any, *states: Any) -> Any:
        """`function(equations, *states)` of the lanes in question, one at a time; the others get what is `otherwise`."""

        def first(carry):
            left, found = carry
            if self.size is None:
                return jnp.zeros_like(left), function(self.equations, *states)
            k = jnp.argmax(left)
            arrays = jax.tree.map(lambda x, axis: x if axis is None else x[k], self._arrays, self._axes)
            mine = function(eqx.combine(arrays, self._static), *jax.tree.map(lambda x: x[..., k], states))
            return left.at[k].set(False), jax.tree.map(lambda x, y: x.at[..., k].set(y), found, mine)

        return jax.lax.while_loop(lambda carry: jnp.any(carry[0]), first, (which, otherwise))[1]


def _marched(problem: Problem, lanes: Lanes) -> Raw:
    return raw_of(problem, lanes, march(task_of(problem, lanes), problem.q, problem.v, number_of(problem.equations)))


def task_of(problem: Problem, lanes: Lanes, recorded: bool = False) -> Task:
    """What to march along."""
    over = lanes.within(None if recorded else _loop_of(problem, lanes)).over
    task = Task(
        partial(over, lambda e, t, q, v: e.with_policy(REFUSE).accelerations(t, q, v)),
        partial(over, lambda e, t, q, v: e.with_policy(REFUSE).arrived(t, q, v)),
        partial(over, lasting),
        partial(over, ended),
        None,
        problem.equations.branches,
        *(problem.ts, problem.rtol, problem.atol, problem.units(lanes.shape), problem.rate, problem.smallest),
        *(problem.h, problem.max_steps, method_of(problem.solver)),
        recorded,
    )
    if problem.breakpoints is not None:
        shared = problem.breakpoints.ndim == 1 and lanes.size is not None
        task = task._replace(breakpoints=problem.breakpoints[:, None] if shared else problem.breakpoints)
    if problem.pieces is not None:
        task = task._replace(piece=partial(lanes.piece, problem.pieces))
    if not problem.projected:

        def as_it_is(t: Array, q: Array, v: Array) -> tuple[Array, Array, Array]:
            return q, v, task.accelerations(t, q, v)

        task = task._replace(arrived=as_it_is, lasting=_all_of_it)
        task = task._replace(ended=lambda t, q, v, dq, dv: (*as_it_is(t, q, v), _all_of_it(t, q, v, dq, dv)))
    if problem.equations.branches and problem.fallback:
        task = task._replace(fallback=partial(_fallback_step, task, problem.projected, lanes))
    return task


def number_of(equations: Motion) -> Array:
    """One that is there once all of some equations are."""
    some = [x.ravel()[0] for x in jax.tree.leaves(equations) if eqx.is_inexact_array(x) and x.size]
    return sum(some, jnp.zeros(()))


def _loop_of(problem: Problem, lanes: Lanes) -> Loop | None:
    few = len(problem.ts) * len(problem.q) * (lanes.size or 1) <= FEW_NUMBERS
    return Loop(lanes.size is not None) if few else None


def _all_of_it(t: Array, q: Array, v: Array, dq: Array, dv: Array) -> Tangential:
    """Errors where nothing takes any of them back."""
    return Tangential(dq, dv, jnp.full(t.shape, jnp.inf))


def raw_of(problem: Problem, lanes: Lanes, m: March) -> Raw:
    """What a march leaves behind, with the outputs on the manifold."""
    inner, end = len(problem.ts) - 2, jnp.concatenate([m.here.q, m.here.v])

    def outputs(given: tuple[Array, Array]) -> tuple[Array, Array]:
        first = lanes.over(violation, jnp.broadcast_to(problem.ts[0], lanes.shape), start)
        each, ys = partial(_output, problem if problem.projected else None), given[0][..., 1:, :]
        ys, violated = _each_output(lanes, each, problem.ts[1:], ys, wide=problem.fallback)
        ys = jnp.concatenate([start.T[..., None, :], ys], axis=-2)
        violated = jnp.concatenate([first[..., None], violated], axis=-1)
        return (ys, violated) if lanes.size is None else (jnp.moveaxis(ys, 0, -1), violated.T)

    start = jnp.concatenate([problem.q, problem.v])
    ys = jnp.concatenate([start.T[..., None, :], m.outputs[..., :inner, :], end.T[..., None, :]], axis=-2)
    given = ys, ys[..., 0]  # in place of violations, which are as many
    ys, violated = when(m.tried >= 0, outputs, given) if lanes.size is None else outputs(given)
    number = jnp.arange(inner + 2).reshape(-1, *[1] * len(lanes.shape))
    reached = (number <= m.written) & (number <= inner) | (m.code == DONE)
    q, v = jnp.split(ys, 2, axis=1)
    span = jnp.broadcast_to(problem.ts[-1] - problem.ts[0], lanes.shape)
    status = lanes.over(stopped, span, m.code, m.here.t, end)
    return Raw(q, v, violated, reached, status, m.here.t, end, m.tried, m.accepted, m.evaluations)


# --- with care


def _fallback_step(
    task: Task, projected: bool, lanes: Lanes, doubt: Array, here: Point, h: Array, t1: Array, begin: Array
) -> Trial:
    """A step taken again of the lanes in doubt: by a method that looks at all rows where elimination finds nothing."""
    stages = task.method.stages

    def one(equations: Motion, here: Point, h: Array, t1: Array, begin: Array, rtol: Array, atol: Array, units: Any) -> Trial:
        def stage(equations: Motion, carry: Any) -> Any:
            i, a, _, _, _ = carry
            t, q, v = stage_state(task.method, here, h, a[:stages], i)
            t = jnp.where(i == stages, t1, t)
            if projected:
                q, v = when(i == stages, lambda x: equations.project(t, *x), (q, v))
            found = equations.accelerations(t, q, v)
            return i + 1, jax.lax.dynamic_update_index_in_dim(a, found, i, 0), q, v, ~jnp.all(jnp.isfinite(found))

        def more(carry: Any) -> Any:  # a loop that XLA compiles into one function, and what it cannot
            quick = equations.with_policy(REFUSE).within(Loop())
            carry = jax.lax.while_loop(lambda c: (c[0] <= stages) & ~c[-1], partial(stage, quick), carry)
            return jax.lax.cond(carry[-1], again, lambda c: c, carry)

        def again(carry: Any) -> Any:
            i, a, *state = carry
            a = a.at[i - 1].set(0.0)  # what is not a number would be none with a weight of 0, too
            return *stage(equations.rank_revealing, (i - 1, a, *state))[:-1], jnp.array(False)

        start, none = jnp.where(begin, stages, 0), jnp.zeros((stages + 1, *here.a.shape))
        first = start, none, here.q, here.v, jnp.array(False)
        _, a, q1, v1, _ = jax.lax.while_loop(lambda c: c[0] <= stages, more, first)
        mine, evaluations = task._replace(rtol=rtol, atol=atol, units=units), jnp.where(begin, 2, 2 * stages + 1)
        to, found = Point(t1, q1, v1, a[stages]), a[:stages]
        final = partial(lasting, equations) if projected else _all_of_it
        left = final(t1, q1, v1, *errors(task.method, h, found, to.a if task.method.ends else None))
        return judged(mine, here._replace(a=a[0]), to, left, found, evaluations)

    tolerances = (jnp.broadcast_to(x, h.shape) for x in (task.rtol, task.atol))
    unknown = jnp.zeros((stages, *here.a.shape)) if task.recorded else None
    nothing = Trial(here, jnp.full(h.shape, jnp.inf), jnp.zeros(h.shape), jnp.zeros(h.shape, int), unknown)
    units = tuple(jnp.broadcast_to(unit, here.q.shape) for unit in task.units)
    return lanes.each(doubt, one, nothing, here, h, t1, begin, *tolerances, units)


# --- outputs


def _each_output(lanes: Lanes, function: Callable, ts: Array, ys: Array, wide: bool) -> Any:
    """`function(steps, lanes, t, y)` of states ys (*lanes, T, 2n), one time after another: that is faster than all at once.

    `wide` takes the times of a single run as so many lanes, which takes longer to compile.
    """
    count, n = ys.shape[-2:]
    few = count < FEW_OUTPUTS or n > 6 * FEW_BODIES
    if lanes.size is not None or few or not wide or jax.default_backend() not in CHUNKED:

        def one(k: Array, found: Any) -> Any:
            y = jax.lax.dynamic_index_in_dim(found[0], k, axis=-2, keepdims=False)
            y, violated, _ = function(STEPS, lanes, jnp.broadcast_to(ts[k], lanes.shape), y.T)
            return (
                jax.lax.dynamic_update_index_in_dim(found[0], y.T, k, axis=-2),
                jax.lax.dynamic_update_index_in_dim(found[1], violated, k, axis=-1),
            )

        return jax.lax.fori_loop(0, count, one, (ys, jnp.zeros((*lanes.shape, count), ys.dtype)))
    return _side_by_side(lanes.equations, function, ts, ys)


def _side_by_side(equations: Motion, function: Callable, ts: Array, ys: Array) -> tuple[Array, Array]:
    """The same of a single run's states, as many at once as there are lanes.

    All have a few steps of Newton's method, and then those that still move some more: they would hold up the others.
    """
    count = len(ys)
    chunks = -(-count // LANES)
    width = -(-count // (chunks * ROUND)) * ROUND
    times = Lanes(equations, None, width)

    def more(state: Any) -> Any:
        tries, waiting, queue, ys, violated = state

        def chunk(k: Array, state: Any) -> Any:
            number = k * width + jnp.arange(width)
            places = jnp.where(number < waiting, jax.lax.dynamic_slice(queue, (k * width,), (width,)), queue[k * width])
            found, worst, moving = function(FEW_STEPS, times, ts[places], state[2][places].T)

            def lane(i: Array, state: Any) -> Any:
                left, again, ys, violated = state
                ys = jax.lax.dynamic_update_slice(ys, found[:, i][None], (places[i], 0))
                again, violated = again.at[left].set(places[i]), violated.at[places[i]].set(worst[i])
                return left + (moving[i] & (number[i] < waiting)), again, ys, violated

            return jax.lax.fori_loop(0, width, lane, state)

        return tries + 1, *jax.lax.fori_loop(0, -(-waiting // width), chunk, (jnp.zeros_like(waiting), queue, ys, violated))

    start = jnp.array(0), jnp.array(count), jnp.arange(chunks * width), ys, jnp.zeros(count, ys.dtype)
    return jax.lax.while_loop(lambda state: (state[0] * FEW_STEPS < STEPS) & (state[1] > 0), more, start)[3:]


def _output(problem: Problem | None, steps: int, lanes: Lanes, t: Array, y: Array) -> tuple[Array, Array, Array]:
    """Interpolated states (2n, *lanes), returned to the manifold; how they violate the constraints; whether they still moved."""
    moving = jnp.zeros(lanes.shape, bool)
    if problem is not None:
        tol = jnp.broadcast_to(output_tolerance(problem, y), lanes.shape)
        inside = lanes.within(Loop(lanes.size is not None))  # what closes it is a loop
        q, v, moving = inside.over(
            lambda e, t, y, tol: e.with_policy(drop_within(tol)).closed(t, *jnp.split(y, 2), steps), t, y, tol
        )
        y = jnp.concatenate([q, v])
    return y, lanes.over(violation, t, y), moving


def output_tolerance(problem: Problem, y: Array) -> Array:
    """What the fastest velocity of a state (2n, *lanes) may err, in its unit."""
    v = y[len(y) // 2 :]
    unit = problem.units(y.shape[1:])[1]
    return undifferentiated(problem.atol + problem.rtol * largest(jnp.abs(v) / unit))
