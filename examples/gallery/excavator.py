"""An excavator's arm sinks on its cylinders, and the forces in its pins are shown.

Boom, stick and bucket are held by cylinders, which are springs with dampers here.
"""

import numpy as np
from matplotlib.figure import Figure

import udkjax as udk
from udkjax.show import plots


def make():
    """Return the energy lost in dampers, the player, and the forces of pins over time."""
    mech = udk.library.excavator()
    sol = udk.simulate(mech, np.linspace(0.0, 4.0, 161))
    loads = udk.reactions(mech, sol)
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    plots.draw_reactions(figure.subplots(), sol.ts, loads)
    energy = np.asarray(udk.energy(mech, sol).total)
    facts = {"energy dissipated by the dampers (J)": float(energy[0] - energy[-1])}
    return facts, {"motion": udk.animate(mech, sol, measures=("energy",), reactions=True, live=True), "forces": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("excavator.html")
