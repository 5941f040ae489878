from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax.scene as udk
from udkjax.scene.numbers.units import units_of

V = jnp.array([[0.3, -0.2, 1.1], [0.5, 0.4, -0.7], [0.0, 0.1, 0.2]])


def total_loads(mechanism, name, at, q, v):
    """The load on each attached body: the element's own, and -dV/dq of its potential."""
    element = mechanism.forces[name]
    attached = mechanism.frames_of(element)

    def call(method, q):
        return method(0.0, *(at(mechanism, q, v)[n] for n in attached))

    stated = call(element.loads, q)
    loads = dict.fromkeys(attached, jnp.zeros(3))
    if stated is not None:
        loads = {n: jnp.stack([jnp.asarray(x) for x in load]) for n, load in zip(attached, stated, strict=True)}
    if call(element.potential, q) is not None:
        slope = jax.grad(lambda q: call(element.potential, q))(q)
        loads = {n: loads[n] - (slope[mechanism.body_names.index(n)] if n != "ground" else 0.0) for n in attached}
    return loads


@pytest.mark.parametrize("name", ["damped", "torsion", "torque"])
def test_action_is_reaction(everything, at, name):
    q = everything.q0
    loads = total_loads(everything, name, at, q, V)
    place = {n: q[everything.body_names.index(n)] for n in loads}
    assert_allclose(sum(load[:2] for load in loads.values()), 0.0, atol=1e-14)
    moment = sum(place[n][0] * load[1] - place[n][1] * load[0] + load[2] for n, load in loads.items())
    assert_allclose(moment, 0.0, atol=1e-14)


def test_a_damper_takes_power(everything, at):
    damped, q = everything.forces["damped"], everything.q0

    def stretch(q):
        a, b = (at(everything, q)[n] for n in ("a", "b"))
        return udk.between(damped.points, a, b).norm()

    rate = jnp.sum(jax.grad(stretch)(q) * V)
    loads = damped.loads(0.0, *(at(everything, q, V)[n] for n in ("a", "b")))
    power = sum(jnp.dot(jnp.stack(load), V[everything.body_names.index(n)]) for n, load in zip("ab", loads, strict=True))
    assert_allclose(power, -0.3 * rate**2, rtol=1e-13)


def test_spring_pulls_with_stiffness_times_stretch():
    spring = udk.Spring(["ground", "a"], [[0.0, 0.0], [0.0, 0.0]], stiffness=10.0, length=0.5)
    ground = udk.Frame(0.0, 0.0, 0.0, 1.0, 0.0)

    def energy(x):
        return spring.potential(0.0, ground, udk.Frame(x, 0.0, 0.0, 1.0, 0.0))

    assert_allclose([energy(2.0), jax.grad(energy)(2.0)], [0.5 * 10.0 * 1.5**2, 15.0])
    assert spring.loads(0.0, ground, ground) is None  # no damping: nothing to compute
    assert jnp.isfinite(jax.grad(energy)(0.0))  # its ends meet


def test_a_spring_without_a_length_is_smooth_where_its_ends_meet():
    ground = udk.Frame(0.0, 0.0, 0.0, 1.0, 0.0)

    def energy(numbers):  # x, y, length
        spring = udk.Spring(["ground", "a"], [[0.0, 0.0], [0.0, 0.0]], stiffness=10.0, length=numbers[2])
        return spring.potential(0.0, ground, udk.Frame(numbers[0], numbers[1], 0.0, 1.0, 0.0))

    assert_allclose(jax.hessian(energy)(jnp.zeros(3)), np.diag([10.0, 10.0, 10.0]))
    away = jnp.array([0.3, -0.4, 0.0])  # 1/2 k (|d| - L)^2, |d| = 0.5
    assert_allclose(jax.grad(energy)(away), [3.0, -4.0, -5.0])


def test_torsion_spring_and_friction(everything, at):
    loads = total_loads(everything, "torsion", at, everything.q0, V)
    turned, omega = everything.q0[0, 2] - everything.q0[1, 2], V[0, 2] - V[1, 2]
    assert_allclose(loads["b"], [0.0, 0.0, -3.0 * (turned - 0.1) - 0.2 * omega], rtol=1e-14)
    assert everything.frames_of(everything.forces["rub"]) == ("ground", "b")
    assert_allclose(total_loads(everything, "rub", at, everything.q0, V)["b"], [0.0, 0.0, -0.5 * np.tanh(1.1 / 0.3)])


def test_a_joint_sticks_up_to_its_static_coefficient():
    """By the load of a pin at its radius; by the forces at both ends of a guide, which also carry a torque of 0.6 N m."""
    numbers: dict[str, Any] = {"coefficient": 0.2, "static_coefficient": 0.3, "law": "set-valued"}
    pin, guide = udk.Revolute(["ground", "b"], [[0, 0], [0, 0]]), udk.Prismatic(["ground", "b"], [[0, 0], [0, 0]], 0.0)
    assert_allclose(udk.Friction("A", torque=1.0, radius=0.5, **numbers).largest_force(pin, [3.0, 4.0]), 1.0 + 0.3 * 0.5 * 5.0)
    assert_allclose(udk.Friction("A", **numbers).largest_force(guide, [-4.0, 0.6]), 0.3 * 4.0)
    for couple, load in ((0.6, 6.0), (0.1, 4.0)):  # 2 N at each end, and the torque over 0.2 m
        assert_allclose(udk.Friction("A", length=0.2, **numbers).largest_force(guide, [-4.0, couple]), 0.3 * load)


