"""Gradients of accelerations and trajectories compared with closed forms; and joints given twice."""

import json
from functools import partial
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax import GROUND
from udkjax.equations import prepare
from udkjax.programs.deferred import deferred

DATA = json.loads((Path(__file__).parents[2] / "data" / "seed_fivebar_parallelogram.json").read_text())
EXACT = {name: float(value) for name, value in DATA["sensitivities_rest_minus50"]["2"].items()}

CLASSES = (udk.SVD, udk.Varga, udk.Greville, udk.Householder, udk.GramSchmidt, udk.Elimination, udk.Auto)
METHODS = {m.__name__: m() for m in CLASSES}


def fast(*chosen):
    """Parametrize over all methods; those not chosen are marked as slow, since compiling takes most of the time."""
    return [pytest.param(m, id=name, marks=[] if name in chosen else pytest.mark.slow) for name, m in METHODS.items()]


def duplicated(mechanism, copies, joints=None):
    """The mechanism with `copies` of each of its joints, or of the named ones."""
    more = {f"{name} {k}": mechanism.joints[name] for name in joints or mechanism.joints for k in range(1, copies)}
    return udk.Mechanism(dict(mechanism.bodies), {**mechanism.joints, **more}, gravity=mechanism.gravity)


LINKAGE = udk.library.parallelogram(np.deg2rad(-50.0))


# --- accelerations: p = (angle, mass of a link, length), the links turning at 1.3 rad/s

RATE = 1.3


def state(angle, length, rate=RATE):
    """q and v (12,), and q' and q'' with respect to the angle: accelerations are q' theta'' + q'' rate^2."""

    def q(s):
        e = jnp.stack([jnp.cos(s), jnp.sin(s)])
        links = [jnp.append(jnp.array([x, 0.0]) + length / 2 * e, s) for x in (0.0, 1.0, 2.0)]
        return jnp.concatenate([*links, jnp.array([1.0, 0.0]) + length * e, jnp.zeros(1)])

    position, slope = jax.jvp(q, (angle,), (jnp.ones_like(angle),))
    curvature = jax.jvp(lambda s: jax.jvp(q, (s,), (jnp.ones_like(s),))[1], (angle,), (jnp.ones_like(angle),))[1]
    return position, rate * slope, slope, curvature


def closed_form(p):
    """Closed form of the linkage, 3.05 theta'' = -3.5 g cos(theta), for any mass and length of its links."""
    angle, mass, length = p
    inertia = 3 * (0.1 + mass * length**2 / 4) + 2.0 * length**2
    turn = -9.81 * (1.5 * mass + 2.0) * length * jnp.cos(angle) / inertia
    *_, slope, curvature = state(angle, length)
    return slope * turn + curvature * RATE**2


def accelerations(mechanism, method, p):
    """The same from the equations of motion; the three links share their numbers, so that the loop stays closed."""
    angle, mass, length = p
    half, zero = length / 2, jnp.zeros_like(length)
    numbers = {f"body.link{i}.mass": mass for i in (1, 2, 3)}
    for name in mechanism.joints:
        side = -half if name[0] == "A" else half
        numbers[f"joint.{name}.points[1]"] = jnp.stack([side, zero])
    q, v, *_ = state(angle, length)
    return prepare(mechanism.with_parameters(numbers), method).accelerations(0.0, q, v)


def derivatives(f):
    """Values, the Jacobian in forward and reverse mode, and the Hessian of a weighted sum."""
    total = lambda p: jnp.cos(jnp.arange(12.0)) @ f(p)  # noqa: E731
    return deferred(jax.vmap(lambda p: (f(p), jax.jacfwd(f)(p), jax.jacrev(f)(p), jax.hessian(total)(p))))


ANGLES = np.linspace(-np.pi, np.pi, 401)  # with the singular configurations -pi, 0 and pi
POINTS = jnp.stack([jnp.asarray(ANGLES), jnp.full(401, 1.2), jnp.full(401, 0.9)], axis=1)


