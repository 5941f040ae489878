"""States between accepted ones: the polynomial that has the positions, velocities and accelerations of the last few."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from udkjax.native.steps import STRETCH
from udkjax.straightline import cut

# Columns of differences between two barriers: with none XLA computes each coefficient with all that it is made of. Each barrier
# sends what passes through memory, of which lanes have much.
CUT_EVERY = 3


class Point(NamedTuple):
    """An accepted state with its accelerations; of each lane."""

    t: Array  # (*lanes,)
    q: Array  # (n, *lanes)
    v: Array
    a: Array


def interpolated(points: tuple[Point, ...], times: Array) -> Array:
    """q and v (T, 2n, *lanes) at times (T, *lanes) between the last two points.

    Hermite's polynomial by Newton's divided differences, the latest point first. Points that lie much closer together than the
    last step is long, as where it grows at the start, or that are not there yet, are left out: they only add rounding errors.
    """
    points = points[::-1]
    step = points[0].t - points[1].t
    used = [jnp.ones(step.shape, bool)]
    for p, q in itertools.pairwise(points[1:]):
        used.append(used[-1] & (STRETCH * (p.t - q.t) >= step))
    apart = {(i, j): points[j].t - points[i].t for i, j in itertools.combinations(range(len(points)), 2)}
    inverse = {ij: 1.0 / jnp.where(d == 0, 1.0, d) for ij, d in apart.items()}
    column = [p.q for p in points for _ in range(3)]
    coefficients = [column[0]]
    known = {1: [p.v for p in points], 2: [0.5 * p.a for p in points]}
    for order in range(1, 3 * len(points)):
        following = []
        for i in range(3 * len(points) - order):
            first, last = i // 3, (i + order) // 3
            if first == last:
                following.append(known[order][first])
            else:
                following.append((column[i + 1] - column[i]) * inverse[first, last])
        column = cut(following) if order % CUT_EVERY == CUT_EVERY - 1 else following
        coefficients.append(column[0] if order < 3 else jnp.where(used[order // 3 - 1], column[0], 0.0))
    q, v = jnp.zeros((), column[0].dtype), jnp.zeros((), column[0].dtype)
    for k, coefficient in reversed(list(enumerate(coefficients))):
        ahead = (times - points[k // 3].t)[:, None]
        q, v = q * ahead + coefficient, v * ahead + q
    return jnp.concatenate([q, v], axis=1)
