"""A rod is pushed along a floor: with little friction it slides and falls, with much its tip digs in, and it vaults.

Friction at the lower tip slows the rod and turns it. With a coefficient of 0.3 the rod falls back while it slides. With 1.4 its
tip sticks after two milliseconds, and the rod turns over it. Just above that, friction would drive the tip further into the
floor the harder it presses, and rigid bodies have no accelerations: Painleve's paradox, the name with which a run then ends.
"""

import numpy as np

import udkjax as udk

ANGLE, SPEED = 0.95, 2.0  # rad, m/s: of the rod at the start, whose lower tip leads
COEFFICIENTS = 0.3, 1.4
END = 1.8  # s
MOMENT = 0.3  # fraction of the motion at which its picture is taken


def push(coefficient, ts):
    """Return a uniform rod of 1 m, and its motion."""
    rod = udk.Body(1.0, 1 / 12, (0.0, np.sin(ANGLE) / 2), ANGLE, velocity=(-SPEED, 0.0))
    mech = udk.Mechanism({"rod": rod}, name="rod on a floor")
    tips = [udk.Contact("rod", (x, 0.0), coefficient=coefficient, name=name) for name, x in (("tip", -0.5), ("end", 0.5))]
    return mech, udk.simulate(mech, ts, events=tips, throw=False)


def make():
    """Return how the rods end, and the player."""
    ts = np.linspace(0.0, END, 361)
    runs = {f"mu = {mu}": push(mu, ts) for mu in COEFFICIENTS}
    low, high = COEFFICIENTS[-1], 2 * COEFFICIENTS[-1]  # the limit of the coefficient lies between them
    while high - low > 1e-9:
        middle = (low + high) / 2
        ends = push(middle, ts[:2])[1].result == udk.Result.painleve_paradox
        low, high = (low, middle) if ends else (middle, high)
    facts = {
        f"angle of the rod at the end, {label} (deg)": abs(round(float(np.rad2deg(sol.q[-1, 0, 2])), 9))
        for label, (_, sol) in runs.items()
    }
    facts |= {
        "coefficient from which the run ends at once by the paradox": high,
        "the same by hand, (1 + 3 cos^2 a) / (3 sin a cos a)": float(
            (1 + 3 * np.cos(ANGLE) ** 2) / (3 * np.cos(ANGLE) * np.sin(ANGLE))
        ),
    }
    shapes = {"rod": [(-0.5, 0.0), (0.5, 0.0)]}
    mechs, sols = {label: mech for label, (mech, _) in runs.items()}, {label: sol for label, (_, sol) in runs.items()}
    return facts, {"motion": udk.animate(mechs, sols, shapes=shapes, traces=[("rod", (-0.5, 0.0)), ("rod", (0.5, 0.0))])}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("rod_on_floor.html")