@pytest.mark.parametrize("method", fast())  # in the fast tests: SVD at one angle, in tests/equations/test_accelerations.py
def test_derivatives_of_accelerations(method):
    """They are finite at all angles, and equal the closed form with every method wherever the rank is constant nearby."""
    expected = derivatives(closed_form)(POINTS)
    found = derivatives(partial(accelerations, LINKAGE, method))(POINTS)
    ordinary = np.abs(np.sin(ANGLES)) > 1e-2
    assert ordinary.sum() >= 395
    # The Hessian of a pseudoinverse holds its third power, 1 / sigma^3: 2e5 at the angles nearest to a singular one.
    tolerances = {"value": 1e-9, "forward": 1e-9, "reverse": 1e-9, "Hessian": 1e-7}
    for (name, tol), f, e in zip(tolerances.items(), found, expected, strict=True):
        assert np.all(np.isfinite(f)), name
        scale = np.abs(e).max()
        np.testing.assert_allclose(f[ordinary] / scale, e[ordinary] / scale, rtol=0, atol=tol, err_msg=name)


@pytest.mark.slow
def test_derivatives_agree_with_differences():
    """The default where there is no closed form, with sideways gravity and another inertia; and the closed form itself."""

    def f(x):
        numbers = {"gravity": x[:2], "body.coupler.mass": x[2], "body.link2.inertia": x[3]}
        return udk.accelerations(LINKAGE.with_parameters(numbers), 0.0, LINKAGE.q0, LINKAGE.v0).ravel()

    @partial(jax.jit, static_argnums=0)
    def jacobians(f, x):
        differences = jax.vmap(lambda d: (f(x + 1e-5 * d) - f(x - 1e-5 * d)) / 2e-5, out_axes=1)(jnp.eye(len(x)))
        return differences, jax.jacfwd(f)(x), jax.jacrev(f)(x)

    differences, *found = jacobians(f, jnp.array([0.4, -9.81, 2.1, 0.13]))
    for jacobian in found:
        np.testing.assert_allclose(jacobian, differences, rtol=1e-7, atol=1e-8)
    differences, jacobian, _ = jacobians(closed_form, jnp.array([0.7, 1.2, 0.9]))
    np.testing.assert_allclose(jacobian, differences, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("method", fast("Varga"))
def test_projection_has_derivatives(method):
    """A closed state stays. A change along the manifold stays too, and one that opens the loop is taken back."""
    equations = prepare(LINKAGE, method)
    angle, length = jnp.array(-0.8), jnp.array(1.0)
    project = lambda q, v: jnp.concatenate(equations.project(0.0, q, v))  # noqa: E731
    q, v, *_ = state(angle, length)
    along = jax.jvp(lambda a: jnp.concatenate(state(a, length)[:2]), (angle,), (jnp.ones(()),))[1]

    @deferred
    def evaluate(q, v):
        moved = jax.jvp(project, (q, v), tuple(jnp.split(along, 2)))
        return *moved, jax.jacfwd(project)(q, v), jax.jacrev(project)(q, v), equations.jacobian(0.0, q)

    value, tangent, jacobian, reverse, psi_q = evaluate(q, v)
    opening = jnp.zeros(12).at[9].set(1.0)  # the coupler alone, along x
    np.testing.assert_allclose(value, jnp.concatenate([q, v]), atol=1e-12)
    np.testing.assert_allclose(tangent, along, atol=1e-10)
    assert np.abs(psi_q @ opening).max() > 0.5
    np.testing.assert_allclose(psi_q @ (jacobian[:12] @ opening), 0.0, atol=1e-10)
    np.testing.assert_allclose(reverse, jacobian, atol=1e-9)


@pytest.mark.parametrize("method", fast("Auto"))
def test_a_duplicated_joint_changes_no_acceleration_and_no_gradient(method):
    p = jnp.array([[-0.8, 1.2, 0.9], [2.1, 0.7, 1.1]])
    f = lambda mechanism: deferred(  # noqa: E731
        jax.vmap(lambda p: (accelerations(mechanism, method, p), jax.jacfwd(partial(accelerations, mechanism, method))(p)))
    )
    found = f(duplicated(LINKAGE, 3, ["A1", "B2"]))(p)
    expected_ones = deferred(jax.vmap(lambda p: (closed_form(p), jax.jacfwd(closed_form)(p))))(p)
    for got, expected in zip(found, expected_ones, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-10, atol=1e-10)


# --- trajectories: p = (theta0, g, inertia of a link), from rest

P = jnp.array([np.deg2rad(-50.0), 9.81, 0.1])
GRADIENT = [EXACT["dtheta_dtheta0"], EXACT["dtheta_dg"], EXACT["dtheta_dI_link"]]
TS = np.array([0.0, 1.0, 2.0])


def theta(p, mechanism=LINKAGE, method=None, adjoint=None):
    """The angle after 2 s."""
    angle, gravity, inertia = p
    numbers = {"gravity": jnp.stack([0.0, -gravity]), **{f"body.link{i}.inertia": inertia for i in (1, 2, 3)}}
    q, v, *_ = state(angle, jnp.ones(()), 0.0)
    start, choices = udk.State(q.reshape(4, 3), v.reshape(4, 3)), {"adjoint": adjoint, "max_steps": 4096, "throw": False}
    return udk.simulate(mechanism.with_parameters(numbers), TS, start, 1e-11, 1e-11, method, **choices).q[-1, 0, 2]


def forward(**choices):
    f = lambda p: (theta(p, adjoint=diffrax.ForwardMode(), **choices),) * 2  # noqa: E731
    gradient, value = jax.jit(jax.jacfwd(f, has_aux=True))(P)
    return value, gradient


def reverse(**choices):
    return jax.jit(jax.value_and_grad(lambda p: theta(p, **choices)))(P)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [forward, reverse])
