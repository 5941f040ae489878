"""Elements that are smooth in pieces of the state, such as a cam: in which piece a state is, and when a step leaves it.

A step that ends in another piece is taken again, so that it ends just before the piece does; a tiny one leads across, behind
which the run starts anew, as behind a breakpoint. When that is, its two ends tell, by the polynomial through them: the closer to
its end, the more exactly.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from udkjax.integrate.interpolation import Point, interpolated
from udkjax.integrate.undifferentiated import undifferentiated
from udkjax.native.steps import HALVINGS
from udkjax.scene.bodies import GROUND, Frame
from udkjax.scene.forces import ForceElement
from udkjax.scene.joints import Constraint
from udkjax.scene.mechanism import Mechanism


class Pieces(eqx.Module):
    """The elements that have pieces, and the bodies that each of them sees."""

    elements: tuple[Constraint | ForceElement, ...]
    bodies: tuple[tuple[int | None, ...], ...] = eqx.field(static=True)  # None: the ground

    def __call__(self, t: Array, q: Array, v: Array) -> Int[Array, "k"]:
        """The piece that each of them is in."""
        found = []
        for element, bodies in zip(self.elements, self.bodies, strict=True):
            moves = isinstance(element, ForceElement)
            found.append(element.piece(t, *(_frame(q, v if moves else None, k) for k in bodies)))
        return jnp.stack([jnp.asarray(x, int) for x in found])


def pieces_of(mechanism: Any) -> Pieces | None:
    """The elements of a mechanism that have pieces, or None where there are none."""
    if not isinstance(mechanism, Mechanism):
        return None
    places = {name: k for k, name in enumerate(mechanism.body_names)} | {GROUND: None}
    elements = [*mechanism.constraints.values(), *mechanism.forces.values()]
    some = [e for e in elements if type(e).piece not in (Constraint.piece, ForceElement.piece)]
    bodies = tuple(tuple(places[name] for name in mechanism.frames_of(e)) for e in some)
    return Pieces(tuple(some), bodies) if some else None


def _frame(q: Array, v: Array | None, k: int | None) -> Frame:
    if k is None:
        return Frame(0.0, 0.0, 0.0, 1.0, 0.0, *(() if v is None else (0.0, 0.0, 0.0)))
    x, y, angle = q[3 * k : 3 * k + 3]
    return Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), *(() if v is None else v[3 * k : 3 * k + 3]))


def share_before(piece: Any, here: Point, to: Point) -> Array:
    """The part of a step that is in the piece where it begins, where its ends are in different ones."""
    here, to = undifferentiated((here, to))
    first = piece(here.t, here.q, here.v)

    def halve(_: Any, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        t = here.t + (middle := (low + high) / 2) * (to.t - here.t)
        q, v = jnp.split(interpolated((here, to), t[None])[0], 2)
        same = jnp.all(piece(t, q, v) == first, axis=0)
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    return jax.lax.fori_loop(0, HALVINGS, halve, (jnp.zeros_like(to.t), jnp.ones_like(to.t)))[1]
