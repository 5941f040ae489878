"""One step of an explicit Runge-Kutta method for q'' = a(t, q, v): its stages, its end, and the error of that.

The equations of the stages are in explicit.py, which takes one step after another.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.equations.motion import Tangential
from udkjax.integrate.interpolation import Point
from udkjax.integrate.norms import all_finite, largest
from udkjax.integrate.undifferentiated import undifferentiated
from udkjax.native.tableau import Method
from udkjax.straightline import cut, when

CHAINS = 4  # sums that a sum over stages is made of, none of which waits for another


class Trial(NamedTuple):
    """A step that was tried."""

    to: Point
    error: Array  # the largest error of any coordinate or velocity, relative to its tolerance
    distance: Array  # of its end from singular configurations
    evaluations: Array
    stages: Array | None = None  # accelerations (stages, n) of its stages, for the record


class Task(NamedTuple):
    """What to march along. Numbers are one for each lane, or one for all."""

    accelerations: Callable[..., Array]  # of lanes: (t, q, v) -> a
    arrived: Callable[..., tuple[Array, Array, Array]]  # where a step ends: (t, q, v) -> q, v on the manifold, and a
    lasting: Callable[..., Tangential]  # (t, q, v, error of q, error of v) -> the errors as they count
    ended: Callable[..., tuple[Array, Array, Array, Tangential]]  # both: (t, q, v, error of q, error of v) -> q, v, a, errors
    fallback: Callable[..., Trial] | None  # takes a step again, by equations that may branch; None: the lane ends as `DOUBTED`
    doubts: bool  # whether accelerations that are not a number mean that a step wants care
    ts: Array  # (T, *lanes)
    rtol: Array
    atol: Array
    units: tuple[Array, Array]  # of q and of v, which `atol` is relative to
    rate: Array
    smallest: Array  # step
    h: Array | None  # the first step; None: chosen
    max_steps: int
    method: Method
    recorded: bool = False  # whether the steps are kept, of a run that is not one of several lanes
    breakpoints: Array | None = None  # (K, *lanes) times where the motion is not smooth
    piece: Callable[..., Array] | None = None  # of lanes: (t, q, v) -> in which of its smooth pieces each element is (k, *lanes)


def attempt(task: Task, here: Point, h: Array, t1: Array, begin: Array) -> Trial:
    """One step of all lanes; where they `begin`, only the accelerations at its end."""
    last = task.method.stages

    def stage(i, carry):
        a, *into = carry
        t, q, v = stage_state(task.method, here, h, a, i, into)
        return jax.lax.dynamic_update_index_in_dim(a, task.accelerations(t, q, v), i, 0), q, v

    a = jnp.zeros((last, *here.a.shape), here.a.dtype).at[0].set(here.a)
    start = jnp.where(jnp.all(begin), last, 1)
    a, *_ = jax.lax.fori_loop(start, last, stage, (a, here.q, here.v))
    _, *end = stage_state(task.method, here, h, a, last)
    if task.method.ends:
        q, v, new = task.arrived(t1, *end)
        left = task.lasting(t1, q, v, *errors(task.method, h, a, new))
    else:
        q, v, new, left = task.ended(t1, *end, *errors(task.method, h, a))
    return judged(task, here, Point(t1, q, v, new), left, a, jnp.where(begin, 1, last))


def stage_state(
    method: Method, here: Point, h: Array, a: Array, i: Any, into: Sequence[Array] = ()
) -> tuple[Array, Array, Array]:
    """t, q and v of stage i > 0, from the accelerations (stages, n, *lanes) of those before; the last is the end of the step.

    Two of three coefficients are zero. A single run takes all as they come; in lanes, where the accelerations do not fit into the
    fastest memory, each stage has sums of its own, of what is not zero. They replace what is in `into`.
    """

    def state(node: Any, row_q: Any, row_v: Any) -> tuple[Array, Array]:
        stages = a[: method.stages]  # here, not before: what a branch takes from outside is made for each
        return here.q + h * (node * here.v + h * _combine(row_q, stages)), here.v + h * _combine(row_v, stages)

    tableau = (method.nodes, method.q, method.v)
    known = isinstance(i, int)
    node, *rows = (c[i] if known else jax.lax.dynamic_index_in_dim(jnp.asarray(c), i, keepdims=False) for c in tableau)
    if known or not here.t.shape:
        return here.t + node * h, *cut(state(node, *rows))
    q, v = into
    for k, row in enumerate(zip(*tableau, strict=True)):
        q, v = when(i == k, lambda _, row=row: state(*row), (q, v)) if k else (q, v)
    return here.t + node * h, q, v


def errors(method: Method, h: Array, a: Array, end: Array | None = None) -> list[Array]:
    """Of q and v, from the accelerations of all stages; `end`: those after projection, where they are the last stage's."""
    a = a if end is None else a.at[-1].set(end)
    error_v = h * _combine(method.error_v, a)
    error_q = h * (h * _combine(method.error_q, a))
    return cut([error_q, error_v])


def judged(task: Task, here: Point, to: Point, left: Tangential, a: Array, evaluations: Any) -> Trial:
    """A step with what lasts of its errors."""
    size = jnp.maximum(_relative(task, 0, left.dq, here.q, to.q), _relative(task, 1, left.dv, here.v, to.v))
    size = jnp.where(all_finite(to.a), size, jnp.nan)
    evaluations = jnp.broadcast_to(jnp.asarray(evaluations), size.shape)
    a = a.at[-1].set(to.a) if task.method.ends else a
    return Trial(to, undifferentiated(size), undifferentiated(left.distance), evaluations, a if task.recorded else None)


def _combine(weights: Any, a: Array) -> Array:
    """sum_j weights_j a_j. Not a product of matrices, for which XLA writes a loop that does not vectorize."""
    known = isinstance(weights, np.ndarray)
    terms = [w * x for w, x in zip(weights, a, strict=True) if not known or w != 0] or [jnp.zeros_like(a[0])]
    total: Any = sum(sum(terms[k::CHAINS]) for k in range(min(CHAINS, len(terms))))
    return cut([total])[0] if a.ndim > 2 else total


def tolerance(task: Task, v: Array) -> Array:
    """What the fastest velocity may err, in its unit."""
    return task.atol + task.rtol * largest(jnp.abs(v) / task.units[1])


def _relative(task: Task, which: int, error: Array, y0: Array, y1: Array) -> Array:
    scale = task.atol * task.units[which] + task.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1))
    return largest(jnp.abs(error) / scale)
