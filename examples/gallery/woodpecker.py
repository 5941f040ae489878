"""A woodpecker pecks its way down a pole: its ring locks by friction, and every peck frees it.

The toy of Glocker and Leine: a ring with play on a rough pole, and a woodpecker on a spring. While the ring is tilted, friction
holds it; as the bird swings back, the ring comes free and falls until the bird has swung to the pole and back. After a few pecks
all are alike.
"""

import numpy as np

import udkjax as udk

POLE, BORE, HALF = 2.5, 3.1, 5.8  # mm: radii of the pole and of the ring's bore, half of the ring's height
ARM, NECK, BEAK = 10.0, 15.0, (-20.1, 20.0)  # mm: pole to spring, spring to the bird's centre, from there to its beak
FRICTION, RESTITUTION = 0.3, 0.5  # of all contacts, and of the beak
RING, BIRD = (0.3e-3, 5e-9), (4.5e-3, 7e-7)  # kg, kg m^2
SPRING = 0.0056  # N m/rad
TILT, SWING = (-0.1, 0.0), (-0.2788, -7.4583)  # rad and rad/s at the start: of the ring, and of the bird
FALL = -0.3411  # m/s
END = 1.2  # s
SHAPES = {  # mm
    "ring": [(-BORE, HALF), (BORE, HALF), (BORE, -HALF), (-BORE, -HALF)],
    "bird": [(-12.0, 16.0), BEAK, (-8.0, 24.0), (6.0, 12.0), (4.0, -30.0)],
}
LIVE = ["force.spring.stiffness", "gravity[1]"]  # numbers with sliders
MOMENT = 0.96  # fraction of the motion at which its picture is taken


def toy():
    """Return the toy, and its contacts."""
    arm, neck = 1e-3 * ARM, 1e-3 * NECK

    def along(angle):
        return np.array([np.cos(angle), np.sin(angle)])

    def across(angle, rate):
        return rate * np.array([-np.sin(angle), np.cos(angle)])

    at = arm * along(TILT[0]) + neck * along(SWING[0])
    velocity = (0.0, FALL) + arm * across(*TILT) + neck * across(*SWING)
    mech = udk.Mechanism(
        {
            "ring": udk.Body(*RING, (0.0, 0.0), TILT[0], (0.0, FALL), TILT[1]),
            "bird": udk.Body(*BIRD, at, SWING[0], velocity, SWING[1]),
        },
        {
            "pole": udk.Slot(("ground", "ring"), ((0.0, 0.0), (0.0, 0.0)), np.pi / 2),
            "pivot": udk.Revolute(("ring", "bird"), ((arm, 0.0), (-neck, 0.0))),
        },
        forces={"spring": udk.TorsionSpring(("ring", "bird"), SPRING)},
        name="woodpecker",
    )
    pole = {"through": (1e-3 * POLE, 0.0), "normal": (1.0, 0.0), "coefficient": FRICTION}
    beak = udk.Contact("bird", 1e-3 * np.array(BEAK), restitution=RESTITUTION, name="peck", **pole)
    edges = [
        udk.Contact("ring", (1e-3 * BORE, y), name=name, **pole) for name, y in (("low", -1e-3 * HALF), ("high", 1e-3 * HALF))
    ]
    return mech, [beak, *edges]


def make():
    """Return facts of the pecks, and the player."""
    mech, contacts = toy()
    sol = udk.simulate(mech, np.linspace(0.0, END, 601), events=contacts, max_events=400)
    assert sol.events is not None  # as there are contacts
    pecks = np.flatnonzero(np.asarray(sol.events.index) == 0)
    times, heights = np.asarray(sol.events.time)[pecks], 1e3 * np.asarray(sol.events.q_before)[pecks, 0, 1]
    energy = np.asarray(udk.energy(mech, sol).total)
    facts = {
        "number of pecks": len(pecks),
        "time between the last two pecks (s)": float(times[-1] - times[-2]),
        "descent between them (mm)": float(heights[-2] - heights[-1]),
        "largest gain of energy between two times (J)": float(np.max(np.diff(energy))),
    }
    shapes = {name: 1e-3 * np.array(points) for name, points in SHAPES.items()}
    traces = [("bird", 1e-3 * np.array(BEAK))]
    return facts, {"motion": udk.animate(mech, sol, shapes=shapes, traces=traces, live=LIVE, events=contacts)}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("woodpecker.html")
