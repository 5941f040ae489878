import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline

import udkjax.scene as udk
from tests.elements import BODIES, DRIVERS, FORCES, JOINTS, ROWS, P
from udkjax.scene.elements import splines
from udkjax.scene.tables.schema import CLASSES_BY_TYPE


def evaluate(mechanism, name, at, q):
    known = at(mechanism, q)
    joint = mechanism.constraints[name]
    return jnp.stack([jnp.asarray(r) for r in joint.residual(0.0, *(known[n] for n in mechanism.frames_of(joint)))])


def test_each_type_of_the_format_is_tested():
    tested = {"joint": JOINTS, "force": FORCES, "motion": {name: driver.motion for name, driver in DRIVERS.items()}}
    for section, types in CLASSES_BY_TYPE.items():
        assert {type(element) for element in tested[section].values()} == set(types.values())


@pytest.mark.parametrize("name", JOINTS)
def test_rows_as_in_the_format(everything, at, name):
    assert evaluate(everything, name, at, everything.q0).shape == (ROWS.get(name, 1),)


@pytest.mark.parametrize("name", ["prismatic", "slot", "distance", "angle", "inner gear", "cam", "lift", "stretch"])
def test_moving_everything_rigidly_changes_no_joint(everything, at, name):
    q = everything.q0 + jnp.array([[0.1, 0.2, 0.3], [-0.2, 0.1, 0.1], [0.3, 0.1, -0.2]])
    c, s = np.cos(0.7), np.sin(0.7)
    turned = jnp.concatenate([q[:, :2] @ jnp.array([[c, s], [-s, c]]) + jnp.array([3.0, -2.0]), q[:, 2:] + 0.7], axis=1)
    assert_allclose(evaluate(everything, name, at, turned), evaluate(everything, name, at, q), atol=1e-13)


@pytest.mark.parametrize("name", ["prismatic", "weld", "distance", "angle", "gear", "inner gear", "rack"])
def test_what_the_initial_guess_decides_holds_there(everything, at, name):
    rows = evaluate(everything, name, at, everything.q0)
    held = rows[-1] if name in ("prismatic", "weld") else rows
    assert_allclose(held, 0.0, atol=1e-15)


def test_revolute_is_point_2_minus_point_1(everything, at):
    x, y, angle = everything.q0[0]
    (px, py), (rx, ry) = P
    tip = [x + rx * np.cos(angle) - ry * np.sin(angle) - px, y + rx * np.sin(angle) + ry * np.cos(angle) - py]
    assert_allclose(evaluate(everything, "revolute", at, everything.q0), tip, rtol=1e-14)


def test_slot_measures_to_the_left_of_the_line():
    slot = udk.Slot(["ground", "b"], [[1.0, 0.0], [0.0, 0.0]], axis=np.pi / 4)
    ground = udk.Frame(0.0, 0.0, 0.0, 1.0, 0.0)
    assert_allclose(slot.residual(0.0, ground, udk.Frame(0.0, 1.0, 0.3, np.cos(0.3), np.sin(0.3)))[0], np.sqrt(2), rtol=1e-15)


def test_gradient_of_distance_is_the_unit_vector(everything, at):
    rod = udk.Mechanism(BODIES, {"distance": udk.Distance(["a", "b"], np.zeros((2, 2)))})
    gradient = jax.jacfwd(lambda q: evaluate(rod, "distance", at, q)[0])(everything.q0)
    d = everything.q0[0, :2] - everything.q0[1, :2]  # bodies = [a, b], and b comes first
    assert_allclose(gradient[0, :2], d / jnp.linalg.norm(d), rtol=1e-14)
    assert_allclose(gradient[1, :2], -d / jnp.linalg.norm(d), rtol=1e-14)


