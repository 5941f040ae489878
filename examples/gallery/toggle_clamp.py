"""A toggle clamp that locks itself by friction, and the same clamp with grease, which springs open.

A hand closes both until their knees stand half a millimetre above the line of their ends, and lets go. The workpiece pushes them
open. As long as a line touches the circles of friction of all three pins, that is, up to a height of 2 mu r, friction holds the
clamp, however strong the workpiece is. Joints that stick have a ring.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk

ARM, OPEN, CLOSED, RADIUS = 200.0, 30.0, 0.5, 10.0  # mm: arms, heights of the knee, and radius of the pins
CLOSING, TURN = 1.0, np.arcsin(CLOSED / ARM) - np.arcsin(OPEN / ARM)  # s, rad: of the hand
RUBS = {"dry, mu = 0.1": 0.1, "greased, mu = 0.02": 0.02}
MOMENT = 0.9  # fraction of the motion at which its picture is taken


class Motion(NamedTuple):
    """A run after the motion of the hand, and which joints stick, as a player shows them."""

    ts: jax.Array
    q: jax.Array
    v: jax.Array
    sticking: dict[str, np.ndarray]


def clamp(coefficient, motors):
    """Return the open clamp, with a workpiece of rubber between its jaw and a wall."""
    x = np.sqrt(ARM**2 - OPEN**2)
    bar = {"density": 7850, "width": 24, "thickness": 20}
    return udk.Drawing(
        pins={"A": (0, 0), "B": (x, OPEN), "C": (2 * x, 0), "W": (2 * x + 90, 0)},  # mm
        links={
            "lever": {"pins": ["A", "B"], **bar},
            "rod": {"pins": ["B", "C"], **bar},
            "jaw": {"pins": ["C"], "mass": 0.5, "width": 30},
        },
        slides=[{"link": "jaw", "direction": (1, 0)}],
        ground=["A", "W"],
        springs=[{"between": ["C", "W"], "stiffness": "100 N/mm", "damping": "4 N s/mm"}],
        friction=[{"pin": pin, "coefficient": coefficient, "radius": RADIUS, "law": "set-valued"} for pin in "ABC"],
        motors=motors,
        gravity=(0, 0),
        units={"length": "mm"},
        name="toggle clamp",
    ).mechanism()


def close_and_release(coefficient):
    """Return the motion of a clamp: closed by a hand, then without it."""
    hand = {"pin": "A", "motion": udk.Polynomial([0.0, 0.0, 3 * TURN / CLOSING**2, -2 * TURN / CLOSING**3])}
    closing = udk.simulate(clamp(coefficient, [hand]), np.linspace(0.0, CLOSING, 51))
    state = udk.State(closing.q[-1], np.zeros_like(closing.q[-1]))
    after = udk.simulate(clamp(coefficient, []), np.linspace(0.0, 1.0, 201), state)
    q, v = (jnp.concatenate([x[:-1], y]) for x, y in ((closing.q, after.q), (closing.v, after.v)))
    assert after.sticking is not None  # as its friction is set-valued
    sticking = {joint: np.concatenate([np.zeros(50, bool), np.asarray(stuck)]) for joint, stuck in after.sticking.items()}
    return Motion(jnp.concatenate([closing.ts[:-1], CLOSING + after.ts]), q, v, sticking)


def make():
    """Return the heights of the knees after the hand has let go, and the player."""
    mechanisms = {label: clamp(coefficient, []) for label, coefficient in RUBS.items()}
    motions = {label: close_and_release(coefficient) for label, coefficient in RUBS.items()}
    heights = {label: 1e3 * np.asarray(udk.path(mechanisms[label], motion, "B"))[:, 1] for label, motion in motions.items()}
    facts = {f"height of the knee at the end, {label} (mm)": float(height[-1]) for label, height in heights.items()}
    facts = {"height up to which it locks, dry (mm)": 2 * RUBS["dry, mu = 0.1"] * RADIUS, **facts}
    measures = {"height of the knee (mm)": heights}
    return facts, {"motion": udk.animate(mechanisms, motions, measures=measures, traces=["B"])}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("toggle_clamp.html")
