"""Letters and a star, each drawn by a linkage with one motor that `udk.mechanisms_for` found.

Nothing but the curve is given; structure and dimensions of the linkages are found. Letters are drawn by a part of the turn, in
which the pin may retrace a stroke. The star takes a second crank, driven by a belt at a multiple of the speed of the first.
"""

import numpy as np

import udkjax as udk
from udkjax.synthesis.curves.curve_file import points_of_path

LETTERS = {
    "U": "M0 0 V4 A2 2 0 0 0 4 4 V0",
    "D": "M0 6 V0 H1 A3 3 0 0 1 1 6 Z",
    "K": "M0 0 V6 V3.6 L4 0 L1.5 2.25 L4 6",
}
SIZE = 8.0  # m, from the middle of a curve that is 6 m high
TURN = 1.0  # s, at 60 rpm
FRAMES = 161
MOMENT = 0.95  # fraction of the motion at which its picture is taken


def make():
    """Return the errors, and the player of all mechanisms side by side."""
    corners = np.arange(11)
    star = np.where(corners % 2, 1.8, 4.0) * np.exp(1j * np.pi * (0.5 + corners / 5))
    curves = {name: points_of_path(path) for name, path in LETTERS.items()} | {
        "star": np.stack([np.real(star), np.imag(star)], 1)
    }
    facts, mechanisms, motions = {}, {}, {}
    for name, curve in curves.items():
        best = udk.mechanisms_for(curve, size=SIZE, seconds=600, rounds=1 + (name in ("K", "star")), results=1, progress=False)[0]
        facts[f"{name}: error relative to its RMS radius, by {best.bars} bars"] = best.error
        mechanisms[name] = best.mechanism
        share = float(np.ptp(best.values)) / (2 * np.pi)
        motions[name] = udk.simulate(best.mechanism, np.linspace(0.0, share * TURN, FRAMES))
    return facts, {"motion": udk.animate(mechanisms, motions, traces=["P"])}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("drawn_curves.html")
