"""The outline of a cam, given by points of it."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.printing import PrintsLine
from udkjax.scene.fields import PROFILE_ANGLES, PROFILE_RADII, given_number
from udkjax.scene.splines import count_knots, periodic_spline, wrap


class Profile(PrintsLine):
    """The closed outline of a cam: its radius over the polar angle, a periodic cubic spline.

    Args:
        angle: polar angles (rad), anticlockwise, increasing within less than one turn; at least three. The first is not repeated.
        radius: radius at each angle (m), greater than zero.
    """

    angle: Float[Array, "n"] = eqx.field(converter=given_number, metadata=PROFILE_ANGLES)  # rad, increasing, less than one turn
    radius: Float[Array, "n"] = eqx.field(converter=given_number, metadata=PROFILE_RADII)  # m

    def __call__(self, angle: Number) -> Array:
        """Return the radius (m) at a polar angle (rad)."""
        return periodic_spline(angle, self.angle, self.radius, 2 * jnp.pi)

    def piece(self, angle: Number) -> Array:
        """Return the index of the cubic at a polar angle (rad)."""
        return count_knots(wrap(angle, self.angle[0], 2 * jnp.pi), self.angle)


def as_profile(value: Any) -> Any:
    """Convert a table to a profile; return anything else unchanged, to be refused by the mechanism."""
    return Profile(**value) if isinstance(value, Mapping) and value.keys() == {"angle", "radius"} else value
