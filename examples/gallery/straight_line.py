"""A straight line that a four-bar was designed for.

`udk.design` finds where the pins are, from a drawing that says how links are joined, and seven places in a row. The transmission
angle stays away from dead points over the whole turn.
"""

import numpy as np

import udkjax as udk

PLACES = [[x, 0.0] for x in np.linspace(0.5, -0.5, 7)]


def make():
    """Return how far the point is from its places as the mechanism runs, and the player."""
    drawing = udk.Drawing(
        pins={"O": (0, 0), "A": (0.3, 0.4), "B": (1.2, 0.9), "P": (0.6, 1.2), "C": (1.0, 0)},  # m
        links={
            "crank": {"pins": ["O", "A"], "mass": 1.0},
            "coupler": {"pins": ["A", "B", "P"], "mass": 2.0},
            "rocker": {"pins": ["C", "B"], "mass": 1.0},
        },
        ground=["O", "C"],
        motors={"motor": {"pin": "O", "speed": 2.0}},
    )
    lengths = {("O", "A"): (0.05, 3.0), ("O", "C"): (0.1, 4.0)}
    best = udk.design(drawing, udk.PathGoal("P", PLACES), lengths=lengths, transmission=0.5, starts=300, results=1)[0]
    mech = best.mechanism
    turn = 2 * np.pi / 2.0  # s
    path = np.asarray(udk.path(mech, udk.simulate(mech, np.linspace(0.0, turn, 7201)), "P"))
    facts = {
        "farthest of the places from the path of the run (m)": float(
            np.linalg.norm(path[:, None] - PLACES, axis=2).min(axis=0).max()
        ),
        "after a turn the point is where it was, within (m)": float(np.linalg.norm(path[-1] - path[0])),
    }
    sol = udk.simulate(mech, np.linspace(0.0, turn, 181))
    return facts, {"motion": udk.animate(mech, sol, traces=["P"], live=["pin.A", "pin.B", "pin.P", "motor.motor.speed"])}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("straight_line.html")
