"""A live four-bar linkage by its lengths: sliders change them and the speed of its motor, and its bodies can be dragged.

The drawing is the same as in the README. If the loops cannot be closed, or the motor cannot turn on, the page says so.
"""

import numpy as np

import udkjax as udk

LIVE = ["motor.motor.speed", "pin.A.length", "pin.B.length", "pin.P.length", "pin.P.angle", "gravity[1]"]  # of sliders
FILM = {"width": 400, "fps": 12.5, "speed": 0.35}  # samples of one turn


def make():
    """Return the torque of the motor, and the player."""
    drawing = udk.Drawing(
        pins={
            "O": (0, 0),
            "C": (100, 0),
            "A": udk.polar("O", 40, 60),  # mm, deg
            "B": udk.circles(("A", "C"), (120, 80), "left"),
            "P": udk.polar("A", 70, 40, line=("A", "B")),
        },
        links={
            "crank": {"pins": ["O", "A"], "density": 7850, "width": 15, "thickness": 5},
            "coupler": {"pins": ["A", "B", "P"], "density": 7850, "thickness": 5},
            "rocker": {"pins": ["C", "B"], "density": 7850, "width": 15, "thickness": 5},
        },
        ground=["O", "C"],
        motors={"motor": {"pin": "O", "speed": "60 rpm"}},
        units={"length": "mm", "angle": "deg"},
        name="four-bar",
    )
    mech = drawing.mechanism()
    sol = udk.simulate(mech, np.linspace(0.0, 2.0, 201))
    facts = {
        "largest torque of the motor (N m)": float(np.abs(udk.efforts(mech, sol)["motor"]).max()),
        "distance of the coupler from its start after a turn (m)": float(np.abs(sol.q[100, 1, :2] - sol.q[0, 1, :2]).max()),
    }
    turn = udk.simulate(mech, np.linspace(0.0, 1.0, 101))
    film = udk.animate(mech, turn, traces=["A", "B", "P"], measures=())
    home = udk.animate(mech, sol, traces=["P"], live=LIVE[:3], measures=())  # for the first page of the documentation
    return facts, {"motion": udk.animate(mech, sol, traces=["P"], live=LIVE), "film": film, "home": home}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("four_bar.html")
