"""Four-bars that were designed for a straight line, a walking foot and the letter D.

A drawing says how links are joined, places say where a point goes, in their order: `udk.design` finds the pins. The foot moves.
"""

import numpy as np

import udkjax as udk

BOW = np.linspace(0.0, np.pi, 8)[1:-1]
PLACES = {
    "straight line": [[x, 0.0] for x in np.linspace(0.5, -0.5, 7)],
    "letter D": [[0.0, y] for y in np.linspace(-0.5, 0.5, 6)] + [[0.6 * np.sin(a), 0.5 * np.cos(a)] for a in BOW],
    "walking foot": [[x, 0.0] for x in np.linspace(0.6, -0.6, 7)] + [[-0.45, 0.25], [0.0, 0.38], [0.45, 0.25]],
}
TURN = np.pi  # s


def make():
    """Return how far each path is from its places as the mechanism runs, the player of the last, and a plot of all."""
    import matplotlib.pyplot as plt

    drawing = udk.Drawing(
        pins={"O": (0, 0), "A": (0.3, 0.4), "B": (1.2, 0.9), "P": (0.6, 1.2), "C": (1.0, 0)},  # m
        links={
            "crank": {"pins": ["O", "A"], "mass": 1.0},
            "coupler": {"pins": ["A", "B", "P"], "mass": 2.0},
            "rocker": {"pins": ["C", "B"], "mass": 1.0},
        },
        ground=["O", "C"],
        motors={"motor": {"pin": "O", "speed": 2 * np.pi / TURN}},
    )
    lengths = {("O", "A"): (0.05, 3.0), ("O", "C"): (0.1, 4.0)}
    facts, mech = {}, drawing.mechanism()
    figure, panels = plt.subplots(1, len(PLACES), figsize=(9, 3), layout="constrained")
    for (name, places), panel in zip(PLACES.items(), panels, strict=True):
        goal = udk.PathGoal("P", places)
        mech = udk.design(drawing, goal, lengths=lengths, transmission=0.35, starts=300, results=1)[0].mechanism
        path = np.asarray(udk.path(mech, udk.simulate(mech, np.linspace(0.0, TURN, 7201)), "P"))
        off = np.linalg.norm(path[:, None] - places, axis=2).min(axis=0).max()
        facts[f"{name}: farthest of the places from the path of the run (m)"] = float(off)
        panel.plot(*path.T)
        panel.plot(*np.transpose(places), "k.")
        panel.set(title=name, aspect="equal", xlabel="x, m", ylabel="y, m")
    sol = udk.simulate(mech, np.linspace(0.0, TURN, 181))
    live = ["pin.A", "pin.B", "pin.P", "motor.motor.speed"]
    return facts, {"motion": udk.animate(mech, sol, traces=["P"], live=live), "paths": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("designed_paths.html")
