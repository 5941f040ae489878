"""Four-bars that were designed for a straight line, the letter D and a walking foot.

A drawing gives the links and their joints, and a goal file gives the targets of a point. `udk.design` finds the positions of the
pins. The player shows the walking foot.
"""

from pathlib import Path

import numpy as np

import udkjax as udk
from udkjax.synthesis.goal_file import read_design

GOALS = Path(__file__).parents[1] / "goals"
NAMES = ("straight_line", "letter_d", "walking_foot")
TURN = 1.0  # s, at 60 rpm


def make():
    """Return the distance of each path from its places in a run, the player of the last, and a plot of all."""
    import matplotlib.pyplot as plt

    facts = {}
    figure, panels = plt.subplots(1, len(NAMES), figsize=(9, 3), layout="constrained")
    for file, panel in zip(NAMES, panels, strict=True):
        name, search = file.replace("_", " "), read_design(GOALS / f"{file}.toml")
        assert isinstance(search, udk.DesignSearch)  # not for all solutions
        mech, places = search(results=1)[0].mechanism, search.problem.goal.targets
        path = np.asarray(udk.path(mech, udk.simulate(mech, np.linspace(0.0, TURN, 7201)), "P"))
        off = np.linalg.norm(path[:, None] - places, axis=2).min(axis=0).max()
        facts[f"{name}: largest distance of a target from the path (mm)"] = 1e3 * float(off)
        panel.plot(*(1e3 * path.T))
        panel.plot(*(1e3 * places.T), "k.")
        panel.set(title=name, aspect="equal", xlabel="x, mm", ylabel="y, mm")
    sol = udk.simulate(mech, np.linspace(0.0, TURN, 181))
    live = ["pin.A", "pin.B", "pin.P", "motor.motor.speed"]
    return facts, {"motion": udk.animate(mech, sol, traces=["P"], live=live), "paths": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("designed_paths.html")
