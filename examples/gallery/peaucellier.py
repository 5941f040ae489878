"""Peaucellier's linkage of 1864 turns a rotation into an exact straight line.

Its far corner D moves on x = (arm^2 - side^2) / (2 crank), to machine precision.
"""

import numpy as np

import udkjax as udk

ARM, SIDE, CRANK = 2.0, 1.2, 0.6  # m


def make():
    """Return the error and length of the line, and the player."""
    mech = udk.library.peaucellier()
    sol = udk.simulate(mech, np.linspace(0.0, 6.0, 181))
    x, y, angle = np.asarray(sol.q)[:, mech.body_names.index("AD")].T
    corner = x + 0.5 * SIDE * np.cos(angle)
    line = (ARM**2 - SIDE**2) / (2 * CRANK)
    facts = {
        "largest distance of D from its line (m)": float(np.abs(corner - line).max()),
        "length of the line that it draws (m)": float(np.ptp(y + 0.5 * SIDE * np.sin(angle))),
    }
    return facts, {
        "motion": udk.animate(mech, sol, measures={"x of D (m)": corner, "energy": None}, traces=("D", "C1"), live=True)
    }


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("peaucellier.html")