@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_gradient_of_a_trajectory(method, mode):
    value, gradient = mode(method=method)
    np.testing.assert_allclose(value, EXACT["theta"], rtol=1e-8)
    np.testing.assert_allclose(gradient, GRADIENT, rtol=1e-7)


@pytest.mark.slow
def test_a_duplicated_joint_changes_no_gradient_of_a_trajectory():
    np.testing.assert_allclose(forward(mechanism=duplicated(LINKAGE, 3, ["A1", "B2"]))[1], GRADIENT, rtol=1e-7)


def test_a_duplicate_that_holds_a_body_on_the_ground_changes_nothing():
    """This includes mechanisms that cannot move."""
    body = {"plate": udk.Body(1.0, 0.1, [0.2, 0.1], 0.3)}
    welds = {f"weld{k}": udk.Weld((GROUND, "plate"), [[0.0, 0.0], [0.0, 0.0]]) for k in range(3)}
    mech = udk.Mechanism(body, welds)
    chosen = [METHODS[name] for name in ("Auto", "Varga", "Greville")]
    by_each = deferred(lambda q, v: [udk.accelerations(mech, 0.0, q, v, method) for method in chosen])
    np.testing.assert_allclose(by_each(mech.q0, mech.v0), 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_spring_between_pins_that_a_joint_holds_together_changes_no_gradient():
    """The distance of its ends is a rounding error, and so the derivative of its force's direction would be arbitrary."""
    pendulum, ts = udk.library.double_pendulum(), np.linspace(0.0, 1.0, 5)
    elbow = pendulum.joints["elbow"]
    assert isinstance(elbow, udk.Revolute)
    spring = {"spring": udk.Spring(elbow.bodies, elbow.points, stiffness=100.0, length=0.1, damping=1.0)}

    def gradients(forces):
        mechanism = udk.Mechanism(pendulum.bodies, pendulum.joints, forces=forces, gravity=pendulum.gravity)
        end = lambda mass: udk.simulate(mechanism.with_parameters({"body.upper.mass": mass}), ts).q[-1, -1, 2]  # noqa: E731
        return jax.grad(end)(1.0), jax.jacfwd(end)(1.0)

    np.testing.assert_allclose(gradients(spring), gradients({}), rtol=1e-6)
