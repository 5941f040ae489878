"""The way that a run has gone: what its steps can be walked back by.

Points are numbered: 0 is the start as it is given, 1 the start on the constraint manifold, and every accepted step leads to one
more. Of the last few hundred steps everything is kept, of those before the times, and every so often the states from which the
rest can be made again.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.integrate.interpolation import Point
from udkjax.native.steps import POINTS

KEPT = 512  # steps of which everything is kept: most runs take no more, and of a hundred coordinates they fill 7 MB
BEHIND = POINTS - 1  # points that an output takes besides the one that its step leads to


class Record(NamedTuple):
    """Arrays of n coordinates for methods of s stages; the step to point k is in the row (k - 1) mod `KEPT` of what is kept."""

    times: Float[Array, "N"]  # of all points
    fallback: Bool[Array, "N"]  # whether the step to a point was taken with care
    stages: Float[Array, "kept s n"]  # accelerations of the stages
    points: Float[Array, "kept+3 3 n"]  # q, v and a at the end of each step kept, and of the three points before them
    marks: Float[Array, "M 3 3 n"]  # q, v and a of the last three points, at every point whose number is a multiple of `KEPT`


def blank(here: Point, stages: int, max_steps: int) -> Record:
    """The record of no step."""
    n, length, kept = len(here.q), max_steps + 2, min(KEPT, max_steps + 1)
    marks = jnp.zeros((2 + max_steps // kept, BEHIND, 3, n))
    return Record(
        jnp.zeros(length).at[0].set(here.t),
        jnp.zeros(length, bool),
        jnp.zeros((kept, stages, n)),
        jnp.zeros((kept + BEHIND, 3, n)),
        marks.at[0].set(as_array(here)),
    )


def noted(record: Record, k: Array, points: tuple[Point, ...], stages: Array, fallback: bool) -> Record:
    """The record with the step to point k, the last of `points`. Of a step that is not accepted, the next one overwrites it.

    So no step has to be told from another; and a mark is written at every step: that at a multiple of `KEPT` is the last.
    """
    kept = len(record.stages)
    row, last = (k - 1) % kept, [as_array(p) for p in points[-BEHIND:]]
    return Record(
        record.times.at[k].set(points[-1].t),
        record.fallback.at[k].set(fallback),
        record.stages.at[row].set(stages),
        record.points.at[BEHIND + row].set(last[-1]),
        record.marks.at[-(-k // kept)].set(jnp.stack(last)),
    )


def as_array(point: Point) -> Float[Array, "3 n"]:
    """q, v and a of a point."""
    return jnp.stack([point.q, point.v, point.a])


def as_point(t: Array, state: Float[Array, "3 n"]) -> Point:
    """The same as a point at time t."""
    return Point(t, state[0], state[1], state[2])
