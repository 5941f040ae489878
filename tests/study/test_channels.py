"""Channels by name, and their values along a motion."""

import pickle
import re
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.positions.assembling.channel_values import measure
from udkjax.positions.assembling.channels import Quantity, channel_of, channels_of
from udkjax.programs.deferred import deferred

OMEGA, STEP = 4.0, 1e-3
TIMES = 0.3 + STEP * np.arange(-6, 7)
POINTS = ["body.rod(0.3, -0.2)." + q for q in ("x", "y", "vx", "vy", "ax", "ay")]
LOADS = ["joint.O.ground.fx", "joint.O.ground.fy", "joint.O.ground.torque", "joint.guide.ground.fy", "joint.guide.ground.torque"]
DISTANCES = ["distance.ground(0, 0.5).slider(0, 0)", "distance.crank(0.25, 0).slider(0, 0)"]


class Motion(NamedTuple):
    """The states of a motion, with the fields of a solution."""

    ts: Any
    q: Any
    v: Any


class Measured(NamedTuple):
    """A driven slider-crank, its exact motion, and its channels' values, (T,) by name."""

    mechanism: udk.Mechanism
    motion: Motion
    channels: tuple
    values: dict[str, np.ndarray]
    program: Any


@pytest.fixture(scope="module")
def crank():
    mech = udk.library.slider_crank(angular_velocity=OMEGA)

    def state(t):
        there = udk.library.slider_crank(OMEGA * t, OMEGA)
        return there.q0, there.v0

    motion = Motion(jnp.asarray(TIMES), *deferred(jax.vmap(state))(TIMES))
    spin = Quantity("spin", lambda mech, solution: mech.bodies["rod"].inertia * solution.v[:, 1, 2], "N m s")
    channels = (*(channel_of(mech, text) for text in [*channels_of(mech), *POINTS, *LOADS, *DISTANCES]), spin)
    program = deferred(lambda mech, motion: measure(mech, motion, channels))
    values = np.asarray(program(mech, motion)).T
    return Measured(mech, motion, channels, dict(zip([c.name for c in channels], values, strict=True)), program)


def slope(x: np.ndarray) -> np.ndarray:
    """The rate of a channel by central differences of fourth order."""
    return (8 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12 * STEP)


# --- names


def test_names_are_given_back_as_they_are_usually_written(crank):
    mech = crank.mechanism
    assert channel_of(mech, " body.rod( .30,-2e-1).vx ").name == "body.rod(0.3, -0.2).vx"
    assert channel_of(mech, "body.rod(0, 0).x").name == "body.rod(0.0, 0.0).x"
    assert channel_of(mech, "distance.ground(0,0).slider(0,1)").name == "distance.ground(0.0, 0.0).slider(0.0, 1.0)"
    one, other = (channel_of(mech, f"body.rod({x}, 0).ax") for x in ("0.1", "1e-1"))
    assert one == other and hash(one) == hash(other) and pickle.loads(pickle.dumps(one)) == one


@pytest.mark.parametrize(
    ("text", "units", "needs"),
    [
        ("body.rod.vy", "m/s", "states"),
        ("joint.P.omega", "rad/s", "states"),
        ("joint.P.alpha", "rad/s2", "accelerations"),
        ("body.rod(1, 0).ay", "m/s2", "accelerations"),
        ("joint.P.crank.torque", "N m", "reactions"),
        ("driver.motor.load", "N m", "reactions"),
    ],
)
def test_a_channel_has_units_and_knows_what_it_needs(crank, text, units, needs):
    channel = channel_of(crank.mechanism, text)
    assert (channel.units, channel.needs) == (units, needs)


