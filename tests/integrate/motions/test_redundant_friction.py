"""Friction of joints that share their loads with redundant ones: doubled joints change nothing, whatever makes them redundant."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false
import sys
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
import udkjax.equations.programs.scene_programs
from tests.friction import cart, drawer, pendulum, rubbing
from tests.integrate.events.instant.test_sticking import block, oscillator
from udkjax.equations.states.textbook import prepare

TS = np.linspace(0.0, 0.6, 13)
TOL: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-10}
SINGLE: dict[str, Callable[[], udk.Mechanism]] = {
    "pendulum": lambda: pendulum(coefficient=0.3, radius=0.1, speed=0.05),
    "cart": lambda: cart(0.2, 0.2, speed=0.05, viscous=0.1),
    "drawer": lambda: drawer(0.1),
}


def doubled(mechanism: udk.Mechanism, times: int = 2, rubs: bool = True) -> udk.Mechanism:
    """Return a mechanism that has each joint with friction several times; with `rubs` all of them have the friction."""
    base = mechanism.without_origin
    joints, forces = dict(base.joints), dict(base.forces)
    for name, force in base.forces.items():
        if isinstance(force, udk.Friction):
            for k in range(1, times):
                joints[f"{force.joint}{k}"] = base.joints[force.joint]
                if rubs:
                    forces[f"{name}{k}"] = _of_joint(force, f"{force.joint}{k}")
    return udk.Mechanism(base.bodies, joints, base.drivers, forces, base.gravity)


def _of_joint(friction: udk.Friction, joint: str) -> udk.Friction:
    numbers = {x: getattr(friction, x) for x in ("coefficient", "static_coefficient", "viscous", "radius", "length")}
    numbers |= {"speed": friction.speed} if friction.law == "smooth" else {}
    return udk.Friction(joint, law=friction.law, **{x: value for x, value in numbers.items() if value is not None})


@pytest.mark.parametrize("name", SINGLE)
def test_a_doubled_joint_changes_no_run(name):
    single = udk.simulate(SINGLE[name](), TS, **TOL)
    for times in (2, 3):
        run = udk.simulate(doubled(SINGLE[name](), times), TS, **TOL)
        assert run.settings["engine"] == "native"
        np.testing.assert_allclose(run.q, single.q, atol=1e-9)
        np.testing.assert_allclose(run.v, single.v, atol=1e-8)


def test_a_joint_without_friction_takes_its_share_of_the_load():
    """Of two equal slides each carries half the load: one alone rubs as a single slide with half the coefficient."""
    shared = doubled(cart(0.2, speed=0.05), rubs=False)
    run = udk.simulate(shared, TS, **TOL)
    np.testing.assert_allclose(run.q, udk.simulate(cart(0.1, speed=0.05), TS, **TOL).q, atol=1e-9)
    assert run.settings["engine"] == "native"


def end(mechanism: udk.Mechanism, coefficients: Any) -> Any:
    names = [x for x in mechanism.parameters() if x.endswith(".coefficient")]
    changed = mechanism.with_parameters(dict(zip(names, coefficients, strict=True)))
    return jnp.sum(jnp.sin(udk.simulate(changed, TS, **TOL).q[-1]))


def test_derivatives_add_up_to_those_of_a_single_joint():
    mechanism = SINGLE["cart"]()
    both = lambda c: end(doubled(mechanism), [c, c])  # noqa: E731
    one = lambda c: end(mechanism, [c])  # noqa: E731
    np.testing.assert_allclose(jax.grad(both)(0.2), jax.grad(one)(0.2), rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(both, (0.2,), (1.0,))[1], jax.grad(one)(0.2), rtol=1e-7)


@pytest.mark.slow
def test_second_derivatives_are_differences_of_gradients():
    """In a scissor lift the null space of the constraints' rows changes with the position."""
    lift = rubbing(udk.library.scissor_lift(), speed=0.3)
    rng = np.random.default_rng(0)
    masses = {x: value * rng.uniform(0.6, 1.5) for x, value in lift.parameters().items() if x.endswith(".mass")}
    lift = lift.with_parameters(masses)
    names = [x for x in lift.parameters() if x.endswith((".coefficient", ".mass"))][::7][:3]
    at = jnp.array([lift.parameters()[x] for x in names])

    def loss(x: Any) -> Any:
        run = udk.simulate(lift.with_parameters(dict(zip(names, x, strict=True))), TS[:5], rtol=1e-11, atol=1e-11)
        return jnp.sum(jnp.sin(run.q[-1])) + jnp.sum(run.v[-1] ** 2)

    gradient, steps = jax.grad(loss), 1e-4 * jnp.diag(at)
    differences = np.array([(loss(at + h) - loss(at - h)) / (2 * jnp.sum(h)) for h in steps])
    np.testing.assert_allclose(gradient(at), differences, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(jax.jacfwd(loss)(at), gradient(at), rtol=1e-9, atol=1e-12)
    bends = np.array([(gradient(at + h) - gradient(at - h)) / (2 * jnp.sum(h)) for h in steps])
    np.testing.assert_allclose(jax.hessian(loss)(at), bends, rtol=1e-5, atol=1e-7)


def test_members_of_a_batch_are_single_runs():
    mechanism = doubled(SINGLE["cart"]())

    def run(x: Any) -> Any:
        return udk.simulate(mechanism.with_parameters({"force.rub.coefficient": x}), TS).q

    values = jnp.linspace(0.1, 0.3, 9)
    batch = jax.vmap(run)(values)
    for k in (0, 4, 8):
        np.testing.assert_array_equal(batch[k], run(values[k]))


# --- rows whose redundancy is known only when a run begins


def jitted(mechanism: udk.Mechanism, **more: Any) -> udk.Solution:
    return eqx.filter_jit(lambda m: udk.simulate(m, TS, throw=False, **more))(mechanism)


def test_a_jitted_mechanism_with_friction_runs_by_machine_code():
    mechanism = rubbing(udk.library.four_bar())
    run = jitted(mechanism)
    assert run.settings["engine"] == "native"
    np.testing.assert_array_equal(run.q, udk.simulate(mechanism, TS).q)


@pytest.mark.parametrize("name", ["pendulum", "cart"])
def test_a_jitted_mechanism_finds_the_redundant_rows_that_share_loads(name):
    run, single = jitted(doubled(SINGLE[name]()), **TOL), udk.simulate(SINGLE[name](), TS, **TOL)
    assert run.settings["engine"] == "native"
    np.testing.assert_allclose(run.q, single.q, atol=1e-9)


def test_members_of_a_batch_have_redundant_rows_of_their_own():
    """Two pins at one place are redundant, and the pendulum swings; at two places they hold it."""
    both = doubled(SINGLE["pendulum"]())
    apart = both.with_parameters({"joint.A1.points": np.array([[0.1, 0.0], [-0.4, 0.0]])})
    stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(y) for y in x]), *(3 * [both, apart]))
    run = eqx.filter_jit(eqx.filter_vmap(lambda m: udk.simulate(m, TS, throw=False, **TOL)))(stacked)
    single = udk.simulate(SINGLE["pendulum"](), TS, **TOL)
    for k in range(6):
        expected = np.broadcast_to(single.q[:1], single.q.shape) if k % 2 else single.q
        np.testing.assert_allclose(run.q[k], expected, atol=1e-9)
        np.testing.assert_array_equal(run.q[k], run.q[k % 2])


