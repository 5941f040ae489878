"""Reactions by pin: all links at one pin, in ground axes, balance each other."""

import numpy as np
from numpy.testing import assert_allclose

import udkjax as udk


def test_the_forces_of_all_links_at_a_pin_balance():
    pins = {"O": [0.0, 0.0], "B": [0.3, 0.0], "C": [0.6, 0.1], "D": [0.4, -0.3]}
    links = {name: udk.Link(["B", end], mass=1.0) for name, end in (("one", "O"), ("two", "C"), ("three", "D"))}
    mech = udk.Drawing(pins, links, ["O"]).mechanism()
    sol = udk.simulate(mech, np.linspace(0.0, 0.2, 3))
    found, by_joint = udk.pin_reactions(mech, sol), udk.reactions(mech, sol)
    assert "B-2" in mech.joints and set(found) == {"O", "B"} and set(found["B"]) == {"one", "two", "three"}
    total = sum(np.asarray(load) for load in found["B"].values())
    size = max(np.abs(np.asarray(load)).max() for load in found["B"].values())
    assert size > 1.0
    assert_allclose(total, np.zeros((3, 3)), rtol=0, atol=1e-12 * size)
    shared = (
        by_joint["B"]["one"][:, :2] + by_joint["B-2"]["one"][:, :2] if "one" in by_joint["B-2"] else by_joint["B"]["one"][:, :2]
    )
    assert_allclose(found["B"]["one"][:, :2], shared, rtol=0, atol=1e-12 * size)
    # Newton's law of the outer link, which nothing else holds.
    a = np.asarray(udk.accelerations(mech, 0.0, sol.q[0], sol.v[0]))[mech.body_names.index("two")]
    assert_allclose(found["B"]["two"][0, :2], a[:2] + [0.0, 9.81], rtol=0, atol=1e-9 * size)