def test_names_may_hold_what_separates_them():
    bodies = {name: udk.Body(1.0, 1.0) for name in ("arm", "arm.x", "left arm (old)")}
    mech = udk.Mechanism(
        bodies,
        {"a": udk.Revolute(("arm", "arm.x"), np.zeros((2, 2))), "a.b": udk.Revolute(("arm", "left arm (old)"), np.zeros((2, 2)))},
        {"push": udk.Driver(("ground", "arm"), "x", udk.Polynomial([0.0]))},
    )
    found = [channel_of(mech, f"body.{name}.x") for name in bodies]
    assert [c.bodies for c in found] == [(name,) for name in bodies]
    assert channel_of(mech, "body.left arm (old)(1, 2).x").points == ((1.0, 2.0),)
    assert channel_of(mech, "joint.a.arm.x.fx").bodies == ("arm.x",) and channel_of(mech, "joint.a.b.angle").owner == "a.b"
    assert channel_of(mech, "distance.arm.x(0, 0).left arm (old)(1, 1)").bodies == ("arm.x", "left arm (old)")
    assert channel_of(mech, "driver.push.load").units == "N"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("rod.x", 'begins with none of body., joint., pin., driver., distance.; did you mean "body.rod.x"?'),
        ("body.rot.x", 'no body named "rot"; did you mean "rod"?'),
        ("body.ground.x", '"ground" does not move; name a body'),
        ("body.rod.vz", 'body "rod" has no "vz"; it has x, y, vx, vy, ax, ay, angle, omega, alpha'),
        ("body.rod.omeg", 'body "rod" has no "omeg"; did you mean "omega"?'),
        ("body.rod", 'body "rod": name one of x, y,'),
        ("body.rod(0.1).x", 'a point is (px, py), two numbers (m) in the body\'s own frame, not "(0.1)"'),
        ("body.rod(0.1, nan).x", "two numbers"),
        ("body.rod(0.1, 0.2).omega", 'body "rod(0.1, 0.2)" has no "omega"'),
        ("joint.Q.angle", 'no joint named "Q"'),
        ("joint.P.slider.fx", 'joint "P" has no "slider.fx"'),
        ("joint.P.rod.fz", 'joint "P" on body "rod" has no "fz"; it has fx, fy, torque'),
        ("driver.moto.load", 'no driver named "moto"; did you mean "motor"?'),
        ("distance.rod.slider(0, 0)", "each body needs a point"),
        ("distance.rod(0, 0).slider(0, 0).x", 'after the second point comes ".x"'),
    ],
)
def test_a_name_that_is_none_says_why(crank, text, problem):
    with pytest.raises(ValueError, match=re.escape(problem)):
        channel_of(crank.mechanism, text)


# --- values


@pytest.mark.parametrize(
    ("of", "rates"),
    [
        *[(f"body.{name}.", {"x": "vx", "y": "vy", "angle": "omega"}) for name in ("crank", "rod", "slider")],
        *[(f"body.{name}.", {"vx": "ax", "vy": "ay", "omega": "alpha"}) for name in ("crank", "rod", "slider")],
        ("body.rod(0.3, -0.2).", {"x": "vx", "y": "vy", "vx": "ax", "vy": "ay"}),
        *[(f"joint.{name}.", {"angle": "omega", "omega": "alpha"}) for name in ("O", "P", "B", "guide")],
    ],
)
def test_rates_and_accelerations_are_what_differences_give(crank, of, rates):
    for x, rate in rates.items():
        assert_allclose(crank.values[of + rate][2:-2], slope(crank.values[of + x]), rtol=0, atol=1e-8)


def test_coordinates_angles_and_distances_are_those_of_the_states(crank):
    q = np.asarray(crank.motion.q)
    assert_allclose(crank.values["body.slider.x"], q[:, 2, 0], rtol=0, atol=0)
    assert_allclose(crank.values["joint.P.angle"], q[:, 1, 2] - q[:, 0, 2], rtol=0, atol=0)
    assert_allclose(crank.values["joint.O.angle"], OMEGA * TIMES, rtol=0, atol=1e-12)
    tip = np.stack([np.cos(q[:, 1, 2]) * 0.3 + np.sin(q[:, 1, 2]) * 0.2, np.sin(q[:, 1, 2]) * 0.3 - np.cos(q[:, 1, 2]) * 0.2], -1)
    point = np.stack([crank.values["body.rod(0.3, -0.2).x"], crank.values["body.rod(0.3, -0.2).y"]], -1)
    assert_allclose(point, q[:, 1, :2] + tip, rtol=0, atol=1e-14)
    assert_allclose(
        crank.values["distance.ground(0.0, 0.5).slider(0.0, 0.0)"], np.hypot(q[:, 2, 0], q[:, 2, 1] - 0.5), rtol=1e-14
    )
    assert_allclose(crank.values["distance.crank(0.25, 0.0).slider(0.0, 0.0)"], 1.5, rtol=1e-14)
    spin = float(crank.mechanism.bodies["rod"].inertia) * np.asarray(crank.motion.v)[:, 1, 2]
    assert_allclose(crank.values["spin"], spin, rtol=1e-15)


