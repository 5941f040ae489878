"""A six-bar that was designed for a dwell: its output rests for a third of each turn.

Over that third the coupler's point P moves along an arc about the far end of its rod. Nobody drew that arc: the goal of
`udk.design` was the motion of the output alone (`examples/goals/dwell.toml`).
"""

from pathlib import Path

import numpy as np

import udkjax as udk
from udkjax.synthesis.goal_file import read_design

GOAL = Path(__file__).parents[1] / "goals" / "dwell.toml"
TURN = 1.0  # s, at 60 rpm
STILL = 121  # samples of 361 over which the output rests


def make():
    """Return the swings of the output over a turn and in its rest, the player, and a plot."""
    import matplotlib.pyplot as plt

    search = read_design(GOAL)
    assert isinstance(search, udk.DesignSearch)  # not for all solutions
    mech = search(results=1)[0].mechanism
    sol = udk.simulate(mech, np.linspace(0.0, 2 * TURN, 721))
    angle = np.rad2deg(np.asarray(sol.q)[:, mech.body_names.index("output"), 2])
    rest = min(np.ptp(angle[k : k + STILL]) for k in range(361))
    facts = {"swing of the output (deg)": float(np.ptp(angle)), "motion of the output during the dwell (deg)": float(rest)}
    figure, panel = plt.subplots(figsize=(6, 3), layout="constrained")
    panel.plot(np.asarray(sol.ts), angle)
    panel.set(xlabel="time, s", ylabel="angle of the output, deg")
    turn = udk.simulate(mech, np.linspace(0, TURN, 181))
    motion = udk.animate(mech, turn, traces=["P"], live=["pin.A", "pin.B", "pin.P", "pin.Q"])
    return facts, {"motion": motion, "angle": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("six_bar_dwell.html")