def test_a_jitted_gradient_agrees_with_that_of_known_rows():
    mechanism = doubled(SINGLE["cart"]())

    def loss(m: udk.Mechanism) -> Any:
        return jnp.sum(jnp.sin(udk.simulate(m, TS, throw=False, **TOL).q[-1]))

    found = eqx.filter_jit(eqx.filter_grad(loss))(mechanism).parameters()
    for name in ("force.rub.coefficient", "body.bob.mass"):
        expected = jax.grad(lambda x, name=name: loss(mechanism.with_parameters({name: x})))(mechanism.parameters()[name])
        np.testing.assert_allclose(found[name], expected, rtol=1e-8)


# --- events


@pytest.mark.parametrize("name", ["oscillator", "block"])
def test_doubled_joints_stick_and_slip_as_single_ones(name):
    single = {"oscillator": lambda: oscillator(0.4), "block": lambda: block(0.3, 1.0, coefficient=0.5)}[name]()
    ts = np.linspace(0.0, 2.0, 21)
    run, expected = (udk.simulate(x, ts, **TOL) for x in (doubled(single), single))
    assert run.settings["engine"] == expected.settings["engine"] == "native"
    np.testing.assert_allclose(run.q, expected.q, atol=1e-9)
    np.testing.assert_array_equal(run.sticking["S"] | run.sticking["S1"], expected.sticking["S"])
    assert expected.sticking["S"][-1]


