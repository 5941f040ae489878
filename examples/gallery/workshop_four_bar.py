"""A four-bar redesigned for the workshop: nothing hits any more, and 99 % of the pieces pass.

Links are 20 mm wide and made to 0.3 mm, and a piece passes if its pin P is within 0.6 mm of each of seven targets. In the
nearest four-bar the crank hits the rocker, and a quarter of the pieces fail; two more goals, for tolerances and gap, cure both.
"""

import numpy as np
from scipy.spatial import ConvexHull

import udkjax as udk

DRAWING = udk.Drawing(
    pins={"O": (0, 0), "A": (30, 40), "B": (120, 90), "P": (60, 120), "C": (100, 0)},
    links={
        "crank": {"pins": ["O", "A"], "mass": 1, "width": 20},
        "coupler": {"pins": ["A", "B", "P"], "mass": 1},
        "rocker": {"pins": ["C", "B"], "mass": 1, "width": 20},
    },
    ground=["O", "C"],
    motors={"motor": {"pin": "O", "speed": "60 rpm"}},
    units={"length": "mm"},
)
TARGETS = np.column_stack([np.linspace(0.06, 0.02, 7), np.full(7, 0.12)])
LENGTHS = {("O", "A"): (0.02, 0.1), ("O", "C"): (0.05, 0.2), ("A", "B"): (0.05, 0.2), ("C", "B"): (0.05, 0.2)}
DEVIATIONS = dict.fromkeys(["length(crank)", "length(coupler)", "length(rocker)", "joint.C.points[0]"], "0.3 mm")
LIMIT, GAP = 0.6e-3, 3e-3  # m
TURN = 1.0  # s, at 60 rpm


def draw_outlines(axes, mech, found):
    """Draw the outlines of crank and rocker, and the line of the coupler, where the gap is least, in mm."""
    bodies = mech.body_names
    for k, part in enumerate(found.parts):
        x, y, angle = found.least.q[bodies.index(part.body)]
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        centres = np.asarray(part.corners) @ turn.T + [x, y]
        around = np.linspace(0, 2 * np.pi, 60)
        disc = float(part.radius) * np.column_stack([np.cos(around), np.sin(around)])
        corners = np.concatenate([centre + disc for centre in centres])
        axes.fill(*(1e3 * corners[ConvexHull(corners).vertices].T), alpha=0.6, label=part.body, color=f"C{2 * k}")
    motion = udk.kinematics(mech, "motor", [found.least.value])
    axes.plot(*(1e3 * np.array([udk.path(mech, motion, pin)[0] for pin in "ABPA"]).T), color="C1", label="coupler")
    axes.plot(*(1e3 * TARGETS.T), "k.")


def make():
    """Return the yield and the least gap of both four-bars, a player of both, and their outlines at the least gap."""
    import matplotlib.pyplot as plt

    path = udk.PathGoal("P", TARGETS, values=np.linspace(0, 1.2, 7), start="free")
    robust, apart = udk.RobustGoal(path, DEVIATIONS, sigmas=6, most=LIMIT), udk.GapGoal("crank", "rocker", least=GAP)
    facts, mechanisms = {}, {}
    figure, panels = plt.subplots(1, 2, figsize=(9, 4), sharex=True, sharey=True, layout="constrained")
    for panel, name, goals in zip(panels, ("nearest", "redesigned"), ([path], [path, robust, apart]), strict=True):
        best = udk.design(DRAWING, goals, lengths=LENGTHS, starts=8)[0]
        error = {"error": udk.PathGoal("P", TARGETS, values=best.values)}
        made = udk.tolerances(best.mechanism, DEVIATIONS, error, values=best.values, limits={"error": LIMIT})
        facts[f"{name}: pieces that pass (%)"] = 100 * made.yield_
        gaps = udk.gaps(best.mechanism)
        facts[f"{name}: least gap of crank and rocker (mm)"] = 1e3 * float(gaps.least.distance)
        draw_outlines(panel, best.mechanism, gaps)
        panel.set_title(f"{name}: {gaps.summary()}", fontsize="medium")
        panel.set(aspect="equal", xlabel="x, mm", ylabel="y, mm")
        mechanisms[name] = best.mechanism
    panels[0].legend()
    runs = {name: udk.simulate(mech, np.linspace(0.0, TURN, 181)) for name, mech in mechanisms.items()}
    title = "A four-bar redesigned for the workshop"
    shown = udk.animate(mechanisms, runs, traces=["P"], targets=TARGETS, measures=("effort",), gaps=True, title=title)
    return facts, {"motion": shown, "outlines": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("workshop_four_bar.html")
