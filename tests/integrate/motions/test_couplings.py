"""Screws and coupled coordinates."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk


def feed(lead=0.01, unit=1.0):
    """A nut of 2 kg on a rail, pulled by gravity along it, and a screw of 0.05 kg m^2 in a bearing of its own."""
    bodies = {"nut": udk.Body(2.0, 0.1 * unit**2, [0.2 * unit, 0.0]), "screw": udk.Body(1.0, 0.05 * unit**2, [0.0, unit])}
    joints = {
        "rail": udk.Prismatic(["ground", "nut"], np.zeros((2, 2)), axis=0.0),
        "bearing": udk.Revolute(["ground", "screw"], [[0.0, unit], [0.0, 0.0]]),
        "thread": udk.Screw(["ground", "nut"], np.zeros((2, 2)), 0.0, ["ground", "screw"], lead * unit),
    }
    return udk.Mechanism(bodies, joints, gravity=(1.5 * unit, 0.0))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e3])
@pytest.mark.parametrize("lead", [0.01, -0.3])
def test_a_nut_falls_as_fast_as_the_inertia_of_its_screw_allows(unit, lead):
    ratio = lead / (2 * np.pi)
    acceleration = 2.0 * 1.5 * unit / (2.0 + 0.05 / ratio**2)
    mech = feed(lead, unit)
    assert udk.analyse(mech).degrees_of_freedom == 1
    for engine in ("native", "diffrax"):
        end = udk.simulate(mech, [0.0, 1.0], engine=engine)
        moved = np.asarray(end.q[-1] - mech.q0)
        assert_allclose(moved[0, 0], acceleration / 2, rtol=1e-10)
        assert_allclose(moved[1, 2], acceleration / 2 / (ratio * unit), rtol=1e-10)
    loads = udk.reactions(mech, end, frame="joint")["thread"]
    assert_allclose(loads["nut"][0], [2.0 * (acceleration - 1.5 * unit), 0.0, 0.0], atol=1e-12 * unit)
    assert_allclose(loads["screw"][0, 2], -ratio * unit * loads["nut"][0, 0], rtol=1e-12)


def test_the_motion_of_a_screw_has_derivatives_of_second_order():
    def fallen(lead):
        return udk.simulate(feed().with_parameters({"joint.thread.lead": lead}), [0.0, 1.0]).q[-1, 0, 0]

    def exact(lead):
        return 0.2 + 1.5 / (2.0 + 0.05 * (2 * jnp.pi / lead) ** 2)

    leads = jnp.array([0.3, 1.0])
    found = jax.jit(lambda x: [jax.vmap(f)(x) for f in (fallen, jax.grad(fallen), jax.jacfwd(jax.grad(fallen)))])(leads)
    wanted = [jax.vmap(f)(leads) for f in (exact, jax.grad(exact), jax.grad(jax.grad(exact)))]
    for value, closed in zip(found, wanted, strict=True):
        assert_allclose(value, closed, rtol=1e-7)


def test_coupled_coordinates_follow_a_polynomial():
    bodies = {"one": udk.Body(1.0, 0.1), "two": udk.Body(1.0, 0.1, angle=0.7), "car": udk.Body(1.0, 0.1, [0.4, 0.0])}
    joints = {
        "A": udk.Revolute(["ground", "one"], np.zeros((2, 2))),
        "B": udk.Revolute(["ground", "two"], np.zeros((2, 2))),
        "rail": udk.Prismatic(["ground", "car"], np.zeros((2, 2)), axis=0.3),
        "angles": udk.Coupling(["ground", "two"], ["one", "ground"], [0.7, -0.5, 0.0, 0.1]),  # of a and of -a
        "slide": udk.Coupling(["ground", "car"], ["one", "two"], [0.1, 0.2, 0.3], axis=0.3),
    }
    mech = udk.Mechanism(bodies, joints, {"motor": udk.Driver(["ground", "one"], "angle", udk.Polynomial([0.0, 1.0]))})
    a = np.linspace(0.0, 1.0, 4)
    q = np.asarray(udk.kinematics(mech, "motor", a).q)
    b = 0.7 + 0.5 * a - 0.1 * a**3
    assert_allclose(q[:, 1, 2], b, atol=1e-12)
    assert_allclose(np.hypot(q[:, 2, 0], q[:, 2, 1]), 0.1 + 0.2 * (b - a) + 0.3 * (b - a) ** 2, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"turning": ["screw", "screw"]}, "turning: must name two bodies"),
        ({"turning": ["ground", "scew"]}, 'turning[1]: no body named "scew"; did you mean "screw"?'),
        ({"lead": None}, "lead: must be finite, not nan"),
    ],
)
def test_mistakes_in_a_screw_are_named(change, said):
    table = {"turning": ("ground", "screw"), "lead": 0.01} | change
    joint = udk.Screw(["ground", "nut"], np.zeros((2, 2)), 0.0, table["turning"], table["lead"])
    mech = feed()
    with pytest.raises(udk.SceneError, match=re.escape(said)):
        udk.Mechanism(mech.bodies, {**mech.joints, "thread": joint})
    with pytest.raises(udk.SceneError, match="points: an angle has no points"):
        coupling = udk.Coupling(["ground", "nut"], ["ground", "screw"], [0.0, 1.0], points=np.zeros((2, 2)))
        udk.Mechanism(mech.bodies, {**mech.joints, "thread": coupling})


DRAWN = """
format = 2
units = {length = "mm", angle = "deg"}
ground = ["O"]
pins = {O = [0, 100], P = [50, 0]}
link = [{name = "screw", pins = ["O"], mass = 1, width = 80}, {name = "nut", pins = ["P"], mass = 2, width = 30}]
slide = [{name = "rail", link = "nut", direction = 30}]
screw = [{name = "thread", slide = "rail", pin = "O", lead = 4}]
motor = [{name = "crank", pin = "O", speed = "60 rpm"}]

[[joint]]
name = "again"
type = "coupling"
bodies = ["ground", "nut"]
axis = 30
to = ["ground", "screw"]
coefficients = [43.301270189221932, "4 mm/rev"]
"""


def test_a_drawn_screw_moves_its_slide():
    mech = udk.loads(DRAWN)
    along = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    assert udk.analyse(mech).redundant == (("again", 0),)  # the same law once more, in the units of the file
    end = np.asarray(udk.simulate(mech, [0.0, 2.5]).q[-1])
    assert_allclose(end[1, :2], [0.05, 0.0] + 0.01 * along, atol=1e-10)
    assert udk.dumps(udk.loads(udk.dumps(mech))) == udk.dumps(mech)
    shorter = mech.with_parameters({"screw.thread.lead": 0.002})
    assert_allclose(shorter.joints["thread"].lead, 0.002)
    with pytest.raises(udk.SceneError, match=r'screw "thread" .*slide: no slide named "rial"; did you mean "rail"'):
        udk.loads(DRAWN.replace('slide = "rail", pin', 'slide = "rial", pin'))
    with pytest.raises(udk.SceneError, match='pin: "P" must join two links'):
        udk.loads(DRAWN.replace('pin = "O", lead', 'pin = "P", lead'))
