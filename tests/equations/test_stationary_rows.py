"""Constraints that hold a rotation to second order only, such as parallel guides with a rod between them."""

import jax
import numpy as np
import pytest

import udkjax as udk
from udkjax.equations.rows.analysis import analyse, hold_pins

TS = np.linspace(0, 1, 5)


def rod_between_guides(length=3.0, tilt=0.0, height=1.0, angle_to_first_order=False):
    """Two blocks on parallel guides, joined by a rod as long as their distance; a spring under the first."""
    along, across = np.array([-np.sin(tilt), np.cos(tilt)]), np.array([np.cos(tilt), np.sin(tilt)])
    places = {"one": 0.0, "two": length, "rod": length / 2}
    bodies = {name: udk.Body(1.0, 0.2 * length**2, height * along + x * across, tilt) for name, x in places.items()}
    guides = {f"guide {name}": guide(name, places[name] * across, tilt) for name in ("one", "two")}
    pins = {"A": udk.Revolute(("one", "rod"), [[0, 0], [-length / 2, 0]])}
    ends = [[0, 0], [length / 2, 0]]
    held = udk.Prismatic(("two", "rod"), ends, 0.0)  # an independent reference
    last = {"B": held if angle_to_first_order else udk.Revolute(("two", "rod"), ends)}
    spring = udk.Spring(("ground", "one"), [[0, 0], [0, 0]], stiffness=100.0, length=0.3)
    return udk.Mechanism(bodies, {**guides, **pins, **last}, forces=[spring])


def held_pins(mechanism):
    holding = hold_pins(mechanism)
    return [pin.name for pin in holding.pins] if holding else []


def guide(body, through, tilt):
    return udk.Prismatic(("ground", body), [through, [0, 0]], tilt + np.pi / 2)


@pytest.mark.parametrize(
    ("engine", "length", "tilt"),
    [
        ("native", 3.0, 0.0),
        ("native", 0.05, 0.7),
        ("native", 40.0, -1.1),
        pytest.param("diffrax", 3.0, 0.4, marks=pytest.mark.slow),
    ],
)
def test_a_rod_between_guides_stays_across_them(engine, length, tilt):
    sol = udk.simulate(rod_between_guides(length, tilt), TS, engine=engine)
    right = udk.simulate(rod_between_guides(length, tilt, angle_to_first_order=True), TS, engine=engine)
    np.testing.assert_allclose(sol.q, right.q, atol=1e-7 * max(length, 1.0))
    np.testing.assert_allclose(sol.q[:, 2, 2], tilt, atol=1e-9)
    assert sol.settings["held pins"] == "A" and "held pins" not in right.settings


def test_a_rod_drawn_inexactly():
    """Newton's method converges slowly to such a position: half of its digits are right, and the rod is found nevertheless."""
    mechanism = rod_between_guides()
    drawn = mechanism.with_parameters({"body.rod.angle": 2e-3, "body.rod.position": [1.501, 1.0]})
    sol = udk.simulate(drawn, TS)
    right = udk.simulate(rod_between_guides(angle_to_first_order=True), TS)
    assert sol.settings["held pins"] == "A"
    np.testing.assert_allclose(sol.q, right.q, atol=1e-6)


@pytest.mark.slow
def test_derivatives_of_a_held_rod():
    mechanism, other = rod_between_guides(), rod_between_guides(angle_to_first_order=True)

    def height(m, k):
        return udk.simulate(m.with_parameters({"force.spring1.stiffness": k}), TS).q[-1, 0, 1]

    found = jax.jit(jax.grad(lambda k: height(mechanism, k)))(100.0)
    assert abs(found - jax.grad(lambda k: height(other, k))(100.0)) < 1e-7


@pytest.mark.slow
def test_two_rods_between_the_same_guides():
    """A closed frame of two rods and two long blocks: one rod is held, then the other one is redundant in the usual sense."""
    pins = {"A": (0, 1), "B": (3, 1), "C": (0, 2), "D": (3, 2)}
    links = {"left": ["A", "C"], "right": ["B", "D"], "low": ["A", "B"], "high": ["C", "D"]}
    guides = {f"guide of {x}": {"link": x, "direction": [0, 1]} for x in ("left", "right")}
    frame = udk.Drawing(pins, {name: {"pins": x, "mass": 1.0} for name, x in links.items()}, [], slides=guides).mechanism()
    sol = udk.simulate(frame, TS)
    np.testing.assert_allclose(sol.q[:, :, 1], np.asarray(frame.q0)[:, 1] - 4.905 * TS[:, None] ** 2, atol=1e-8)
    diagnosis = udk.diagnose(frame)
    assert diagnosis.degrees_of_freedom == 1 and diagnosis.cure[0].constraint == "A"
    assert (
        diagnosis.cured is not None
        and analyse(diagnosis.cured).redundant == ()
        and analyse(diagnosis.cured).degrees_of_freedom == 1
    )


