"""A scissor lift comes down under its platform, with two redundant constraints.

The guide of the platform is overconstrained; the lift has one degree of freedom, and its energy is constant.
"""

import numpy as np
from matplotlib.figure import Figure

import udkjax as udk
from udkjax.show import plots


def make():
    """Return redundant rows and change of energy, the player, and the energies."""
    mech = udk.library.scissor_lift(3, angle=1.1)
    sol = udk.simulate(mech, np.linspace(0.0, 0.8, 121))
    found, parts = udk.analyse(mech), udk.energy(mech, sol)
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    plots.draw_energy(figure.subplots(), sol.ts, parts)
    facts = {
        "redundant constraints": float(len(found.redundant)),
        "degrees of freedom": float(found.degrees_of_freedom or 0),
        "largest change of energy (J)": float(np.abs(parts.total - parts.total[0]).max()),
    }
    return facts, {"motion": udk.animate(mech, sol, measures=("energy",), traces=("head",), live=True), "energy": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("scissor_lift.html")
