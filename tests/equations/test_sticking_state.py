"""Quantities of states at which joints stick: free bodies, the law at rest, power, batches, derivatives."""

# pyright: reportOptionalMemberAccess=false
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.friction import G
from tests.integrate.events.instant.test_sticking import STICKS, belt, block, oscillator, sticking

TOL: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-10}


def unbalanced(mechanism: udk.Mechanism, solution: Any) -> float:
    """Return the largest imbalance of m a = weight + other force elements + reactions + friction, in units of the weight.

    The mechanism has no force elements but springs to the ground and friction.
    """
    accelerate = jax.vmap(lambda t, q, v: udk.accelerations(mechanism, t, q, v))
    a = np.asarray(accelerate(solution.ts, solution.q, solution.v))
    mass = np.array([[b.mass, b.mass, b.inertia] for b in mechanism.bodies.values()])
    total = -mass * a + mass * np.array([*np.asarray(mechanism.gravity), 0.0])
    loads = [*udk.reactions(mechanism, solution).values(), *udk.friction_loads(mechanism, solution).values()]
    for by_body in loads:
        for body, load in by_body.items():
            total[:, mechanism.body_names.index(body)] += load
    for spring in (x for x in mechanism.forces.values() if isinstance(x, udk.Spring)):
        stretch = np.asarray(solution.q)[:, -1, 0] - float(spring.points[0, 0]) - float(spring.length)
        total[:, -1, 0] -= float(spring.stiffness) * stretch
    return float(np.abs(total).max() / (mass[:, 0].max() * G))


STILL = SimpleNamespace(ts=np.zeros(1), q=np.array([[[0.0, 0.0, 0.4]]]), v=np.zeros((1, 1, 3)))
ALONG = np.array([np.cos(0.4), np.sin(0.4)])


def test_the_law_at_rest():
    """On an incline a block that is at rest stays below mu = tan, and begins to slide above."""
    for coefficient, a in ((0.45, 0.0), (0.4, -G * (np.sin(0.4) - 0.4 * np.cos(0.4)))):
        found = udk.accelerations(block(0.4, coefficient=coefficient), 0.0, STILL.q[0], STILL.v[0])
        np.testing.assert_allclose(found[0, :2], a * ALONG, atol=1e-13)


@pytest.mark.slow
def test_a_block_that_sticks_carries_its_weight():
    mechanism, drag = block(0.4, coefficient=0.45), G * np.sin(0.4)
    np.testing.assert_allclose(udk.friction_loads(mechanism, STILL)["rub"]["block"][0, :2], drag * ALONG, atol=1e-13)
    normal = udk.reactions(mechanism, STILL)["S"]["block"][0, :2]
    np.testing.assert_allclose(normal, np.array([0.0, G]) - drag * ALONG, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mechanism", "end"),
    [(block(0.2, 2.0, coefficient=0.3), 1.0), (oscillator(), 8.0), (belt(0.5, 0.3, 100.0, 1.0, 0.2), 2.0)],
)
def test_free_bodies_and_power(mechanism, end):
    """While a joint slides and while it sticks, Newton's laws and the balance of power hold to rounding."""
    solution = udk.simulate(mechanism, np.linspace(0.0, end, 41), **TOL)
    (stuck,) = solution.sticking.values()
    assert 0 < np.sum(stuck) < 41
    assert unbalanced(mechanism, solution) < 1e-13
    balance = udk.power_balance(mechanism, solution)
    assert balance.relative < 1e-13
    assert float(balance.forces["rub"].max()) < 1e-13


@pytest.mark.slow
def test_pins_of_a_four_bar_that_lock_each_other():
    """All of them stick; the shares of the friction torques are not unique, but each is within its limit."""
    mechanism = sticking(udk.library.four_bar())
    solution = udk.simulate(mechanism, np.linspace(0.0, 40.0, 81), **TOL)
    assert all(bool(x[-1]) and not bool(x[0]) for x in solution.sticking.values())
    assert unbalanced(mechanism, solution) < 1e-12
    assert udk.power_balance(mechanism, solution).relative < 1e-12
    reactions, friction = udk.reactions(mechanism, solution), udk.friction_loads(mechanism, solution)
    for name in "ABCD":
        force = next(iter(reactions[name].values()))[-1, :2]
        torque = next(iter(friction[f"rub {name}"].values()))[-1, 2]
        assert abs(float(torque)) <= 0.2 * 0.1 * float(np.linalg.norm(force)) * (1 + 1e-9)
    a = udk.accelerations(mechanism, 40.0, solution.q[-1], solution.v[-1])
    assert float(np.abs(a).max()) < 1e-10


