from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax.scene as udk
from udkjax.scene.elements.held import rows_of, with_row

ONE = udk.Frame(1.0, 2.0, 0.5, np.cos(0.5), np.sin(0.5))
TWO = udk.Frame(-1.0, 0.5, 2.0, np.cos(2.0), np.sin(2.0))


@pytest.mark.parametrize("points", [((0.0, 0.0), (0.0, 0.0)), ((0.1, -0.2), (0.3, 0.4))])
def test_coordinates(points):
    p, q = ONE.point(points[0]), TWO.point(points[1])
    d = np.array([q.x - p.x, q.y - p.y])
    local = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]]) @ d
    expected: dict[Any, Any] = {"angle": 1.5, "x": local[0], "y": local[1], "distance": np.linalg.norm(d)}
    for coordinate, value in expected.items():
        driver = udk.Driver(["one", "two"], coordinate, udk.Polynomial([0.0, 0.5]), points)
        assert_allclose(np.array(driver.residual(3.0, ONE, TWO)), [value - 1.5], rtol=1e-14)


def test_points_default_to_the_origins():
    mech = udk.Mechanism({"a": udk.Body(1, 1)}, drivers={"d": udk.Driver(["ground", "a"], "x", udk.Sine(1.0, 1.0))})
    assert_allclose(mech.parameters()["driver.d.points"], np.zeros((2, 2)))


def test_motion_laws():
    assert_allclose(udk.Polynomial([1.0, -2.0, 3.0])(2.0), 9.0)
    assert_allclose(udk.Polynomial([4.0])(2.0), 4.0)
    assert_allclose(udk.Sine(2.0, 3.0, 0.1, 0.5)(0.7), 0.5 + 2.0 * np.sin(2.2))
    assert_allclose(
        jax.vmap(udk.Spline([0.0, 1.0, 2.5], [1.0, 0.0, 2.0]))(jnp.array([0.0, 1.0, 2.5])), [1.0, 0.0, 2.0], atol=1e-15
    )


def test_a_motion_law_of_ones_own():
    class Ramp(udk.Motion):
        slope: float

        def __call__(self, t):
            return self.slope * t

    mech = udk.Mechanism({"a": udk.Body(1, 1)}, drivers={"d": udk.Driver(["ground", "a"], "angle", Ramp(2.0))})
    mech = mech.with_parameters({"driver.d.motion.slope": 3.0})
    assert_allclose(mech.drivers["d"].motion(2.0), 6.0)


@pytest.mark.parametrize("n", [2, 3, 6])
@pytest.mark.parametrize("xp", [np, jnp])
def test_a_spline_in_pieces(n, xp):
    """Values between knots and beyond the ends, with two derivatives."""
    times = np.array([-0.3, 0.1, 0.4, 1.1, 1.5, 2.6])[:n]
    spline = udk.Spline(times, np.cos(3.0 * times))
    pieces = np.asarray(rows_of(spline, xp))
    assert len(pieces) == (1 if n == 2 else n + 1)
    ts = np.array([times[0] - 0.4, *((times[1:] + times[:-1]) / 2), times[-1] + 0.7])
    rows = pieces[np.searchsorted(np.asarray(spline.breakpoints, float), ts, side="right")]

    @jax.jit
    @jax.vmap
    def both(t, row):
        values = []
        for f in (spline, with_row(spline, row)):
            values.append(jnp.stack([f(t), jax.grad(f)(t), jax.grad(jax.grad(f))(t)]))
        return values

    assert_allclose(*both(ts, rows), rtol=1e-12, atol=1e-12)
