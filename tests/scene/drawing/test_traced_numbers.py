"""Every number of a drawing may be traced, alone and beside all others, whatever its elements are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax.scene as udk
from tests.scene.drawing.test_belts import drive
from tests.scene.drawing.test_cam_laws import cam
from tests.scene.drawing.test_drawing_files import EVERYTHING
from tests.scene.drawing.test_guided_followers import LAW, SWING, follower_of, sliding, swinging
from tests.scene.drawing.test_named_numbers import TEXT

FACE = np.exp(1j * np.arccos(40 / 90))  # normal of a face through the pivot of its follower
DRAWN = {
    "every element": lambda: udk.loads(EVERYTHING),
    "named numbers": lambda: udk.loads(TEXT),
    "belt": lambda: drive(radii=[30, 50], belt="crossed"),
    "cam in line": cam,
    "cam with a sliding follower": sliding,
    "cam with a swinging follower": lambda: swinging()[1],
    "cam with a flat face": lambda: cam(face=90),
    "cam with a swinging face": lambda: follower_of(
        {"O": 0, "Q": 90.0, "P": 90.0 + 60j * FACE}, ["Q", "P"], LAW | SWING, face=[FACE.real, FACE.imag]
    ),
}


def placed(mechanism):
    """Return the numbers of all elements of a mechanism."""
    groups = mechanism.bodies, mechanism.joints, mechanism.drivers, mechanism.forces
    return jax.tree.leaves([list(group.values()) for group in groups])


@pytest.mark.parametrize("name", DRAWN)
def test_each_number_of_a_drawing_may_be_traced(name):
    mechanism = DRAWN[name]()
    numbers = {key: jnp.asarray(x, float) for key, x in mechanism.direct.items()}
    shapes = [np.shape(x) for x in placed(mechanism)]
    for key, x in numbers.items():
        found = jax.eval_shape(lambda x, key=key: placed(mechanism.with_parameters({key: x})), x)
        assert [s.shape for s in found] == shapes, key
    together = jax.jit(lambda xs: placed(mechanism.with_parameters(xs)))(numbers)
    for x, y in zip(together, placed(mechanism), strict=True):
        assert_allclose(x, np.asarray(y), rtol=1e-12, atol=1e-12)