@pytest.mark.slow
def test_batches_equal_single_states():
    mechanism, ts = oscillator(), np.linspace(0.0, 8.0, 9)

    def found(coefficient):
        changed = mechanism.with_parameters({"force.rub.coefficient": coefficient})
        solution = udk.simulate(changed, ts, **TOL)
        balance = udk.power_balance(changed, solution)
        load = udk.friction_loads(changed, solution)["rub"]["block"]
        return udk.reactions(changed, solution)["S"]["block"], load, balance.residual

    coefficients = jnp.array([0.05, 0.2, 0.6])
    for k, together in enumerate(zip(*jax.vmap(found)(coefficients), strict=True)):
        for x, y in zip(together, found(coefficients[k]), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-11)


@pytest.mark.slow
def test_the_force_of_a_joint_that_sticks_has_derivatives():
    """The spring pulls at the block, which is held: the friction is k x, with the derivative x by k, and none by mu."""
    still = SimpleNamespace(ts=np.zeros(1), q=np.array([[[0.01, 0.0, 0.0]]]), v=np.zeros((1, 1, 3)))

    def force(x):
        changed = oscillator().with_parameters({"force.spring.stiffness": x[0], "force.rub.coefficient": x[1]})
        return udk.friction_loads(changed, still)["rub"]["block"][0, 0]

    at = jnp.array([100.0, 0.1])
    np.testing.assert_allclose(force(at), 1.0, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(force)(at), [0.01, 0.0], atol=1e-12)


@pytest.mark.slow
def test_constant_torques():
    """A wheel at rest carries the moment of a weight up to the torque of its friction, with and without load-dependence."""
    for torque, rests in ((1.0, True), (0.9, False)):
        mechanism = udk.Mechanism(
            {"wheel": udk.Body(1.0, 0.5, [0.1, 0.0])},
            {"A": udk.Revolute(["ground", "wheel"], [[0.0, 0.0], [-0.1, 0.0]])},
            forces={"rub": udk.Friction("A", torque=torque, **STICKS)},
        )
        alpha = float(udk.accelerations(mechanism, 0.0, mechanism.q0, mechanism.v0)[0, 2])
        inertia = 0.5 + 0.01
        assert alpha == pytest.approx(0.0 if rests else -(0.981 - torque) / inertia, abs=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["smooth", "set-valued"])
def test_friction_follows_loads_that_are_shared_by_compliances(law):
    """A bar that slides between two slots, one of which is stiffer: the friction of each follows its own share."""
    speed: dict[str, Any] = {"speed": 1e-6} if law == "smooth" else {}
    mechanism = udk.Mechanism(
        {"bar": udk.Body(2.0, 0.1, [0.0, 0.0], velocity=[1.0, 0.0])},
        {name: udk.Prismatic(["ground", "bar"], [[x, 0.0], [x, 0.0]], 0.0) for name, x in (("one", 0.0), ("two", 0.0))},
        forces={name: udk.Friction(name, coefficient=mu, law=law, **speed) for name, mu in (("one", 0.1), ("two", 0.3))},
    )
    state = SimpleNamespace(ts=np.zeros(1), q=mechanism.q0[None], v=mechanism.v0[None])
    soft = {"one": jnp.array([1e-6, 0.0]), "two": jnp.array([3e-6, 0.0])}
    loads = udk.reactions(mechanism, state, compliances=soft)
    np.testing.assert_allclose(loads["one"]["bar"][0, 1], 0.75 * 2.0 * G, rtol=1e-10)
    np.testing.assert_allclose(loads["two"]["bar"][0, 1], 0.25 * 2.0 * G, rtol=1e-10)


@pytest.mark.slow
def test_friction_that_loads_redundant_joints_follows_their_compliances():
    """A driver pulls a carriage along two rails: its effort has the friction of the shares, and not of those of least norm."""
    mechanism = udk.Mechanism(
        {"bar": udk.Body(2.0, 0.1, [0.0, 0.0])},
        {name: udk.Prismatic(["ground", "bar"], [[0.0, 0.0], [0.0, 0.0]], 0.0) for name in ("one", "two")},
        {"pull": udk.Driver(["ground", "bar"], "x", udk.Polynomial([0.0, 1.0]), [[0.0, 0.0], [0.0, 0.0]])},
        {name: udk.Friction(name, coefficient=mu, speed=1e-6) for name, mu in (("one", 0.1), ("two", 0.3))},
    )
    state = SimpleNamespace(ts=np.zeros(1), q=mechanism.q0[None], v=np.array([[[1.0, 0.0, 0.0]]]))
    effort = udk.reactions(mechanism, state, compliances={"one": jnp.array([1e-6, 0.0]), "two": jnp.array([3e-6, 0.0])})["pull"][
        "bar"
    ][0, 0]
    assert float(effort) == pytest.approx((0.75 * 0.1 + 0.25 * 0.3) * 2.0 * G, rel=1e-9)
    even = udk.reactions(mechanism, state)["pull"]["bar"][0, 0]
    assert float(even) == pytest.approx(0.2 * 2.0 * G, rel=1e-9)
