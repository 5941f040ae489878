"""Springs by which a hand pulls bodies on a page: one for each body, without stiffness until the body is pulled."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from udkjax.scene.elements.bodies import Point
from udkjax.scene.elements.fields import NOT_NEGATIVE, given_number
from udkjax.scene.elements.forces import ForceElement, Wrench
from udkjax.scene.mechanism import Mechanism

PULL_PREFIX = "pull of "  # prefix of the names of the elements


class Pull(ForceElement):
    """A spring and damper between a point p of a body and a target: V = 1/2 stiffness |target - p|^2, load -damping dp/dt at p.

    Unlike that of a `Spring`, its load is smooth where its length is zero, since it has no rest length.

    Args:
        bodies: the name of the body.
        point: p in the body's frame (m).
        target: target point, in ground axes (m).
        stiffness: in N/m, not negative.
        damping: in N s/m, not negative.
    """

    point: Float[Array, "2"] = eqx.field(converter=given_number)
    target: Float[Array, "2"] = eqx.field(converter=given_number)
    stiffness: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)
    damping: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)

    def potential(self, t, *frames):
        place = frames[0].point(self.point)
        stretch = Point(self.target[0] - place.x, self.target[1] - place.y)
        return 0.5 * self.stiffness * stretch.dot(stretch)

    def loads(self, t, *frames) -> list[Wrench]:
        body = frames[0]
        v, arm = body.velocity(self.point), body.vector(self.point)
        x, y = -self.damping * v.x, -self.damping * v.y
        return [(x, y, arm.x * y - arm.y * x)]


def with_pulls(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism with a further force element for each body: a `Pull` without stiffness."""
    none = {"point": np.zeros(2), "target": np.zeros(2), "stiffness": 0.0, "damping": 0.0}
    pulls = {PULL_PREFIX + name: Pull(bodies=(name,), **none) for name in mechanism.body_names}
    forces = {**mechanism.forces, **pulls}
    return Mechanism(mechanism.bodies, mechanism.joints, mechanism.drivers, forces, mechanism.gravity, mechanism.name)