def test_a_jitted_run_of_doubled_joints_sticks():
    single, ts = block(0.3, 1.0, coefficient=0.5), np.linspace(0.0, 2.0, 21)
    run = eqx.filter_jit(lambda m: udk.simulate(m, ts, throw=False, **TOL))(doubled(single))
    assert run.settings["engine"] == "native"
    np.testing.assert_allclose(run.q, udk.simulate(single, ts, **TOL).q, atol=1e-9)


def test_an_attached_joint_takes_its_share_of_the_load():
    """From 0.3 s on a second slide without friction carries half the load, until the first one is released."""
    first, later = (cart(c, speed=0.05) for c in (0.2, 0.1))
    slide = udk.Prismatic(["ground", "cart"], [[0.0, 0.0], [0.0, 0.0]], 0.0)
    events = [
        udk.Event(lambda t, at: t - 0.3, udk.Attach(slide, "S1"), name="on"),
        udk.Event(lambda t, at: t - 0.5, udk.Release("S"), name="off"),
    ]
    run = udk.simulate(first, TS, events=events, **TOL)
    assert run.settings["engine"] == "native"
    before = udk.simulate(first, TS[:7], **TOL)
    between = udk.simulate(later, TS[6:11], udk.State(before.q[-1], before.v[-1]), **TOL)
    after = udk.simulate(cart(0.0), TS[10:], udk.State(between.q[-1], between.v[-1]), **TOL)
    np.testing.assert_allclose(run.q, np.concatenate([before.q, between.q[1:], after.q[1:]]), atol=1e-8)


@pytest.mark.slow
def test_a_parallelogram_whose_pins_stick_agrees_with_its_plain_form():
    base = udk.library.parallelogram(angle=-1.2)
    friction = {
        f"rub {name}": udk.Friction(name, coefficient=0.3, static_coefficient=0.4, radius=0.1, law="set-valued")
        for name in base.joints
    }
    mechanism = udk.Mechanism(base.bodies, base.joints, {}, friction, base.gravity)
    ts = np.linspace(0.0, 3.0, 11)
    run, plain = udk.simulate(mechanism, ts, **TOL), udk.simulate(mechanism, ts, engine="jax", **TOL)
    assert run.settings["engine"] == "native" and run.sticking["A1"][-1]
    np.testing.assert_allclose(run.q, plain.q, atol=1e-8)

    def loss(x: Any) -> Any:
        changed = mechanism.with_parameters({"force.rub A1.coefficient": x})
        return jnp.sum(udk.simulate(changed, ts, **TOL).q[-1] ** 2)

    differences = (loss(0.3 + 1e-5) - loss(0.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose([jax.grad(loss)(0.3), jax.jvp(loss, (0.3,), (1.0,))[1]], differences, rtol=1e-6)


# --- large scenes


def test_loops_share_loads_as_unrolled_programs_do(monkeypatch):
    mechanism = lambda: doubled(SINGLE["cart"]())  # noqa: E731
    unrolled = udk.simulate(mechanism(), TS, **TOL)
    slope = jax.grad(lambda c: end(mechanism(), [c, 0.2]))(0.2)
    module: Any = sys.modules["udkjax.equations.programs.scene_programs"]
    monkeypatch.setattr(module, "UNROLLED_SCENE_OPERATIONS", 0)
    module._scene_programs.cache_clear()
    try:
        assert not prepare(mechanism()).programs.is_small
        np.testing.assert_allclose(udk.simulate(mechanism(), TS, **TOL).q, unrolled.q, atol=1e-12)
        np.testing.assert_allclose(jax.grad(lambda c: end(mechanism(), [c, 0.2]))(0.2), slope, rtol=1e-9)
    finally:
        module._scene_programs.cache_clear()
