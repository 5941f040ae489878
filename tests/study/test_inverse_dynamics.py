"""What drivers must exert, against closed forms, power and forward dynamics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast

SCENES = {"driven pendulum": udk.library.driven_pendulum, "slider crank": lambda: udk.library.slider_crank(0.3, 4.0)}


@pytest.mark.slow
def test_the_torque_of_a_slider_crank_is_that_of_its_closed_form():
    """By energy: crank, rod and slider have V(s) and T = J(s) s_dot^2 / 2, so the torque is J'(s) s_dot^2 / 2 + V'(s)."""
    r, rod, (m1, m2, m3), g, omega = 0.5, 1.5, (1.0, 1.5, 2.0), 9.81, 4.0
    mech = udk.library.slider_crank(0.3, omega)
    ts = np.linspace(0.0, 1.5, 16)
    found = udk.inverse_dynamics(mech, ts)

    def pose(s):
        tilt = -jnp.arcsin(r * jnp.sin(s) / rod)
        pin = r * jnp.stack([jnp.cos(s), jnp.sin(s)])
        middle = pin + 0.5 * rod * jnp.stack([jnp.cos(tilt), jnp.sin(tilt)])
        return jnp.concatenate([0.5 * pin, middle, jnp.stack([pin[0] + rod * jnp.cos(tilt), s, tilt])])

    masses = jnp.array([m1, m1, m2, m2, m3, m1 * r**2 / 12, m2 * rod**2 / 12])
    inertia = lambda s: masses @ jax.jvp(pose, (s,), (1.0,))[1] ** 2  # noqa: E731
    potential = lambda s: g * (m1 * pose(s)[1] + m2 * pose(s)[3])  # noqa: E731
    effort = lambda s: 0.5 * jax.grad(inertia)(s) * omega**2 + jax.grad(potential)(s)  # noqa: E731
    exact = jax.jit(jax.vmap(effort))(0.3 + omega * ts)
    np.testing.assert_allclose(found.efforts["motor"], exact, atol=1e-11)
    np.testing.assert_allclose(found.power, omega * exact, atol=1e-10)
    assert float(jnp.max(found.residual)) < 1e-12


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


def test_redundant_joints_and_redundant_drivers():
    """Three links of a parallelogram driven alike: by symmetry of the weights, equal shares; by weights, shares as 1/w."""
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


@pytest.mark.parametrize("name", fast(["driven pendulum"], SCENES))
@pytest.mark.slow
def test_efforts_are_what_the_drivers_reactions_say(name):
    """For as many drivers as degrees of freedom: -lambda of the driver's row, found by forward dynamics."""
    mech = SCENES[name]()
    ts = np.linspace(0.0, 0.4, 3)
    found = udk.inverse_dynamics(mech, ts)
    moved = found.motion
    assert moved is not None
    forces = jax.jit(jax.vmap(lambda t, q, v: udk.accelerations(mech, t, q, v, multipliers=True)[1]))(ts, moved.q, moved.v)
    np.testing.assert_allclose(found.efforts["motor"], -forces[:, -1], rtol=0, atol=1e-10)


def test_derivatives_of_a_torque_are_those_of_its_closed_form():
    """(I + m r^2) theta'' + m g r cos(theta) of a driven pendulum on its motion, by the mass and by gravity."""
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


@pytest.mark.slow
def test_derivatives_of_a_torque():
    mech = udk.library.slider_crank(0.3, 4.0)

    def torque(x):
        changed = mech.with_parameters({"body.slider.mass": x[0], "joint.P.points[0][0]": x[1]})
        return udk.inverse_dynamics(changed, jnp.array([0.2])).efforts["motor"][0]

    x, h = jnp.array([2.0, 0.25]), 1e-5
    both = jax.jit(jax.jacfwd(lambda x: (torque(x),) * 2, has_aux=True))
    differences = [(both(x + h * d)[1] - both(x - h * d)[1]) / (2 * h) for d in np.eye(2)]
    np.testing.assert_allclose(both(x)[0], differences, rtol=1e-7)


def test_nothing_drives():
    with pytest.raises(udk.SceneError, match="nothing drives"):
        udk.inverse_dynamics(udk.library.four_bar(), [0.0], udk.kinematics(udk.library.four_bar(), "body.crank.angle", [1.0]))
