"""The paper's linkage, live: one constraint is redundant as long as its three links are equal and parallel.

If you change the length of one link, the linkage cannot move, or its loops do not close; the page says which.
"""

import numpy as np

import udkjax as udk

LIVE = [  # changed by sliders of its page
    "gravity",
    "joint.A3.points[0]",
    "joint.A3.points[1]",
    *(f"body.{name}.mass" for name in ("link1", "link2", "link3", "coupler")),
    "body.link1.angular_velocity",
]


def make():
    """Return violation and change of energy, and the player."""
    mech = udk.library.parallelogram()
    sol = udk.simulate(mech, np.linspace(0.0, 10.0, 401))
    energy = np.asarray(udk.energy(mech, sol).total)
    facts = {
        "largest violation (m)": float(np.abs(udk.violation(mech, sol)).max()),
        "largest change of energy (J)": float(np.abs(energy - energy[0]).max()),
    }
    return facts, {"motion": udk.animate(mech, sol, live=LIVE)}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("parallelogram.html")
