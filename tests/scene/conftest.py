import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import udkjax.scene as udk
from udkjax.scene import GROUND, Frame
from udkjax.scene.bodies import GROUND_FRAME_AT_REST


def frames(mechanism, q, v=None):
    """The frames of all bodies, by name."""
    found = {GROUND: GROUND_FRAME_AT_REST}
    for k, name in enumerate(mechanism.body_names):
        (x, y, angle), speed = q[k], () if v is None else v[k]
        found[name] = Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), *speed)
    return found


def residual(mechanism, q, t=0.0):
    known = frames(mechanism, q)
    rows = [c.residual(t, *(known[n] for n in mechanism.frames_of(c))) for c in mechanism.constraints.values()]
    return jnp.stack([jnp.asarray(row) for constraint in rows for row in constraint])


@pytest.fixture
def psi():
    """Psi(mechanism, q, t), row by row, straight from the residuals."""
    return residual


@pytest.fixture
def at():
    """The frames of all bodies of a mechanism at q, v."""
    return frames


@pytest.fixture
def same():
    """Whether two mechanisms are equal in structure and, bit by bit, in every number."""

    def equal(one, two):
        return jax.tree.structure(one) == jax.tree.structure(two) and bool(eqx.tree_equal(one, two))

    return equal


@pytest.fixture
def everything():
    """A mechanism with every element of the format; it is not meant to move."""
    o = [[0.0, 0.0], [0.0, 0.0]]
    return udk.Mechanism(
        bodies={
            "b": udk.Body(1.0, 0.1, [0.3, -0.2], 0.4, [0.1, 0.2], -0.3),
            "a": udk.Body(2.0, 0.2, [1.0, 0.5], -1.1),
            "c": udk.Body(1e-3, 1e20, [-0.4, 0.1], 2.0),
        },
        joints={
            "revolute": udk.Revolute(["ground", "b"], [[0.0, 0.0], [-0.5, 0.1]]),
            "prismatic": udk.Prismatic(["a", "b"], o, axis=0.3),
            "slot": udk.Slot(["a", "b"], o, axis=0.3),
            "weld": udk.Weld(["a", "ground"], o),
            "distance": udk.Distance(["a", "b"], o),
            "angle": udk.Angle(["c", "b"]),
            "gear": udk.Gear(["a", "b"], [0.1, 0.2]),
            "inner gear": udk.Gear(["a", "b"], [0.1, 0.2], internal=True, carrier="c"),
            "rack": udk.Rack(["ground", "b"], radius=0.2, axis=0.1),
            "cam": udk.Cam(["a", "b"], o, udk.Profile([-1.0, 0.5, 2.0, 4.0], [1.0, 1.1, 1.2, 1.1])),
        },
        drivers={
            "turn": udk.Driver(["ground", "b"], "angle", udk.Polynomial([0.0, 2.0])),
            "push": udk.Driver(["ground", "b"], "x", udk.Sine(1.0, 2.0)),
            "lift": udk.Driver(["a", "b"], "y", udk.Spline([0.0, 1.0, 3.0], [0.0, 0.5, 0.1])),
            "stretch": udk.Driver(["a", "b"], "distance", udk.Polynomial([1.0]), [[0.1, 0.0], [0.0, 0.2]]),
        },
        forces={
            "damped": udk.Spring(["a", "b"], [[0.1, 0.2], [-0.3, 0.1]], stiffness=10.0, length=0.4, damping=0.3),
            "undamped": udk.Spring(["ground", "b"], [[0.1, 0.2], [-0.3, 0.1]], stiffness=10.0, length=0.4),
            "torsion": udk.TorsionSpring(["a", "b"], stiffness=3.0, damping=0.2, angle=0.1),
            "push": udk.Force("a", [1.0, 2.0], point=[0.1, 0.0]),
            "follow": udk.Force("a", [1.0, 2.0], frame="body"),
            "torque": udk.Torque(["a", "b"], value=0.7),
            "rub": udk.Friction("revolute", torque=0.5, velocity=0.01),
        },
        name='all "of" it\n\\',
    )
