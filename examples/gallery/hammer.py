"""A hammer falls on its anvil, rebounds and comes to rest: each blow is an event, also in the live page.

A spring drives the hammer, and its head hits a contact with a restitution of 0.6. Each blow is a tick on the timeline. The blows
become weaker and weaker until the hammer is at rest.
"""

import numpy as np

import udkjax as udk

RESTITUTION = 0.6
RAISED = np.pi / 3  # rad: the angle from which it falls
LIVE = ["spring.drive.stiffness", "spring.drive.angle", "link.hammer.density", "gravity[1]"]  # changed by sliders of its page
MOMENT = 0.12  # fraction of the motion at which its picture is taken


def make():
    """Return facts of the blows, and the player."""
    corners = np.array(
        [(0, -10), (260, -10), (260, -40), (300, -40), (300, 40), (260, 40), (260, 10), (0, 10)]
    )  # mm, along the handle
    raised = np.array([[np.cos(RAISED), -np.sin(RAISED)], [np.sin(RAISED), np.cos(RAISED)]])
    pivot = np.array([0, 40])
    drawing = udk.Drawing(
        pins={"O": pivot, "H": pivot + raised @ (280, 0)},
        links={"hammer": {"pins": ["O", "H"], "density": 7850, "thickness": 20, "outline": pivot + corners @ raised.T}},
        ground=["O"],
        springs={"drive": {"pin": "O", "stiffness": "4 N m/rad", "angle": "-90 deg"}},
        units={"length": "mm"},
        name="hammer",
    )
    mech = drawing.mechanism()
    _, head = drawing.free_pins()["H"]  # in the hammer's frame
    anvil = udk.Contact("hammer", point=head - np.array([0, 0.04]), restitution=RESTITUTION, name="anvil")
    sol = udk.simulate(mech, np.linspace(0.0, 2.0, 401), events=[anvil])
    events = sol.events
    assert events is not None  # as there is one
    blows = np.flatnonzero(np.asarray(events.index) == 0)
    before, after = (abs(np.asarray(v)[blows, 0, 2]) for v in (events.v_before, events.v_after))
    facts = {
        "number of blows before the hammer is at rest": len(blows),
        "angular velocity after a blow, relative to the one before it": float(np.median(after / before)),
        "angular velocity before the second blow, relative to the one after the first": float(before[1] / after[0]),
    }
    return facts, {"motion": udk.animate(mech, sol, traces=["H"], live=LIVE, events=[anvil])}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("hammer.html")