@pytest.mark.slow
def test_a_square_of_guides():
    """Blocks on the four sides of a square, opposite ones joined by rods: both rods are held, and one falls."""
    bodies, joints, a = {}, {}, 3.0
    for rod, ends, along, across in (("flat", "we", (0, 1), (1, 0)), ("upright", "sn", (1, 0), (0, 1))):
        along, across = np.array(along), np.array(across)
        tilt = float(np.arctan2(*across[::-1]))
        bodies[rod] = udk.Body(1.0, a**2 / 12, along + a / 2 * across, tilt)
        for x, end in zip((0.0, a), ends, strict=True):
            bodies[end] = udk.Body(1.0, 0.1, along + x * across)
            joints[f"guide {end}"] = udk.Prismatic(("ground", end), [x * across, [0, 0]], np.arctan2(*along[::-1]))
            joints[f"pin {end}"] = udk.Revolute((end, rod), [[0, 0], [x - a / 2, 0]])
    square = udk.Mechanism(bodies, joints)
    assert held_pins(square) == ["pin w", "pin s"]
    sol = udk.simulate(square, TS)
    q = np.asarray(square.q0) + np.zeros((len(TS), 1, 1))
    for body in ("flat", "w", "e"):
        q[:, square.body_names.index(body), 1] -= 4.905 * TS**2
    np.testing.assert_allclose(sol.q, q, atol=1e-8)
    assert udk.diagnose(square).degrees_of_freedom == 2


def test_a_rod_at_the_end_of_a_crank():
    """The first block is driven by a crank and a coupler: the rod is held however the blocks move."""
    free = rod_between_guides()
    crank = udk.Body(1.0, 0.1, (-1.0, 1.0), 0.0)
    pivot = udk.Revolute(("ground", "crank"), [[-1.5, 1.0], [-0.5, 0.0]])
    end = udk.Slot(("one", "crank"), [[0, 0], [0.5, 0]], 0.0)
    driven = udk.Mechanism({**free.bodies, "crank": crank}, {**free.joints, "pivot": pivot, "end": end}, forces=free.forces)
    assert held_pins(driven) == ["A"]
    sol = udk.simulate(driven, TS)
    np.testing.assert_allclose(sol.q[:, 2, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(udk.energy(driven, sol).total, udk.energy(driven, sol).total[0], atol=1e-6)


def test_diagnosis_names_the_pin_and_a_fix():
    diagnosis = udk.diagnose(rod_between_guides(tilt=0.5))
    (found,) = diagnosis.redundancies
    assert found.permanent and found.held == ("A",) and set(found.constraints) == {"A", "B", "guide one", "guide two"}
    assert "1 redundant constraint along the whole motion" in str(diagnosis)
    assert 'A: make it a prismatic joint along 0 degrees of the frame of "one"' in str(diagnosis)
    assert diagnosis.degrees_of_freedom == 1
    cured = diagnosis.cured
    assert cured is not None and analyse(cured).redundant == () and hold_pins(cured) is None
    sol, right = (udk.simulate(m, TS) for m in (cured, rod_between_guides(tilt=0.5, angle_to_first_order=True)))
    np.testing.assert_allclose(sol.q, right.q, atol=1e-7)


@pytest.mark.parametrize(
    "mechanism",
    [
        udk.library.parallelogram(),
        udk.library.parallelogram(0.0),  # its branches meet: gradients depend on each other here only
        udk.library.compound_pendulum(),
        udk.library.peaucellier(),
        rod_between_guides(angle_to_first_order=True),
        rod_between_guides().with_parameters({"joint.B.points": [[0.2, 0.0], [1.5, 0.0]]}),  # a shorter way: it leans
    ],
)
def test_no_other_pin_is_held(mechanism):
    assert hold_pins(mechanism) is None
