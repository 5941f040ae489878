"""Scenes and forces that several test files simulate."""

import jax.numpy as jnp
import numpy as np

import udkjax as udk

TS = np.linspace(0.0, 1.0, 11)


class Until(udk.ForceElement):
    """A torque that is NaN after some time."""

    end: float

    def loads(self, t, *frames):
        return [(0.0, 0.0, jnp.where(t < self.end, 0.0, jnp.nan))]


def with_force(pendulum, force):
    return udk.Mechanism(pendulum.bodies, pendulum.joints, forces=[force])
