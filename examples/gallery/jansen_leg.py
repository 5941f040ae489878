"""Theo Jansen's leg in a batch: how the path of its foot depends on the length of its crank.

The seven links are sized by Jansen's "eleven holy numbers". One call computes the legs for all crank lengths.
"""

import jax
import numpy as np
from matplotlib.figure import Figure

import udkjax as udk
from udkjax.show import plots

# Jansen's numbers in metres: a, l are the position of the crank's axle relative to the fixed pin; m is the crank.
A, L, M = 0.380, 0.078, 0.150
BARS = {"b": 0.415, "c": 0.393, "d": 0.401, "e": 0.558, "f": 0.394, "g": 0.367, "h": 0.657, "i": 0.490, "j": 0.500, "k": 0.619}
BODIES = {  # pins of each link: two for a bar, three for a plate
    "crank": "OA",
    "upper bar": "AB",
    "upper plate": "PBD",
    "lower bar": "AC",
    "inner bar": "PC",
    "outer bar": "DE",
    "foot": "CEF",
}
TURN = 2 * np.pi  # s, of the crank at 1 rad/s


def meet(p, q, a, b, left):
    """Return the point at distances a from p and b from q, to the left or right of the line from p to q."""
    way = q - p
    square = way @ way
    x = (square + a**2 - b**2) / (2 * square)
    y = np.sqrt(a**2 / square - x**2) * (1 if left else -1)
    return p + x * way + y * np.array([-way[1], way[0]])


def leg(angle=0.0, rate=1.0):
    """Return the leg with its crank at an angle (rad), driven at a constant rate (rad/s)."""
    axle, fixed = np.zeros(2), np.array([-A, -L])
    crank = M * np.array([np.cos(angle), np.sin(angle)])
    top = meet(crank, fixed, BARS["j"], BARS["b"], left=False)
    low = meet(crank, fixed, BARS["k"], BARS["c"], left=True)
    side = meet(fixed, top, BARS["d"], BARS["e"], left=True)
    knee = meet(side, low, BARS["f"], BARS["g"], left=False)
    foot = meet(low, knee, BARS["i"], BARS["h"], left=True)
    pins = {"O": axle, "A": crank, "B": top, "P": fixed, "C": low, "D": side, "E": knee, "F": foot}
    links = {}
    for name, through in BODIES.items():
        size = np.linalg.norm(pins[through[0]] - pins[through[-1]])
        links[name] = udk.Link(list(through), mass=size, inertia=size**3 / 12)  # 1 kg/m
    motors = {"motor": {"pin": "O", "speed": rate}}
    return udk.Drawing(pins, links, ground=["O", "P"], motors=motors, name="Jansen's leg").mechanism()


def make():
    """Return facts of the steps, the player of one leg, and the feet's paths of all."""
    mech = leg()
    ts = np.linspace(0.0, TURN, 121)
    cranks = np.array([0.12, 0.135, M, 0.16])

    def motion(crank):
        moved = udk.with_length(mech, "crank", crank)
        return udk.path(moved, udk.simulate(moved, ts, throw=False), "F")

    paths = {f"crank {1e3 * crank:g} mm": np.asarray(p) for crank, p in zip(cranks, jax.vmap(motion)(cranks), strict=True)}
    figure = Figure(figsize=(7, 3.8), layout="constrained")
    plots.draw_coupler_curves(figure.subplots(), paths)
    walk = paths[f"crank {1e3 * M:g} mm"]
    low = walk[:, 1] < walk[:, 1].min() + 0.02
    facts = {
        "fraction of a turn during which the foot is on the ground": float(low.mean()),
        "length of a step (m)": float(np.ptp(walk[low, 0])),
        "distance of the foot from its start after a turn (m)": float(np.abs(walk[-1] - walk[0]).max()),
    }
    sol = udk.simulate(mech, ts)
    animation = udk.animate(mech, sol, measures={"height of the foot (m)": walk[:, 1]}, traces=("F", "E"), live=True)
    return facts, {"motion": animation, "paths": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("jansen_leg.html")
