"""Assembly branches compared with closed forms and with counts."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.scene.library.posed_bodies import bar_pose


def linkage(pins, bars):
    """A linkage of bars between named points. `pins` are their places, `bars` the two ends of each bar and further points."""
    ground = [name for name in pins if name.isupper()]
    bodies, joints, seen = {}, {}, {}
    for name, ends in bars.items():
        position, angle = bar_pose(*(np.asarray(pins[e], float) for e in ends[:2]))
        bodies[name] = udk.Body(1.0, 0.1, position, angle)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        for e in ends:
            local = turn @ (np.asarray(pins[e], float) - np.asarray(position))
            if e in ground:
                joints[f"{e}{name}"] = udk.Revolute(("ground", name), [pins[e], local])
            elif e in seen:
                other, point = seen[e]
                joints[f"{e}{name}"] = udk.Revolute((other, name), [point, local])
            else:
                seen[e] = name, local
    return udk.Mechanism(bodies, joints)


def circles(p, r, q, s):
    """Return the points at distance r from p and s from q."""
    d = np.linalg.norm(q - p)
    x = (d**2 + r**2 - s**2) / (2 * d)
    y = np.sqrt(r**2 - x**2)
    e = (q - p) / d
    return [p + x * e + sign * y * np.array([-e[1], e[0]]) for sign in (1, -1)]


def test_a_four_bar_has_two():
    mech = udk.library.four_bar(np.pi / 3)
    found = np.asarray(udk.branches(mech, "body.crank.angle", 1.2, starts=100))
    assert len(found) == 2
    a, b, c = 1.0, 2.5, 2.0
    pins = circles(a * np.array([np.cos(1.2), np.sin(1.2)]), b, np.array([2.5, 0.0]), c)
    for q in found:
        pin = q[2, :2] + c / 2 * np.array([np.cos(q[2, 2]), np.sin(q[2, 2])])
        assert min(np.linalg.norm(pin - exact) for exact in pins) < 1e-13


def test_none_where_it_cannot_be_closed():
    mech = udk.library.four_bar(np.pi / 3, lengths=(1.0, 1.5, 1.2), ground=2.2)
    assert udk.branches(mech, "body.crank.angle", 3.0, starts=50).shape == (0, 3, 3)


@pytest.mark.slow
def test_a_six_bar_of_stephenson_has_as_many_as_its_circle_meets_the_coupler_curve():
    """A rod joins a coupler point p of a four-bar A-b-c-D to the end g of a driven crank on H: up to six branches."""
    pins = {"A": (0, 0), "b": (0.45, 0.3), "c": (1.1, 1.2), "D": (1.0, 0.0), "p": (0.2, 1.3), "g": (0.35, 0.35), "H": (0.3, 0.3)}
    bars = {"left": "Ab", "coupler": "bcp", "right": "Dc", "rod": "pg", "crank": "Hg"}
    mech = linkage(pins, bars)
    found = np.asarray(udk.branches(mech, "body.crank.angle", float(mech.q0[4, 2]), starts=600))
    far = {k: np.asarray(p, float) for k, p in pins.items()}
    length = lambda one, other: np.linalg.norm(far[one] - far[other])  # noqa: E731
    shape = complex(*(far["p"] - far["b"])) / complex(*(far["c"] - far["b"]))

    def beyond(angle, sign):
        """Return how far p is beyond the rod's reach; NaN where the four-bar does not close."""
        b = length("A", "b") * np.array([np.cos(angle), np.sin(angle)])
        d = np.linalg.norm(far["D"] - b)
        r, s = length("b", "c"), length("D", "c")
        if not abs(r - s) < d < r + s:
            return np.nan
        c = circles(b, r, far["D"], s)[sign]
        p = complex(*b) + shape * complex(*(c - b))
        return abs(p - complex(*far["g"])) - length("p", "g")

    crossings = 0
    for sign in (0, 1):
        values = np.array([beyond(x, sign) for x in np.linspace(-np.pi, np.pi, 20001)])
        crossings += int(np.sum(values[1:] * values[:-1] < 0))
    assert crossings >= 4
    assert len(found) == crossings


def test_the_seed_decides():
    mech = udk.library.four_bar(np.pi / 3)
    one, other = (udk.branches(mech, "body.crank.angle", 1.2, starts=100, seed=seed) for seed in (0, 3))
    np.testing.assert_allclose(one, other, atol=1e-12)