@pytest.mark.parametrize("internal", [False, True])
def test_wheels_in_mesh_have_one_velocity_at_the_pitch_point(internal):
    gear = udk.Gear(["one", "two"], [0.3, 0.1], internal=internal)

    def frame(angle):
        return udk.Frame(0.0, 0.0, angle, jnp.cos(angle), jnp.sin(angle))

    gradient = jax.jacfwd(lambda angles: gear._rolling_distance(frame(angles[0]), frame(angles[1])))(jnp.zeros(2))
    omega = jnp.array([1.0, -gradient[0] / gradient[1]])  # what the row allows
    # Wheel 1 at the origin, wheel 2 on the x axis: the pitch point is at x = 0.3, centre 2 at 0.3 + 0.1, or at 0.3 - 0.1.
    arm = 0.1 if internal else -0.1
    assert_allclose(omega[0] * 0.3, omega[1] * arm, rtol=1e-14)


def test_a_pinion_rolls_without_slipping(at):
    axis, r = 0.4, 0.2
    centre = r * np.array([-np.sin(axis), np.cos(axis)])  # on the left of the rack
    mech = udk.Mechanism({"pinion": udk.Body(1.0, 1.0, centre)}, {"rack": udk.Rack(["ground", "pinion"], radius=r, axis=axis)})
    gradient = jax.jacfwd(lambda q: evaluate(mech, "rack", at, q)[0])(mech.q0)[0]
    along = np.array([np.cos(axis), np.sin(axis)])
    omega = -(gradient[:2] @ along) / gradient[2]  # for the centre moving along the rack at 1 m/s
    contact = along + omega * np.array([centre[1], -centre[0]])  # v + omega x (-centre)
    assert_allclose(contact, 0.0, atol=1e-15)


def test_profile_is_the_periodic_cubic_spline():
    angles, radii = np.array([-1.0, 0.3, 1.0, 2.5, 4.0]), np.array([1.0, 1.3, 1.1, 0.9, 1.2])
    exact = CubicSpline([*angles, angles[0] + 2 * np.pi], [*radii, radii[0]], bc_type="periodic")
    profile = udk.Profile(angles, radii)
    x = jnp.linspace(-7.0, 9.0, 101)
    for order in range(3):
        assert_allclose(jax.jit(jax.vmap(_derivative(profile, order)))(x), exact(x, order), atol=1e-12)


@pytest.mark.slow
def test_natural_spline_goes_on_straight():
    knots, values = np.array([0.0, 0.5, 2.0, 3.0]), np.array([0.0, 1.0, -1.0, 0.5])
    exact = CubicSpline(knots, values, bc_type="natural")

    def spline(x):
        return splines.natural_spline(x, jnp.asarray(knots), jnp.asarray(values))

    x = jnp.linspace(0.0, 3.0, 61)
    for order in range(3):
        assert_allclose(jax.jit(jax.vmap(_derivative(spline, order)))(x), exact(x, order), atol=1e-12)
    assert_allclose(spline(5.0), values[-1] + 2.0 * exact(3.0, 1), rtol=1e-13)
    assert_allclose(spline(-1.0), values[0] - 1.0 * exact(0.0, 1), rtol=1e-13)
    line = splines.natural_spline(0.25, jnp.array([0.0, 1.0]), jnp.array([1.0, 3.0]))
    assert_allclose(line, 1.5, rtol=1e-15)


@pytest.mark.slow
def test_cam_depends_smoothly_on_its_profile(everything, at):
    def row(radius):
        return evaluate(everything.with_parameters({"joint.cam.profile.radius": radius}), "cam", at, everything.q0)[0]

    radius = everything.joints["cam"].profile.radius
    step, slope = 1e-6 * np.eye(4), jax.jit(lambda r: (row(r), jax.grad(row)(r), jax.hessian(row)(r)))
    _, gradient, hessian = slope(radius)
    assert_allclose(gradient, [(slope(radius + h)[0] - slope(radius - h)[0]) / 2e-6 for h in step], atol=1e-9)
    assert_allclose(gradient.sum(), -1.0, rtol=1e-13)  # a larger cam is larger everywhere
    assert np.isfinite(hessian).all()


def _derivative(function, order):
    for _ in range(order):
        function = jax.grad(function)
    return function
