"""Efforts of drivers compared with closed forms, power and forward dynamics."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast
from tests.elements import DRIVERS
from udkjax.positions.assembling.coordinates import Coordinate

SCENES = {"driven pendulum": udk.library.driven_pendulum, "slider crank": lambda: udk.library.slider_crank(0.3, 4.0)}


@pytest.mark.parametrize("name", fast(["driven pendulum"], SCENES))
def test_what_is_fed_forward_reproduces_the_motion(name):
    mech = SCENES[name]()
    h = 1 / 400
    knots = h * np.arange(-16, 217)
    free = udk.feed_forward(mech, udk.inverse_dynamics(mech, knots))
    assert not free.drivers
    ts = np.linspace(0.0, 0.5, 6)
    exact = udk.kinematics(mech, None, ts)
    sol = udk.simulate(free, ts, state=udk.State(exact.q[0], exact.v[0]), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(sol.q, exact.q, atol=1e-8)
    np.testing.assert_allclose(sol.v, exact.v, atol=1e-7)


@pytest.mark.parametrize("name", DRIVERS)
def test_the_coordinate_of_a_driver_is_what_its_row_holds(name):
    driver, frames = DRIVERS[name].complete(), (udk.Frame.at([0.3, -0.2], 0.4), udk.Frame.at([1.1, 0.7], -0.9))
    row = driver.residual(0.6, *frames)[0] + driver.motion(0.6)
    np.testing.assert_allclose(Coordinate.of(driver).value(*frames), row, rtol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 0.5, np.pi / 2, -2.0])
def test_a_slide_is_pushed_along_its_own_line(angle):
    """A slide of mass m on an incline: m (a + g sin(angle)) along it, and m g cos(angle) across. The motion starts at zero."""
    along, ts, half = np.array([np.cos(angle), np.sin(angle)]), np.array([0.0, 0.5]), 1.5
    ramp = udk.Drawing(
        pins={"P": (0.3, 0.1)},
        links={"block": udk.Link(["P"], mass=2.0, width=0.1)},
        slides={"guide": {"link": "block", "direction": along}},
        motors={"push": {"slide": "guide", "motion": udk.Polynomial([0.0, 0.2, half])}},
    ).mechanism()
    motion = udk.kinematics(ramp, None, ts)
    found = udk.inverse_dynamics(ramp, ts, motion)
    force = 2.0 * (2 * half + 9.81 * np.sin(angle))
    np.testing.assert_allclose(found.efforts["push"], force, rtol=1e-12)
    np.testing.assert_allclose(found.powers["push"], force * (0.2 + 2 * half * ts), rtol=1e-12)
    driven = udk.kinematics(ramp, "push", [0.0, 0.4])
    np.testing.assert_allclose(driven.q[:, 0, :2], np.array([0.3, 0.1]) + np.outer([0.0, 0.4], along), atol=1e-14)
    loads = udk.reactions(ramp, motion, frame="joint")
    np.testing.assert_allclose(loads["push"]["block"][:, :2], [[force, 0.0]] * 2, atol=1e-12)
    np.testing.assert_allclose(loads["guide"]["block"][:, :2], [[0.0, 2.0 * 9.81 * np.cos(angle)]] * 2, atol=1e-12)
    sol = udk.simulate(
        udk.feed_forward(ramp, udk.inverse_dynamics(ramp, np.linspace(0.0, 0.5, 3))),
        ts,
        udk.State(motion.q[0], motion.v[0]),
    )
    np.testing.assert_allclose(sol.q, motion.q, atol=1e-8)


def test_work_and_swing_of_a_weight_that_a_motor_turns():
    """The torque m g r cos(w t) does no work in a turn, and its energy swings by 2 m g r; with a brake the work is 2 pi c w."""
    rod = udk.Body(2.0, 0.1, position=[0.5, 0.0])
    pin = udk.Revolute(["ground", "rod"], [[0.0, 0.0], [-0.5, 0.0]])
    motor = udk.Driver(["ground", "rod"], "angle", udk.Polynomial([0.0, 3.0]))
    brake = udk.TorsionSpring(["ground", "rod"], stiffness=0.0, damping=0.7)
    turn, h = np.linspace(0.0, 2 * np.pi / 3.0, 401), 2 * np.pi / 400
    for forces, work in (({}, 0.0), ({"brake": brake}, 0.7 * 3.0 * 2 * np.pi)):
        found = udk.inverse_dynamics(udk.Mechanism({"rod": rod}, {"pin": pin}, {"motor": motor}, forces), turn)
        np.testing.assert_allclose(found.works["motor"], work, atol=1e-12)
        np.testing.assert_allclose(found.swings["motor"], 2 * 2.0 * 9.81 * 0.5, rtol=h**2 / 10)
        assert "N m at" in str(found) and "energy swing" in str(found)


def test_redundant_joints_and_redundant_drivers():
    """Three links of a parallelogram driven alike have equal shares by symmetry; with weights w, shares as 1/w."""
    mech = udk.library.parallelogram(-0.8)
    motion = udk.kinematics(mech, "body.link1.angle", [-0.8, -0.5, 0.6], rate=2.0, acceleration=1.0)
    links = [f"body.link{k}.angle" for k in (1, 2, 3)]
    one = udk.inverse_dynamics(mech, np.zeros(3), motion, links[:1])
    # T = (3 (I + m/4) + M) s_dot^2 / 2 and V = (3 m / 2 + M) g sin s, of unit length, 3 m = 3 kg, M = 2 kg
    s = np.array([-0.8, -0.5, 0.6])
    exact = (3 * (0.1 + 0.25) + 2.0) * 1.0 + 3.5 * 9.81 * np.cos(s)
    np.testing.assert_allclose(one.efforts[links[0]], exact, rtol=1e-11)
    three = udk.inverse_dynamics(mech, np.zeros(3), motion, links, weights={links[2]: 0.5})
    shares = np.stack([three.efforts[name] for name in links], 1)
    np.testing.assert_allclose(shares, exact[:, None] * np.array([0.25, 0.25, 0.5]), rtol=1e-11)
    assert float(jnp.max(three.residual)) < 1e-11


def test_derivatives_of_a_torque_are_those_of_its_closed_form():
    """The torque (I + m r^2) theta'' + m g r cos(theta) of a driven pendulum, differentiated by the mass and by gravity."""
    mech, ts = udk.library.driven_pendulum(), np.array([0.2])
    motion = udk.inverse_dynamics(mech, ts).motion

    def torque(x):
        changed = mech.with_parameters({"body.rod.mass": x[0], "gravity": jnp.stack([0.0, -x[1]])})
        return udk.inverse_dynamics(changed, ts, motion).efforts["motor"][0]

    def exact(x):
        theta, curvature, r = 0.8 * jnp.sin(0.6), -0.8 * 9.0 * jnp.sin(0.6), 0.5
        return (1.0 / 12.0 + x[0] * r**2) * curvature + x[0] * x[1] * r * jnp.cos(theta)

    x = jnp.array([1.0, 9.81])
    found, expected = (jax.jit(jax.value_and_grad(f))(x) for f in (torque, exact))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10)


def test_nothing_drives():
    with pytest.raises(udk.SceneError, match="the scene has none"):
        udk.inverse_dynamics(udk.library.four_bar(), [0.0], udk.kinematics(udk.library.four_bar(), "body.crank.angle", [1.0]))


@pytest.mark.parametrize("law", fast(["set-valued"], ["smooth", "set-valued"]))
def test_friction_of_both_laws_is_driven(law):
    """A pendulum on a thick pin: I alpha + m g l cos + mu r |R| sign(omega); Coulomb's law has sign(alpha) at the start."""
    m, length, inertia, radius, mu = 2.0, 0.5, 0.03, 0.1, 0.4
    smoothing = {"speed": 1e-9} if law == "smooth" else {}
    mech = udk.Mechanism(
        {"bob": udk.Body(m, inertia, [length, 0.0])},
        {"A": udk.Revolute(["ground", "bob"], [[0.0, 0.0], [-length, 0.0]])},
        {"motor": udk.Driver(["ground", "bob"], "angle", udk.Polynomial([0.0, 0.0, 1.5, -1.0]))},
        {"rub": udk.Friction("A", coefficient=mu, radius=radius, law=law, **smoothing)},
    )
    ts = np.array([0.0, 0.3, 0.8, 1.2])
    angle, omega, alpha = 1.5 * ts**2 - ts**3, 3 * ts - 3 * ts**2, 3 - 6 * ts
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    force = m * (length * alpha * across - length * omega**2 * along + np.array([[0.0], [9.81]]))
    sign = np.array([float(law == "set-valued"), 1.0, 1.0, -1.0])
    exact = (inertia + m * length**2) * alpha + m * 9.81 * length * np.cos(angle) + sign * mu * radius * np.hypot(*force)
    np.testing.assert_allclose(udk.inverse_dynamics(mech, ts).efforts["motor"], exact, rtol=1e-10)
    if law == "smooth":
        return
    solution = udk.simulate(mech, ts, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(udk.efforts(mech, solution)["motor"], exact, rtol=1e-8)


def test_a_motion_without_accelerations_is_refused():
    mech, ts = udk.library.driven_pendulum(), np.linspace(0.0, 0.1, 3)
    run = udk.simulate(mech, ts)
    with pytest.raises(TypeError, match=r"motion must have accelerations a .* a Solution has none: .*udkjax.accelerations"):
        udk.inverse_dynamics(mech, ts, run)  # pyright: ignore[reportArgumentType]
    motion = udk.kinematics(mech, None, ts)
    with pytest.raises(ValueError, match=r"motion.a must have the shape of motion.q, \(3, 1, 3\), not \(1, 3\)"):
        udk.inverse_dynamics(mech, ts, eqx.tree_at(lambda m: m.a, motion, motion.a[0]))


def test_what_is_fed_forward_is_traced_as_other_functions_are():
    """A heavier pendulum needs more torque: its motion, eagerly, in jit and in lanes."""
    mech, ts = udk.library.driven_pendulum(), np.linspace(0.0, 0.2, 5)
    (mass,) = (name for name in mech.parameters() if name.endswith(".mass"))

    def torque(factor):
        heavy = mech.with_parameters({mass: factor * mech.parameters()[mass]})
        (effort,) = udk.feed_forward(heavy, udk.inverse_dynamics(heavy, ts)).forces.values()
        return effort.law(0.1)

    one, two = torque(1.0), torque(2.0)
    np.testing.assert_allclose(jax.jit(jax.vmap(torque))(np.array([1.0, 2.0])), [one, two], rtol=1e-12)
    assert abs(two - one) > 0.1 * abs(one)
