"""The gap between two links in a position, by arithmetic alone, as machine code needs it."""

from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import product
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.positions.gaps.pairs import pairs_to_check
from udkjax.positions.gaps.shapes import parts_of
from udkjax.scene.mechanism import Mechanism

PlaneCorner = tuple[Array, Array]


def gap_in_position(
    mechanism: Mechanism, shapes: Mapping[str, Any] | None, pair: tuple[str, str], q: Float[Array, "bodies 3"]
) -> Array:
    """Return the gap (m) between the two links of a pair in the position q, negative if they overlap; numbers may be traced.

    Raises a `SceneError` if there are no such links, or an outline is missing.
    """
    pairs_to_check(mechanism, None, [pair], shapes)
    names = mechanism.body_names
    placed = [(part.body, _corners(names, q, part.body, part.corners), part.radius) for part in parts_of(mechanism, shapes, pair)]
    pairs = product(*([x for x in placed if x[0] == name] for name in pair))
    return _least([signed_distance_of(A, B) - a - b for (_, A, a), (_, B, b) in pairs])


def _corners(names: Sequence[str], q: Array, body: str, corners: Float[Array, "n 2"]) -> list[PlaneCorner]:
    if body not in names:
        return [(corner[0], corner[1]) for corner in corners]
    x, y, angle = q[names.index(body)]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return [(x + cos * corner[0] - sin * corner[1], y + sin * corner[0] + cos * corner[1]) for corner in corners]


def signed_distance_of(A: Sequence[PlaneCorner], B: Sequence[PlaneCorner]) -> Array:
    """Return the signed distance of two convex figures by arithmetic alone, as machine code needs it.

    Each figure is the hull of its corners, anticlockwise. If the figures overlap, the result is minus the length of the shortest
    translation that separates them.
    """
    squares, separations = [], []
    for corners, others in ((A, B), (B, A)):
        if len(corners) == 1:
            squares += [_square(p[0] - corners[0][0], p[1] - corners[0][1]) for p in others]
            continue
        for start, end in list(zip(corners, (*corners[1:], corners[0]), strict=True))[: len(corners) if len(corners) > 2 else 1]:
            length = jnp.sqrt(_square(end[0] - start[0], end[1] - start[1]))
            ex, ey = (end[0] - start[0]) / length, (end[1] - start[1]) / length
            arms = [(p[0] - start[0], p[1] - start[1]) for p in others]
            left = [ex * y - ey * x for x, y in arms]
            before, after = [-(ex * x + ey * y) for x, y in arms], [ex * x + ey * y - length for x, y in arms]
            for side, start_side, end_side in zip(left, before, after, strict=True):
                squares.append(_square(side, jnp.maximum(jnp.maximum(start_side, end_side), 0.0)))
            separations.append(-_most(left))
            if len(corners) == 2:
                separations += [_least(left), _least(before), _least(after)]
    square = _least(squares)
    distance = jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)
    apart = _most(separations) if separations else distance
    return jnp.where(apart < 0.0, apart, distance)


def _square(x: Array, y: Array) -> Array:
    return x * x + y * y


def _least(values: Sequence[Array]) -> Array:
    return reduce(jnp.minimum, values)


def _most(values: Sequence[Array]) -> Array:
    return reduce(jnp.maximum, values)