def test_loads_are_those_of_reactions_and_of_newtons_laws(crank):
    mech, loads = crank.mechanism, udk.reactions(crank.mechanism, crank.motion)
    for name in ("O", "P", "B", "guide"):
        of_second = loads[name][mech.joints[name].bodies[1]]
        found = np.stack([crank.values[f"joint.{name}.{q}"] for q in ("fx", "fy", "torque")], -1)
        assert_allclose(found, of_second, rtol=0, atol=1e-10)
    # The ground carries what gravity and the motion ask for, and the pin on the origin has no moment about it.
    mass = np.array([1.0, 1.5, 2.0])
    a = np.stack([[crank.values[f"body.{b}.{q}"] for q in ("ax", "ay")] for b in mech.body_names])  # (bodies, 2, T)
    on_ground = crank.values["joint.O.ground.fx"], crank.values["joint.O.ground.fy"] + crank.values["joint.guide.ground.fy"]
    for k, (force, g) in enumerate(zip(on_ground, (0.0, -9.81), strict=True)):
        assert_allclose(-force, mass @ a[:, k] - mass.sum() * g, rtol=0, atol=1e-10)
    assert_allclose(crank.values["joint.O.ground.torque"], 0.0, rtol=0, atol=1e-10)
    about_origin = crank.values["joint.guide.torque"] + crank.values["body.slider.x"] * crank.values["joint.guide.fy"]
    assert_allclose(crank.values["joint.guide.ground.torque"], -about_origin, rtol=0, atol=1e-10)


def test_a_drivers_load_is_the_power_that_it_brings_in(crank):
    power = crank.values["driver.motor.load"] * OMEGA
    total = np.asarray(udk.energy(crank.mechanism, crank.motion).total)
    assert_allclose(power[2:-2], slope(total), rtol=0, atol=1e-8)


def test_states_that_are_not_numbers_stay_so_and_harm_no_other(crank):
    lost = np.zeros(len(TIMES), bool)
    lost[[0, -1]] = True
    motion = Motion(crank.motion.ts, *(jnp.where(lost[:, None, None], jnp.nan, x) for x in crank.motion[1:]))
    values = np.asarray(crank.program(crank.mechanism, motion)).T
    assert np.isnan(values[:, lost]).all()
    assert_allclose(values[:, ~lost], np.array(list(crank.values.values()))[:, ~lost], rtol=0, atol=0)


def test_what_only_looks_at_states_solves_nothing(crank):
    for text, solves in (("joint.P.omega", False), ("joint.P.alpha", True)):
        channels = (channel_of(crank.mechanism, text),)
        traced = jax.make_jaxpr(lambda motion, channels=channels: measure(crank.mechanism, motion, channels))(crank.motion)
        assert ("svd" in str(traced)) == solves


@pytest.fixture(scope="module")
def linkage():
    """Channels of the redundant linkage, their values (C,), and derivatives along changes of five numbers that define it."""
    mech = udk.library.parallelogram()
    channels = tuple(channel_of(mech, text) for text in channels_of(mech))
    spare = jnp.full((4, 3), jnp.nan)

    def values(x):
        there = udk.library.parallelogram(x[0], x[1], x[2], x[3], gravity=x[4])
        motion = Motion(jnp.zeros(2), jnp.stack([there.q0, spare]), jnp.stack([there.v0, spare]))
        return measure(there, motion, channels)

    def both(x, e):
        y, forward = jax.jvp(values, (x,), (e,))
        return y[0], *forward

    return mech, channels, deferred(both)


@pytest.mark.slow
def test_derivatives_hold_where_constraints_are_redundant(linkage):
    mech, channels, both = linkage
    x, h = np.array([-0.7, 1.3, 0.9, 1.4, 9.81]), 1e-5
    along = [both(x, e) for e in np.eye(5)]
    y, slopes, of_lost = along[0][0], *(np.stack([each[k] for each in along], -1) for k in (1, 2))
    differences = np.stack([(both(x + h * e, e)[0] - both(x - h * e, e)[0]) / (2 * h) for e in np.eye(5)], -1)
    assert_allclose(slopes, differences, rtol=1e-7, atol=1e-6)
    assert np.all(of_lost == 0)
    there = udk.library.parallelogram(*x[:4], gravity=x[4])
    loads = udk.reactions(there, Motion(jnp.zeros(1), there.q0[None], there.v0[None]))
    names = [c.name for c in channels]
    for name in mech.joint_names:
        found = [y[names.index(f"joint.{name}.{q}")] for q in ("fx", "fy", "torque")]
        assert_allclose(found, loads[name][mech.joints[name].bodies[1]][0], rtol=0, atol=1e-10)
    assert np.abs(slopes[names.index("joint.B1.fy"), 3:]).min() > 1e-2  # mass and gravity are felt at all
