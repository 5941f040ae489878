"""Reverse mode: the steps of a recorded run, walked back.

A step leads from point k - 1 to point k. Its size is frozen, so that the cotangents are those of the states that the run has
found, to rounding. With the stages' accelerations a_i at hand, no stage has to be taken again; with q*, v*, a* for the cotangents
of q, v, a,

    q*_i, v*_i = (da/dq, da/dv)(t + c_i h, q_i, v_i)^T a*_i          stage by stage from the last to the first,
    a*_j += h^2 (A A)_ij q*_i + h A_ij v*_i,      q* += q*_i,      v* += h c_i q*_i + v*_i,

after the transposed projection at the end of the step. An output hands its cotangent to the four points that its polynomial goes
through. As in the march, the loop over the steps holds no branch; a step that was taken with care is walked back in the loop
around it, and so are the steps made again that the record no longer holds.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.equations.rank_policy import REFUSE
from udkjax.integrate.breakpoints import breakpoint_at, is_new_start
from udkjax.integrate.explicit import BLOCK
from udkjax.integrate.interpolation import Point
from udkjax.integrate.lanes import Lanes, task_of
from udkjax.integrate.problem import Problem, Raw
from udkjax.integrate.record import BEHIND, Record, as_point, noted
from udkjax.integrate.replay_outputs import Equations, Sums, Walk, of_outputs, of_points
from udkjax.integrate.step import Task, attempt, stage_state
from udkjax.native.steps import DONE, POINTS
from udkjax.straightline import when


def walked_back(problem: Problem, moving: Problem, raw: Raw, record: Record, ys: Array, y: Array) -> Problem:
    """From the cotangents of `Raw.q` and `Raw.v`, side by side, and of `Raw.y` to those of what `moving` has of the problem."""
    task, n = task_of(problem, Lanes(problem.equations), recorded=True), len(problem.q)
    timed = moving.ts is not None or moving.breakpoints is not None
    equations = Equations(problem.equations, moving.equations, timed)
    sums = Sums(*jax.tree.map(jnp.zeros_like, (moving.equations, moving.ts, moving.breakpoints)))
    outputs = jnp.where(raw.reached[:, None], ys, 0.0)
    first, outputs = outputs[0], outputs[1:]
    if problem.projected:
        # Of one output alone XLA would make no function, but start each operation by itself.
        sums, outputs = when(raw.accepted >= 0, lambda x: of_outputs(problem, raw, equations, *x), (sums, outputs))
    done, inner = raw.status == DONE, len(problem.ts) - 2
    end = outputs[-1] + y
    outputs = jnp.concatenate([outputs[:inner], jnp.zeros((BLOCK, 2 * n))])
    k, kept = raw.accepted + 1, len(record.stages)
    window = jnp.zeros((POINTS, 3, n)).at[-1, :2].set(end.reshape(2, n))
    start = Walk(k, (k - 1) // kept, jnp.clip(jnp.sum(raw.reached) - 1, 0, inner), window, jnp.zeros(POINTS), sums)
    quick = partial(_step, problem, task, equations, outputs, (k, done), fallback=False)
    slow = partial(_step, problem, task, equations, outputs, (k, done), fallback=True)

    def rounds(carry: tuple[Walk, Record]) -> tuple[Walk, Record]:
        walk, record = carry
        head = record._replace(points=record.points.at[:BEHIND].set(record.marks[walk.segment]))
        base = walk.segment * kept
        walk = jax.lax.while_loop(lambda w: (w.k > base) & ~head.fallback[w.k], partial(quick, head), walk)
        if task.fallback is not None:
            walk = when((walk.k > base) & head.fallback[walk.k], partial(slow, head), walk)
        if len(record.marks) > 2:  # there are more steps than are kept
            again = partial(_again, task)
            segment = (walk.k - 1) // kept
            record = when((walk.k > 0) & (segment < walk.segment), lambda r: again(r, segment), record)
            walk = walk._replace(segment=segment)
        return walk, record

    walk, _ = jax.lax.while_loop(lambda c: c[0].k > 0, rounds, (start, record))
    numbers, ts = walk.sums.numbers, None if walk.sums.ts is None else walk.sums.ts.at[0].add(walk.t[-1])
    q, v = walk.window[-1, 0] + first[:n], walk.window[-1, 1] + first[n:]
    found = {"equations": numbers, "ts": ts, "q": q, "v": v, "breakpoints": walk.sums.breakpoints}
    asked = {name: x for name, x in found.items() if jax.tree.leaves(getattr(moving, name))}
    return dataclasses.replace(jax.tree.map(jnp.zeros_like, moving), **asked)


def _step(problem, task, equations, outputs, end, record, walk, fallback: bool) -> Walk:
    """The step to point k, walked back."""
    k, kept, method = walk.k, len(record.stages), task.method
    row = k - 1 - walk.segment * kept
    points = jax.lax.dynamic_slice_in_dim(record.points, row, POINTS)
    times = record.times[jnp.maximum(k - jnp.arange(BEHIND, -1, -1), 0)]
    window = tuple(as_point(times[i], points[i]) for i in range(POINTS))
    walk = of_points(problem, equations, outputs, window, walk, _since(problem, record, k, end[0], window))
    here, to = window[-2:]
    stages, h = jax.lax.dynamic_index_in_dim(record.stages, row, keepdims=False), to.t - here.t
    begin, timed = _begins(problem, k, here.t, to.t), equations.timed
    s = method.stages
    first = jnp.where(begin, s, 0 if fallback else 1)
    own = (lambda e: e) if fallback else (lambda e: e.with_policy(REFUSE))
    used = int(np.nonzero(np.any(method.v != 0, axis=0))[0].max())  # the last stage that the step makes use of

    def stage(c):
        i, sums, a, q_bar, v_bar, t_bar, h_bar = c
        t, q, v = stage_state(method, here, h, stages, i)
        last = i == s
        t = jnp.where(last, to.t, t)
        at = jnp.where(last, to.q, q), jnp.where(last, to.v, v)
        sums, dt, dq, dv = equations.pull(lambda e, *x: own(e).accelerations(*x), sums, t, *at, a[i])

        def ended(x):
            sums, dt, dq, dv = x
            dq, dv = dq + walk.window[-1, 0], dv + walk.window[-1, 1]
            if not problem.projected:
                return sums, dt, dq, dv
            sums, more, dq, dv = equations.pull(lambda e, *x: own(e).as_projected(*x), sums, to.t, to.q, to.v, (dq, dv))
            return sums, dt + more, dq, dv

        sums, dt, dq, dv = when(last, ended, (sums, dt, dq, dv))
        node, row_v, row_q = (jnp.asarray(x)[i] for x in (method.nodes, method.v, method.q))
        a = a.at[:s].add(h * (h * row_q[:, None] * dq + row_v[:, None] * dv))
        if timed:
            turn_q, turn_v = (jnp.tensordot(r, stages, 1) for r in (row_q, row_v))
            h_bar = h_bar + node * dt + dq @ (node * here.v + 2 * h * turn_q) + dv @ turn_v
            t_bar = t_bar + dt
        return jnp.where(last, used, i - 1), sums, a, q_bar + dq, v_bar + h * node * dq + dv, t_bar, h_bar

    a, zero = jnp.zeros((s + 1, len(here.q))).at[s].set(walk.window[-1, 2]), jnp.zeros(())
    none = jnp.zeros_like(here.q)
    start = (jnp.asarray(s), walk.sums, a, none, none, zero, zero)
    _, sums, a, q_bar, v_bar, t_bar, h_bar = jax.lax.while_loop(lambda c: c[0] >= first, stage, start)
    a0 = none if fallback else jnp.where(begin, 0.0, a[0])
    shifted = jnp.concatenate([jnp.zeros_like(walk.window[:1]), walk.window[:-1]])
    shifted = shifted.at[-1].add(jnp.stack([q_bar, v_bar, a0]))
    t = walk.t
    if timed:
        total, done = end
        # It ends at the last output time, or at a breakpoint; the others where their size takes them.
        last, ending = (k == total) & done, walk.t[-1] + h_bar
        if sums.ts is not None:
            sums = sums._replace(ts=sums.ts.at[-1].add(jnp.where(last, ending, 0.0)))
        if problem.breakpoints is not None:
            place, beside = breakpoint_at(problem.breakpoints, to.t, problem.smallest)
            beside &= ~begin & ~last
            if sums.breakpoints is not None:
                sums = sums._replace(breakpoints=sums.breakpoints.at[place].add(jnp.where(beside, ending, 0.0)))
            last |= beside
        t = jnp.concatenate([jnp.zeros(1), walk.t[:-1]]).at[-1].add(t_bar + jnp.where(last, -h_bar, walk.t[-1]))
    return Walk(k - 1, walk.segment, walk.left, shifted, t, sums)


def _begins(problem: Problem | Task, k: Array, before: Array, to: Array) -> Array:
    """Whether what leads to point k at time `to` is no step, but the start, or a new one."""
    return (k == 1) | is_new_start(before, to, problem.smallest) if _restarts(problem) else k == 1


def _restarts(problem: Problem | Task) -> bool:
    """Whether the run may start anew on its way."""
    pieces = problem.piece if isinstance(problem, Task) else problem.pieces
    return problem.breakpoints is not None or pieces is not None


def _since(problem: Problem, record: Record, k: Array, total: Array, window: tuple[Point, ...]) -> Array:
    """The time since when the step to point k, the last of the window, has written outputs."""
    if not _restarts(problem):
        return window[-2].t
    times = jnp.stack([point.t for point in window])
    before = record.times[jnp.maximum(k - POINTS, 0)]
    anew = is_new_start(jnp.append(before, times[:-1]), times, problem.smallest)
    next_time = record.times[jnp.minimum(k + 1, len(record.times) - 1)]
    enough = ~jnp.any(anew[1:]) | (k == total) | is_new_start(times[-1], next_time, problem.smallest)
    start = jnp.max(jnp.where(anew, times, -jnp.inf))  # the latest
    return jnp.where(jnp.any(anew), jnp.where(enough & ~anew[-1], start, jnp.inf), window[-2].t)


def _again(task: Task, record: Record, segment: Array) -> Record:
    """The steps of a segment, taken again from the points that were marked before it."""
    kept = len(record.stages)
    base = segment * kept
    times = record.times[jnp.maximum(base - jnp.arange(BEHIND - 1, -1, -1), 0)]
    window = tuple(as_point(times[i], record.marks[segment, i]) for i in range(BEHIND))

    def step(take: Callable, fallback: bool, c: Any) -> Any:
        k, window, record = c
        here, t1 = window[-1], record.times[k]
        trial = take(here, t1 - here.t, t1, _begins(task, k, here.t, t1))
        record = noted(record, k, (*window, trial.to), trial.stages, fallback)
        return k + 1, (*window[1:], trial.to), record

    def inside(c: Any) -> Array:
        return c[0] <= base + kept

    def rounds(c: Any) -> Any:
        c = jax.lax.while_loop(lambda c: inside(c) & ~c[2].fallback[c[0]], partial(step, partial(attempt, task), False), c)
        if task.fallback is None:
            return c
        fallback = partial(task.fallback, jnp.array(True))
        return when(inside(c) & c[2].fallback[c[0]], partial(step, fallback, True), c)

    return jax.lax.while_loop(inside, rounds, (base + 1, window, record))[2]
