import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import udkjax.scene as udk
from tests.elements import BODIES, DRIVERS, FORCES, JOINTS
from udkjax.scene import GROUND, Frame
from udkjax.scene.elements.bodies import GROUND_FRAME_AT_REST


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
    """Psi(mechanism, q, t), row by row, directly from the residuals."""
    return residual


@pytest.fixture
def at():
    """The frames of all bodies of a mechanism at q, v."""
    return frames


@pytest.fixture
def same():
    """True if two mechanisms have the same structure and bitwise identical numbers."""

    def equal(one, two):
        return jax.tree.structure(one) == jax.tree.structure(two) and bool(eqx.tree_equal(one, two))

    return equal


@pytest.fixture
def everything():
    """A mechanism with every element of the format; it is not meant to move."""
    return udk.Mechanism(BODIES, JOINTS, DRIVERS, FORCES, name='all "of" it\n\\')
