"""Letters and a star, each drawn by a linkage with one motor that `udk.mechanisms_for` found.

Nothing but the curve is given; structure and dimensions of the linkages are found. Letters are drawn by a part of the turn, in
which the pin may retrace a stroke. The star takes a second crank, driven by a belt at a multiple of the speed of the first.
"""

import numpy as np

import udkjax as udk

BOWL = np.exp(1j * np.linspace(0.0, np.pi, 49))
LETTERS = {
    "U": np.array([0, *(2 - 4j - 2 * BOWL), 4]),
    "D": np.array([-6j, 0, *(1 - 3j + 3j / BOWL), -6j]),
    "K": np.array([0, -6j, -3.6j, 4, 1.5 - 2.25j, 4 - 6j]),
}
SIZE = 8.0  # m, from the middle of a curve that is 6 m high
ENOUGH = 0.02  # error with which a search ends
TURN = 1.0  # s, at 60 rpm
FRAMES = 161
MOMENT = 0.95  # fraction of the motion at which its picture is taken


def make():
    """Return the errors, and the player of all mechanisms side by side."""
    corners = np.arange(11)
    star = np.where(corners % 2, 1.8, 4.0) * np.exp(1j * np.pi * (0.5 + corners / 5))
    curves = {name: np.stack([np.real(z), np.imag(z)], 1) for name, z in (LETTERS | {"star": star}).items()}
    facts, mechanisms, motions = {}, {}, {}
    for name, curve in curves.items():
        best = udk.mechanisms_for(curve, size=SIZE, seconds=600, rounds=2, error=ENOUGH, results=1, progress=False)[0]
        facts[f"{name}: error relative to its RMS radius, by {best.bars} bars"] = best.error
        mechanisms[name] = best.mechanism
        share = float(np.ptp(best.values)) / (2 * np.pi)
        motions[name] = udk.simulate(best.mechanism, np.linspace(0.0, share * TURN, FRAMES))
    return facts, {"motion": udk.animate(mechanisms, motions, traces=["P"])}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("drawn_curves.html")
