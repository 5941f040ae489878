"""Paths, velocities and accelerations of points and pins, by any name and in every transformation."""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.positions.assembling.channel_values import measure
from udkjax.positions.assembling.channels import channel_of

ORDERS: tuple[Literal[0, 1, 2], ...] = (0, 1, 2)  # positions, velocities, accelerations
TIP = (0.3, -0.1)
TS = np.linspace(0.0, 0.2, 41)


@pytest.fixture(scope="module")
def linkage():
    mech = udk.library.four_bar()
    return mech, udk.simulate(mech, TS, rtol=1e-11, atol=1e-11)


def slope(x, step=TS[1]):
    """The rate of a path by central differences of fourth order."""
    return (8 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12 * step)


def test_a_path_is_where_the_point_is_and_its_derivatives_are_its_rates(linkage):
    mech, sol = linkage
    q = np.asarray(sol.q[:, 1])
    turned = np.stack(
        [np.cos(q[:, 2]) * TIP[0] - np.sin(q[:, 2]) * TIP[1], np.sin(q[:, 2]) * TIP[0] + np.cos(q[:, 2]) * TIP[1]], 1
    )
    x, v, a = (np.asarray(udk.path(mech, sol, "coupler", TIP, derivative=k)) for k in ORDERS)
    assert_allclose(x, q[:, :2] + turned, rtol=0, atol=1e-14)
    assert_allclose(sol.path("coupler", TIP), x, rtol=0, atol=1e-14)
    assert_allclose(v[2:-2], slope(x), rtol=0, atol=1e-6 * np.abs(v).max())
    assert_allclose(a[2:-2], slope(v), rtol=0, atol=1e-5 * np.abs(a).max())


def test_a_pin_is_where_both_of_its_bodies_have_it(linkage):
    mech, sol = linkage
    for name, joint in mech.joints.items():
        for k in ORDERS:
            one, other = (
                np.asarray(udk.path(mech, sol, f"body.{body}", point, derivative=k))
                for body, point in zip(joint.bodies, joint.points, strict=True)
            )
            assert_allclose(one, other, rtol=0, atol=1e-9 * max(1.0, np.abs(one).max()))
            for given in (name, f"joint.{name}", f"pin.{name}"):
                assert_allclose(udk.path(mech, sol, given, derivative=k), other, rtol=0, atol=1e-14)


def test_the_accelerations_of_a_kinematic_motion_are_its_own():
    mech = udk.library.slider_crank(angular_velocity=3.0)
    motion = udk.kinematics(mech, None, TS)
    x, v, a = (np.asarray(udk.path(mech, motion, "P", derivative=k)) for k in ORDERS)
    assert_allclose(v[2:-2], slope(x), rtol=0, atol=1e-6 * np.abs(v).max())
    assert_allclose(a[2:-2], slope(v), rtol=0, atol=1e-5 * np.abs(a).max())
    assert_allclose(motion.path("crank", TIP), udk.path(mech, motion, "crank", TIP), rtol=0, atol=1e-14)


