"""Areas, centres and radii of gyration compared with integrals over slices and with composite shapes."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad

from udkjax.scene.drawing.link import bar, disc, polygon


def integrate_slices(length, width):
    """Area and polar second moment of a bar with round ends about its middle, slice by slice across its axis."""
    r = width / 2

    def height(x):
        return 2 * np.sqrt(max(r**2 - max(abs(x) - length / 2, 0.0) ** 2, 0.0))

    def integral(f):
        ends = [-length / 2 - r, -length / 2, length / 2, length / 2 + r]
        return sum(quad(f, a, b, epsabs=0, epsrel=1e-12)[0] for a, b in pairwise(ends) if b > a)

    return integral(height), integral(lambda x: height(x) ** 3 / 12 + height(x) * x**2)


@pytest.mark.parametrize(("length", "width"), [(0.3, 0.02), (0.05, 0.2), (2.0, 1.0)])
def test_a_bar_with_round_ends(length, width):
    area, moment = integrate_slices(length, width)
    start, way = np.array([0.7, -0.2]), length * np.array([0.6, 0.8])
    found = bar(start, start + way, width)
    assert_allclose(np.array([found.area, found.square_radius]), [area, moment / area], rtol=1e-10)
    assert_allclose(found.centre, start + way / 2, rtol=1e-15)


def test_a_bar_is_between_a_rod_and_a_disc():
    start, end = np.array([1.0, 2.0]), np.array([4.0, 6.0])
    assert_allclose(bar(start, end, 0.0).square_radius, 25 / 12, rtol=1e-15)
    assert_allclose(np.array(bar(start, start, 0.4)[::2]), np.array(disc(start, 0.4)[::2]), rtol=1e-15)
    assert_allclose(np.array(disc(start, 0.4)[::2]), [np.pi * 0.2**2, 0.2**2 / 2], rtol=1e-15)


@pytest.mark.parametrize("backwards", [False, True])
def test_a_polygon_that_is_not_convex(backwards):
    """An L made of two rectangles, turned, and far from the origin."""
    corners = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 4], [0, 4]], float)
    areas, centres = np.array([3.0, 3.0]), np.array([[1.5, 0.5], [0.5, 2.5]])
    own = areas * np.array([3**2 + 1, 1 + 3**2]) / 12
    centre = areas @ centres / 6
    square = np.sum(own + areas * np.sum((centres - centre) ** 2, axis=1)) / 6
    turn, place = np.array([[0.6, -0.8], [0.8, 0.6]]), np.array([1e3, -2e3])
    found = polygon((corners @ turn.T + place)[:: -1 if backwards else 1])
    assert_allclose(np.array([found.area, found.square_radius]), [6, square], rtol=1e-11)
    assert_allclose(found.centre, turn @ centre + place, rtol=1e-14)


def test_shapes_have_derivatives():
    corners = jnp.array([[0.0, 0.0], [2.0, 0.3], [1.0, 1.5]])
    shapes = (lambda p: polygon(p), lambda p: bar(p[0], p[1], p[2, 0]), lambda p: disc(p[0], p[2, 1]))

    @jax.jit
    def values(p):
        return jnp.concatenate([jnp.ravel(x) for shape in shapes for x in map(jnp.asarray, shape(p))])

    found = jax.jit(jax.jacfwd(values))(corners)
    steps = 1e-6 * np.eye(6).reshape(6, 3, 2)
    expected = np.stack([np.asarray(values(corners + d) - values(corners - d)) / 2e-6 for d in steps], axis=-1)
    assert_allclose(np.asarray(found).reshape(expected.shape), expected, atol=1e-8)
