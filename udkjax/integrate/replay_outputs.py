"""Reverse mode: what outputs hand to the points of a recorded run, and what all of the walk back adds up."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from udkjax.equations.motion import Motion
from udkjax.equations.rank_policy import drop_within
from udkjax.integrate.explicit import BLOCK
from udkjax.integrate.interpolation import Point, interpolated
from udkjax.integrate.lanes import output_tolerance
from udkjax.integrate.problem import Problem, Raw
from udkjax.integrate.record import as_array, as_point
from udkjax.native.steps import POINTS


class Sums(NamedTuple):
    """Cotangents that every evaluation adds to: of the numbers in the equations, of all times, and of breakpoints, or None."""

    numbers: Any
    ts: Float[Array, "T"] | None
    breakpoints: Float[Array, "k"] | None


class Walk(NamedTuple):
    """Where the way back stands: at point k, with the cotangents of what led there."""

    k: Int[Array, ""]
    segment: Int[Array, ""]  # of the steps that the record now holds
    left: Int[Array, ""]  # how many inner output times lie before
    window: Float[Array, "4 3 n"]  # cotangents of q, v and a of the points k - 3 ... k
    t: Float[Array, "4"]  # of their times
    sums: Sums


class Equations:
    """The equations of a problem, transposed along the numbers that are `moving`, along q and v, and, if `timed`, t."""

    def __init__(self, equations: Motion, moving: Any, timed: bool):
        self.all, self.moving, self.timed = equations, moving, timed

    def pull(self, function: Callable, sums: Sums, t: Any, q: Array, v: Array, bars: Any) -> tuple[Sums, Any, Array, Array]:
        """`function(equations, t, q, v)`: the sums with what it adds, and the cotangents of t (or 0.0), q and v."""

        def of_moving(moving: Any, q: Array, v: Array, t: Array = t) -> Any:
            return function(eqx.combine(moving, self.all), t, q, v)

        _, back = jax.vjp(of_moving, self.moving, q, v, *([t] if self.timed else []))
        numbers, q, v, *t_bar = back(bars)
        sums = sums._replace(numbers=jax.tree.map(jnp.add, sums.numbers, numbers))
        return sums, (t_bar[0] if self.timed else jnp.zeros(())), q, v


def of_outputs(problem: Problem, raw: Raw, equations: Equations, sums: Sums, bars: Array) -> tuple[Sums, Array]:
    """Of the outputs before they were projected: the derivative of the projection is that at the state that it returns."""

    def one(sums: Sums, x: Any) -> tuple[Sums, Array]:
        k, t, y, bar, reached = x
        q, v = jnp.split(jnp.where(reached, y, jnp.concatenate([problem.q, problem.v])), 2)
        both = tuple(jnp.split(bar, 2))
        tol = output_tolerance(problem, jnp.concatenate([q, v]))
        found, t_bar, q, v = equations.pull(lambda e, *x: e.with_policy(drop_within(tol)).as_projected(*x), sums, t, q, v, both)
        if found.ts is not None:
            found = found._replace(ts=found.ts.at[k].add(t_bar))
        sums, bar = jax.tree.map(lambda x, y: jnp.where(reached, x, y), (found, jnp.concatenate([q, v])), (sums, bar))
        return sums, bar

    rows = (jnp.arange(1, len(problem.ts)), problem.ts[1:], jnp.concatenate([raw.q, raw.v], axis=1)[1:], bars, raw.reached[1:])
    return jax.lax.scan(one, sums, rows)


def of_points(
    problem: Problem, equations: Equations, outputs: Array, points: tuple[Point, ...], walk: Walk, since: Array
) -> Walk:
    """The outputs on the polynomial of a step, those since some time, hand their cotangents to its points."""
    inner = len(problem.ts) - 2
    if not inner:
        return walk
    times = jnp.concatenate([problem.ts[1:-1], jnp.broadcast_to(problem.ts[-1], (BLOCK,))])

    def behind(walk: Walk) -> tuple[Array, Array]:
        start = jnp.maximum(walk.left - BLOCK, 0)
        number = start + jnp.arange(BLOCK)
        return start, (number < walk.left) & (jax.lax.dynamic_slice_in_dim(times, start, BLOCK) > since)

    def more(walk: Walk) -> Walk:
        start, which = behind(walk)
        bars = jnp.where(which[:, None], jax.lax.dynamic_slice_in_dim(outputs, start, BLOCK), 0.0)
        at = jnp.where(which, jax.lax.dynamic_slice_in_dim(times, start, BLOCK), points[-1].t)
        ts = jnp.stack([p.t for p in points])

        def polynomial(window: Array, ts: Array = ts, at: Array = at) -> Array:
            return interpolated(tuple(as_point(ts[i], window[i]) for i in range(POINTS)), at)

        window = jnp.stack([as_array(p) for p in points])
        _, back = jax.vjp(polynomial, window, *([ts, at] if equations.timed else []))
        found, *more = back(bars)
        walk = walk._replace(left=walk.left - jnp.sum(which), window=walk.window + found)
        if equations.timed:
            of_points, of_outputs = more
            walk = walk._replace(t=walk.t + of_points)
        if walk.sums.ts is not None:
            spread = jax.lax.dynamic_slice_in_dim(walk.sums.ts, 1, inner)
            places = jnp.minimum(start + jnp.arange(BLOCK), inner - 1)
            spread = spread.at[places].add(jnp.where(which, of_outputs, 0.0))
            sums = walk.sums._replace(ts=jax.lax.dynamic_update_slice_in_dim(walk.sums.ts, spread, 1, 0))
            walk = walk._replace(sums=sums)
        return walk

    return jax.lax.while_loop(lambda w: jnp.any(behind(w)[1]), more, walk)