def test_a_path_is_differentiated_and_batched(linkage):
    mech, sol = linkage
    point = jnp.asarray(TIP)

    def lowest(points, x):
        other = mech.with_parameters({"joint.B.points": points})
        runs = udk.simulate(other, TS[:3], throw=False)
        return udk.path(other, runs, "B")[-1, 1] + udk.path(other, runs, "coupler", x, derivative=1)[-1, 0]

    points = mech.joints["B"].points
    both = jax.jit(jax.value_and_grad(lowest, (0, 1)))
    _, (by_points, by_x) = both(points, point)
    step = 1e-5
    for k in np.ndindex(2, 2):
        ends = [both(points.at[k].add(s * step), point)[0] for s in (1, -1)]
        assert_allclose(by_points[k], (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-7)
    ends = [both(points, point.at[0].add(s * step))[0] for s in (1, -1)]
    assert_allclose(by_x[0], (ends[0] - ends[1]) / (2 * step), rtol=1e-6, atol=1e-9)
    several = jax.vmap(lambda x: udk.path(mech, sol, "coupler", x))(jnp.stack([point, 2 * point]))
    assert several.shape == (2, len(TS), 2)
    assert_allclose(several[1], udk.path(mech, sol, "coupler", 2 * point), rtol=0, atol=1e-14)


@pytest.mark.slow
def test_after_a_failure_a_path_is_not_a_number_and_its_gradient_is(linkage):
    mech, sol = linkage
    q = sol.q.at[20:].set(jnp.nan)

    def total(q, x):
        motion = udk.Solution(sol.ts, q, sol.v, sol.code, sol.time, {}, sol.rtol, sol.atol, sol.bodies, ())
        found = udk.path(mech, motion, "coupler", x, derivative=2)
        return jnp.sum(found[:20]), found

    gradients, found = jax.jit(jax.grad(total, (0, 1), has_aux=True))(q, jnp.asarray(TIP))
    assert np.isnan(found[20:]).all() and np.isfinite(found[:20]).all()
    assert np.isfinite(gradients[1]).all() and np.isfinite(gradients[0]).all() and np.any(gradients[0])


@pytest.mark.parametrize(
    ("of", "point", "problem"),
    [
        ("copler", None, '"copler" is neither a body nor a pin; did you mean "coupler"?'),
        ("x y z", None, "there are "),
        ("B", (0.0, 0.0), '"B" is a pin, whose point is known'),
        ("coupler", (0.0, 0.0, 0.0), "its shape is (3,)"),
        ("coupler", 0.1, "its shape is ()"),
        ("turn", None, 'joint "turn", a Angle, is not at a point'),
        ("both", None, '"both" is a body and a joint: write "body.both" or "joint.both"'),
    ],
)
def test_what_cannot_be_found_is_named(linkage, of, point, problem):
    mech, sol = linkage
    bodies, joints = dict(mech.bodies), dict(mech.joints)
    if of == "both":
        bodies, joints = {"both": udk.Body(1, 1)}, {"both": udk.Revolute(["ground", "both"], [[0, 0], [0, 0]])}
    elif of == "turn":
        joints["turn"] = udk.Angle(["crank", "rocker"])
    other = udk.Mechanism(bodies, joints)
    motion = sol if of != "both" else udk.simulate(other, TS[:2])
    with pytest.raises(ValueError) as caught:
        udk.path(other, motion, of, point)
    assert problem in str(caught.value)
    with pytest.raises(ValueError, match=r'no body named "B".*udk\.path'):
        sol.path("B")


def test_pins_of_a_drawing_are_found_also_where_no_links_meet():
    pins = {"O": [0.0, 0.0], "A": [0.3, 0.0], "P": [0.5, 0.2]}
    drawing = udk.Drawing(pins, {"arm": udk.Link(["O", "A"], mass=1.0), "plate": udk.Link(["A", "P"], mass=1.0)}, ["O"])
    mech = drawing.mechanism()
    sol = udk.simulate(mech, TS[:3])
    for name, place in pins.items():
        assert_allclose(udk.path(mech, sol, name)[0], place, rtol=0, atol=1e-14)
    tip = channel_of(mech, "pin.P.y")
    assert_allclose(
        jax.jit(lambda m, s: measure(m, s, (tip,)))(mech, sol)[:, 0], udk.path(mech, sol, "P")[:, 1], rtol=0, atol=1e-14
    )
    moved = jax.jit(jax.jacfwd(lambda place: udk.path(mech.with_parameters({"pin.P": place}), sol, "P")[0]))(
        jnp.array([0.5, 0.2])
    )
    assert np.abs(moved).max() > 0.1


def test_a_pin_is_driven_along_a_coordinate(linkage):
    mech, sol = linkage
    values = float(udk.path(mech, sol, "C")[0, 0]) - np.array([0.01, 0.05])
    motion = udk.kinematics(mech, "pin.C.x", values)
    assert_allclose(udk.path(mech, motion, "C")[:, 0], values, rtol=0, atol=1e-12)


def test_at_a_toggle_places_are_known_and_velocities_are_not():
    """A slide pulls two links of 1 m straight: then its pin is 2 m away and their angle is 0, whatever the slide's speed."""
    pins = {"O": (0.0, 0.0), "A": (0.6, 0.8), "B": (1.2, 0.0)}
    links = {
        "crank": udk.Link(["O", "A"], mass=1.0),
        "rod": udk.Link(["A", "B"], mass=1.0),
        "block": udk.Link(["B"], mass=1, width=1),
    }
    slides, motors = {"guide": {"link": "block", "direction": 0.0}}, {"pull": {"slide": "guide", "speed": 1.0}}
    mech = udk.Drawing(pins, links, ground=["O"], slides=slides, motors=motors).mechanism()
    motion = udk.kinematics(mech, "pull", [0.0, float(udk.travel(mech, "pull").upper)])
    assert motion.status[1] == udk.Reached.not_determined
    assert_allclose(udk.path(mech, motion, "B"), [[1.2, 0.0], [2.0, 0.0]], atol=1e-6)
    assert np.isnan(udk.path(mech, motion, "B", derivative=1)[1]).all() and np.isfinite(udk.path(mech, motion, "A")).all()
    names = ["pin.B.x", "joint.A.angle", "distance.crank(-0.5, 0).rod(0.5, 0)", "pin.B.vx", "joint.A.omega"]
    values = measure(mech, motion, [channel_of(mech, name) for name in names])
    assert_allclose(values[1, :3], [2.0, 0.0, 2.0], atol=1e-6)
    assert np.isnan(values[1, 3:]).all() and np.isfinite(values[0]).all()
