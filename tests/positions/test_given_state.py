"""States of which some coordinates and velocities are given by name."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk

CRANK = {"body.crank.angle": 1.2, "body.crank.omega": 3.0}


def on_sphere(radius=1.0):
    """A point mass on a sphere, whose height does not change."""
    return udk.ConstrainedSystem(
        mass=lambda q: jnp.eye(3),
        constraint=lambda t, q: {"sphere": q @ q - radius**2},
        velocity_constraint=lambda t, q, v: v[2] - 0.1 * t,
        q0=[1.0, 0.1, 0.2],
        v0=[0.0, 1.0, 0.0],
    )


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e3])
def test_the_rest_of_a_mechanism_follows_as_from_a_motor(unit):
    lengths = {"crank": 1.0 * unit, "coupler": 3.0 * unit, "rocker": 2.0 * unit, "ground": 3.0 * unit}
    pins = {"O": (0, 0), "C": (lengths["ground"], 0), "A": udk.polar("O", lengths["crank"], 1.0)}
    pins["B"] = udk.circles(("A", "C"), (lengths["coupler"], lengths["rocker"]), "left")
    links = {"crank": udk.Link(["O", "A"], mass=1.0), "coupler": udk.Link(["A", "B"], mass=1.0)}
    links["rocker"] = udk.Link(["C", "B"], mass=1.0)
    motor = udk.Drawing(pins, links, ["O", "C"], motors={"motor": {"pin": "O", "speed": 3.0}}).mechanism()
    free = udk.Drawing(pins, links, ["O", "C"]).mechanism()
    wanted = udk.assemble(motor, 0.1)
    values = {"body.crank.angle": wanted.q[0, 2], "joint.O.omega": 3.0}
    for given in (values, {**values, "body.coupler(0, 0).vy": wanted.v[1, 1]}):  # the last follows from the others
        found = udk.assemble(free, given=given)
        assert_allclose(found.q, wanted.q, atol=1e-9 * unit)
        assert_allclose(found.v, wanted.v, atol=1e-9 * unit)
    assert_allclose(udk.assemble(free, given={"body.crank.angle": wanted.q[0, 2]}).v, 0.0, atol=1e-12)
    assert_allclose(udk.assemble(motor, 0.1, given={"body.crank.omega": 3.0}).v, wanted.v, atol=1e-9 * unit)
    far = udk.assemble(free, 7.0, given={"pin.B.vx": 0.3 * unit})  # at any time
    assert_allclose(udk.assemble(free, 7.0).q, far.q, atol=1e-12 * unit)
    pin = far.v[2, 0] - far.v[2, 2] * (np.sin(far.q[2, 2]) * unit)
    assert_allclose(pin, 0.3 * unit, rtol=1e-9)


def test_the_rest_of_a_system_follows_from_its_constraints():
    found = udk.assemble(on_sphere(), 2.0, given={"q[0]": 0.6, "v[1]": 2.0})
    assert_allclose([found.q[0], found.q @ found.q, found.v[1], found.v[2], found.q @ found.v], [0.6, 1, 2, 0.2, 0], atol=1e-12)
    start = udk.State([0.0, 0.8, 0.6], [1.0, 0.0, 0.0])
    assert_allclose(udk.assemble(on_sphere(), 0.0, start, given={"v[0]": 6.0}).v, [6.0, 0.0, 0.0], atol=1e-12)


def test_given_values_have_derivatives():
    mech = udk.library.four_bar()

    def of_mechanism(x):
        state = udk.assemble(mech, given={"body.crank.angle": x[0], "body.crank.omega": x[1]})
        return jnp.stack([state.q[2, 2], state.v[2, 2]])

    def of_system(x):
        state = udk.assemble(on_sphere(), given={"q[0]": x[0], "v[0]": x[1]})
        return jnp.concatenate([state.q, state.v])

    x, h = jnp.array([0.6, 3.0]), 1e-6 * np.eye(2)
    for f in (of_mechanism, of_system):
        f = jax.jit(f)
        differences = np.stack([(f(x + d) - f(x - d)) / 2e-6 for d in h], axis=1)
        assert_allclose(jax.jacfwd(f)(x), differences, atol=1e-8)
        assert_allclose(jax.jacrev(f)(x), differences, atol=1e-8)
    slope = jax.jit(jax.jacrev(of_mechanism))
    second = np.stack([(slope(x + d) - slope(x - d)) / 2e-6 for d in h], axis=-1)
    twice = jax.jit(jax.jacfwd(slope))
    assert len(twice.lower(x).as_text()) < 400_000  # by machine code; differentiated by JAX, the closure is 20 times as long
    assert_allclose(twice(x), second, atol=1e-7)
    many = jax.jit(jax.vmap(of_mechanism))(jnp.array([[0.6, 3.0], [1.0, -2.0]]))
    assert_allclose(many, [of_mechanism(jnp.array(x)) for x in ([0.6, 3.0], [1.0, -2.0])], atol=1e-12)


@pytest.mark.parametrize(
    ("model", "given", "said"),
    [
        ("four_bar", {"body.crnk.angle": 1.0}, 'no body named "crnk"'),
        ("four_bar", {"joint.A.torque": 1.0}, '"joint.A.torque" is neither a coordinate nor a velocity'),
        ("four_bar", {"body.crank.angle": [1.0, 2.0]}, 'given["body.crank.angle"] must be a number'),
        ("four_bar", [1.0], "given must map names to values"),
        ("system", {"q[3]": 1.0}, '"q[3]" is not one'),
        ("system", {"x": 1.0}, "must be a coordinate such as q[0]"),
        ("four_bar", {"body.crank.omega": 1.0, "body.coupler.omega": 1.0}, "contradict each other"),
        ("four_bar", {"joint.C.angle": 9.0}, "with joint.C.angle = 9 given: the mechanism cannot be closed"),
        ("system", {"q[0]": 6.0}, "with q[0] = 6 given: the constraints stay violated"),
        ("system", {"v[2]": 1.0}, "with v[2] = 1 given: the constraints stay violated"),
    ],
)
def test_impossible_values_are_refused(model, given, said):
    mechanism = udk.library.four_bar() if model == "four_bar" else on_sphere()
    with pytest.raises(ValueError, match=re.escape(said)):
        udk.assemble(mechanism, given=given)
