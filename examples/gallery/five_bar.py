"""The paper's five-bar linkage, side by side: with projection, and without stabilization.

Three parallel links carry a coupler: one constraint is redundant. Without stabilization this constraint drifts until the
pseudoinverse treats it as independent; then no degree of freedom is left, and the linkage stops in mid-air.
"""

import numpy as np

import udkjax as udk

MOMENT = 0.9  # fraction of the motion at which its picture is taken


def make():
    """Return facts of the two runs, and the player."""
    mech = udk.library.parallelogram()
    ts = np.linspace(0.0, 20.0, 401)
    projected = udk.simulate(mech, ts, rtol=1e-9, atol=1e-9)
    drifting = udk.simulate(mech, ts, rtol=1e-4, atol=1e-4, stabilization=None, method=udk.SVD(rank_tol=1e-6), drift_tol=np.inf)
    facts = {
        "largest violation with projection (m)": float(np.abs(udk.violation(mech, projected)).max()),
        "angular velocity of the links at the end, without stabilization (rad/s)": float(abs(drifting.v[-1, 0, 2])),
    }
    return facts, {"motion": udk.animate(mech, {"projected": projected, "not stabilized": drifting})}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("five_bar.html")
