"""User-defined systems in the player, by a drawing."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.systems.own_systems import pendulum

TS = np.linspace(0.0, 1.0, 6)


def test_a_drawing_places_bodies():
    """Two views of a pendulum, one of which turns; their motion is that of the run, with its energy below."""
    system = pendulum()
    run = udk.simulate(system, TS, udk.State([0.6, 0.0, -0.8], [0.0, 1.5, 0.0]))
    shown = udk.animate(
        system, run, drawing=lambda t, q: {"above": q[:2], "side": jnp.stack([q[0], q[2], 2 * t])}, traces=["above"]
    )
    above, side = shown.pose(float(TS[-1]))[0]
    x, y, z = np.asarray(run.q[-1])
    assert_allclose(above, [x, y, 0.0], atol=1e-5)
    assert_allclose(side, [x, z, 2.0], atol=1e-5)
    curve = shown.data["runs"][0]["measures"][0]
    assert (curve["name"], curve["unit"]) == ("energy", "J")
    with pytest.raises(ValueError, match="no bodies to draw: give a solution and a drawing"):
        udk.animate(system, run)
