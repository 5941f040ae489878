"""A map of chaos: how far the lower rod of a double pendulum has turned after a few seconds, from 2,500 starts.

One call of `sweep`: its members run side by side in lanes of machine code.
"""

import numpy as np
from matplotlib.figure import Figure

import udkjax as udk
from udkjax.show import plots

MEMBERS = 50  # along each axis
END = 5.0  # s


def make():
    """Return facts of the map, the players of two neighbours on it, and the map."""
    mech = udk.library.double_pendulum()
    angles = np.linspace(-np.pi, np.pi, MEMBERS + 1)[:-1] + np.pi / MEMBERS  # rad, from hanging straight down
    data = udk.sweep(
        mech,
        {
            "lower rod": udk.Axis(angles, of=lambda mech, x: udk.with_angle(mech, "lower", x - np.pi / 2), units="rad"),
            "upper rod": udk.Axis(angles, of=lambda mech, x: udk.with_angle(mech, "upper", x - np.pi / 2), units="rad"),
        },
        [0.0, END],
        {"turns": lambda mech, sol: abs(sol.q[-1, 1, 2] - sol.q[0, 1, 2]) / (2 * np.pi)},
        rtol=1e-7,
        atol=1e-7,
        progress=False,
    )
    figure = Figure(figsize=(6, 4.6), layout="constrained")
    axes = plots.draw_sweep(figure.subplots(), data, "turns")
    axes.set_aspect("equal")
    turns = data["turns"].values
    calm = np.hypot(*np.meshgrid(angles, angles)) < 1.0
    facts = {
        "members": float(turns.size),
        "fraction of members that turned over": float((turns > 1).mean()),
        "the same fraction of those released within a radian of rest": float((turns[calm] > 1).mean()),
        "members that failed": float((data["result"].values != 0).sum()),
    }
    ts = np.linspace(0.0, 10.0, 301)
    runs, start = {}, {"lower": 2.0, "upper": 2.5}
    for label, shift in {"let go": 0.0, "a thousandth of a degree further": np.radians(1e-3)}.items():
        one = udk.with_angle(mech, "upper", start["upper"] + shift - np.pi / 2)
        runs[label] = udk.simulate(udk.with_angle(one, "lower", start["lower"] - np.pi / 2), ts, rtol=1e-10, atol=1e-10)
    lower = {"angle of the lower rod (rad)": {label: run.q[:, 1, 2] for label, run in runs.items()}}
    return facts, {"motion": udk.animate(mech, runs, measures=lower, traces=("lower",)), "map": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("double_pendulum_map.html")