def test_the_sliding_speed_is_the_rate_of_the_place_on_the_guide(at):
    """The guide turns with its body."""
    joint = udk.Prismatic(["a", "b"], [[0.1, -0.2], [0.3, 0.4]], 0.7)
    mechanism = udk.Mechanism({name: udk.Body(1.0, 0.1) for name in "ab"}, {"S": joint})
    q, v = jnp.array([[0.2, 0.5, 0.9], [1.1, -0.3, 0.4]]), V[:2]

    def place(q):
        frames = at(mechanism, q, v)
        seen, axis = frames["b"].point(joint.points[1]), frames["a"].vector((jnp.cos(joint.axis), jnp.sin(joint.axis)))
        return axis.x * (seen.x - frames["a"].x) + axis.y * (seen.y - frames["a"].y)

    frames = at(mechanism, q, v)
    assert_allclose(udk.Friction.sliding_speed(joint, frames["a"], frames["b"]), jax.jvp(place, (q,), (v,))[1], rtol=1e-12)


def test_numbers_of_friction_have_their_units():
    numbers: dict[str, Any] = {
        "torque": 1.0,
        "velocity": 0.1,
        "coefficient": 0.2,
        "radius": 0.01,
        "static_coefficient": 0.3,
        "viscous": 0.4,
    }
    rod, pin = udk.Body(1.0, 0.1), udk.Revolute(["ground", "rod"], [[0, 0], [0, 0]])
    mechanism = udk.Mechanism({"rod": rod}, {"A": pin}, forces={"rub": udk.Friction("A", **numbers)})
    units = {name: units_of(mechanism, f"force.rub.{name}") for name in (*numbers, "speed")}
    expected = {"torque": "N m", "velocity": "rad/s", "radius": "m", "viscous": "s/m", "speed": "m/s"}
    assert {name: unit for name, unit in units.items() if "coefficient" not in name} == expected


def test_forces_in_either_frame(everything, at):
    angle = everything.q0[1, 2]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    force, (x, y) = np.array([1.0, 2.0]), everything.forces["follow"].point
    follow = [*turn @ force, x * force[1] - y * force[0]]
    assert_allclose(total_loads(everything, "follow", at, everything.q0, V)["a"], follow, rtol=1e-14)
    x, y = turn @ np.asarray(everything.forces["push"].point)
    push = [*force, x * force[1] - y * force[0]]
    assert_allclose(total_loads(everything, "push", at, everything.q0, V)["a"], push, rtol=1e-14)


def held(value):
    return udk.Mechanism(
        {"a": udk.Body(1.0, 1.0)}, forces={"motor": udk.Torque(["ground", "a"], value), "push": udk.Force("a", [0, 0])}
    )


def test_a_number_that_is_held_between_samples(same):
    """The first and the last value hold beyond. It replaces a number, can be replaced by one, and can be stored in a file."""
    mechanism = held(udk.Held([1.0, 2.0, -1.0], 0.1, t0=0.5))
    times = [0.0, 0.5, np.nextafter(0.6, 0.0), 0.6, 0.7, 9.0]
    assert [float(mechanism.forces["motor"].value(t)) for t in times] == [1.0, 1.0, 1.0, 2.0, -1.0, -1.0]
    assert_allclose(np.asarray(mechanism.breakpoints), [0.6, 0.7])
    assert same(udk.loads(udk.dumps(mechanism)), mechanism)
    assert same(held(0.0).with_parameters({"force.motor.value": mechanism.forces["motor"].value}), mechanism)
    assert same(mechanism.with_parameters({"force.motor.value": 3.0}), held(3.0))
    changed = mechanism.with_parameters({"force.motor.value.values[1]": 5.0, "force.push.vector": udk.Held([[1.0, 2.0]], 0.2)})
    assert_allclose(changed.parameters()["force.motor.value.values"], [1.0, 5.0, -1.0])
    assert held(udk.Held([1.0], 0.1)).breakpoints is None


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (udk.Held([1.0], 0.0), r"force\[0\]\).value.dt: must be > 0"),
        (udk.Held([1.0], "fast"), "value.dt: must be a number"),  # pyright: ignore[reportArgumentType]
        (udk.Held([], 0.1), "value.values: needs at least 1"),
        (udk.Held([1.0, np.nan], 0.1), r"value.values\[1\]: must be finite"),
        (udk.Held([[1.0, 2.0]], 0.1), "value.values: each sample must be a number, but has the shape"),
    ],
)
def test_wrong_samples_are_refused(value, said):
    with pytest.raises(udk.SceneError, match=said):
        held(value)
    with pytest.raises(udk.SceneError, match="a motion that is held jumps at each sample"):
        udk.Mechanism({"a": udk.Body(1.0, 1.0)}, drivers={"d": udk.Driver(["ground", "a"], "x", value)})
