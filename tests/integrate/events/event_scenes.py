"""Scenes with events: a ball above a floor, a pendulum with stops, a ball that a pendulum catches; and a condition."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

import udkjax as udk

G = 9.81
ROOM = 24  # events of a run
BALL = udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=(0.0, 1.0))})
PENDULUM = udk.Mechanism(
    {"link": udk.Body(1.0, 0.1, position=(0.5, 0.0))}, {"A": udk.Revolute(("ground", "link"), [[0, 0], [-0.5, 0]])}
)
SWING = G * 0.5 / (0.1 + 0.25)  # the square of its small frequency
TS = np.linspace(0.0, 8.0, 40)


def floor(restitution, **more):
    return udk.Contact("ball", restitution=restitution, name="floor", **more)


# A ball flies into the tip of a pendulum, is caught there by a joint, and where the pendulum passes -60 degrees its pin is cut.
CATCH = udk.Mechanism(
    {
        "link": udk.Body(1.0, 0.1, position=(0.0, -0.5), angle=-np.pi / 2),
        "ball": udk.Body(0.5, 0.05, position=(-1.0, -1.0 + G / 72), velocity=(6.0, 0.0)),
    },
    {"A": udk.Revolute(("ground", "link"), [[0, 0], [-0.5, 0]])},
)
CAUGHT = [
    udk.Event(
        lambda t, at: at["link"].point((0.5, 0)).x - at["ball"].x,
        udk.Attach(udk.Weld(("link", "ball"), [[0.5, 0], [0, 0]]), "catch"),
        name="caught",
    ),
    udk.Event(lambda t, at: at["link"].angle + np.pi / 3, udk.Release("A"), name="cut"),
]


class Level(eqx.Module):
    """A condition: the level of a coordinate or a velocity of a body."""

    level: jax.Array
    body: str = eqx.field(static=True)
    coordinate: str = eqx.field(static=True)

    def __call__(self, t: Any, at: Any) -> Any:
        return getattr(at[self.body], self.coordinate) - self.level
