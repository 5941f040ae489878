"""A planetary gear with three planets, two of them redundant: its carrier turns at sun / (sun + ring) of the sun's speed."""

import numpy as np

import udkjax as udk

SUN, PLANET = 0.2, 0.1  # m


def make():
    """Return the ratio of speeds and that of the textbook (Willis), and the player."""
    mech = udk.library.planetary_gear(sun=SUN, planet=PLANET)
    sol = udk.simulate(mech, np.linspace(0.0, 12.0, 121))
    v = np.asarray(sol.v)[:, :, 2]
    ratio = v[-1, mech.body_names.index("carrier")] / v[-1, mech.body_names.index("sun")]
    facts = {"carrier / sun": float(ratio), "sun / (sun + ring)": SUN / (SUN + SUN + 2 * PLANET)}
    return facts, {"motion": udk.animate(mech, sol, measures=("energy",), live=True)}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("planetary_gear.html")
