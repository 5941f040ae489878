"""Numbers held between samples, in one run or step by step: the same motion, and derivatives with respect to all samples."""

from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.integrate.compiled_mechanism import compile_mechanism
from udkjax.native.derivatives.record import STORED_POINTS
from udkjax.native.loaded_code import generate
from udkjax.programs.deferred import deferred

TORQUE, FORCE = np.array([1.0, 2.0, -1.0, 0.5]), np.array([[1.0, 0.0], [-2.0, 0.5], [3.0, 0.0]])
NAMES = ("force.motor.value", "force.push.vector")
EXACT: Any = {"rtol": 1e-12, "atol": 1e-12}
TS = np.linspace(0.0, 0.6, 14).round(9)  # most of them between samples


def cart(torque, force, links=1, **more) -> udk.Mechanism:
    """A pendulum, or a chain of links, on a cart that is pushed, with a motor in its pin."""
    bodies, before = {"cart": udk.Body(1.0, 1.0)}, "cart"
    joints: dict[str, Any] = {"rail": udk.Prismatic(["ground", "cart"], np.zeros((2, 2)), 0.0, 0.0)}
    for k in range(links):
        bodies[f"link{k}"] = udk.Body(1.0, 1 / 12, [0.0, -0.5 - k], -np.pi / 2)
        joints[f"pin{k}"] = udk.Revolute([before, f"link{k}"], [[0.0, 0.0] if k == 0 else [0.5, 0.0], [-0.5, 0.0]])
        before = f"link{k}"
    forces = {"motor": udk.Torque(["cart", "link0"], torque), "push": udk.Force("cart", force)}
    return udk.Mechanism(bodies, joints, forces=forces, **more)


def held_cart(links=1) -> udk.Mechanism:
    return cart(udk.Held(TORQUE, 0.1, 0.05), udk.Held(FORCE, 0.15), links)


def restarted(mechanism, ts, tolerances=EXACT):
    """The states at `ts` by runs of constant forces from each sample or output to the next."""
    values = [mechanism.forces[name].value if name == "motor" else mechanism.forces[name].vector for name in ("motor", "push")]
    breakpoints = np.concatenate([x.breakpoints for x in values])
    cuts = np.sort(np.append(ts, [t for t in np.unique(breakpoints.round(9)) if t < ts[-1] and abs(t - ts).min() > 1e-9]))
    state, found = udk.assemble(mechanism), {}
    found[ts[0]] = state
    for a, b in pairwise(cuts):
        now = mechanism.with_parameters({name: x((a + b) / 2) for name, x in zip(NAMES, values, strict=True)})
        run = udk.simulate(now, [a, b], state, **tolerances)
        state = found[b] = udk.State(run.q[-1], run.v[-1])
    return np.stack([found[t].q for t in ts]), np.stack([found[t].v for t in ts])


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_run_is_the_one_that_is_started_anew_at_each_sample(engine):
    mechanism = held_cart()
    found = udk.simulate(mechanism, TS, engine=engine, **EXACT)
    q, v = restarted(mechanism, TS)
    tol = {"native": 1e-11, "jax": 1e-10}[engine]  # of diffrax it is the interpolation between steps that errs
    assert_allclose(found.q, q, rtol=0, atol=tol)
    assert_allclose(found.v, v, rtol=0, atol=10 * tol)


@pytest.mark.slow
def test_a_run_of_a_large_scene():
    mechanism, ts = held_cart(links=42), TS[[0, 3, 6]]
    tolerances: Any = {"rtol": 1e-10, "atol": 1e-10}
    found = udk.simulate(mechanism, ts, engine="native", **tolerances)
    assert_allclose(found.q, restarted(mechanism, ts, tolerances)[0], rtol=0, atol=1e-8)
    loss = jax.jit(lambda torque, force: _loss(mechanism, torque, force, ts, tolerances))
    _check_gradient(loss, jax.jit(jax.grad(loss, (0, 1))), 1e-4)


def _loss(mechanism, torque, force, ts=TS, tolerances=EXACT):
    named = dict(zip((f"{name}.values" for name in NAMES), (torque, force), strict=True))
    run = udk.simulate(mechanism.with_parameters(named), ts, **tolerances)
    weights = np.cos(np.arange(3.0 * len(ts))).reshape(-1, 3)
    return jnp.sum(weights * run.q[:, 1]) + jnp.sum(run.v[-1])


def _check_gradient(loss, gradient, h):
    torque, force = gradient(TORQUE, FORCE)
    for k, e in enumerate(h * np.eye(4)):
        assert_allclose(torque[k], (loss(TORQUE + e, FORCE) - loss(TORQUE - e, FORCE)) / (2 * h), rtol=1e-6, atol=1e-7)
    for k, e in enumerate(h * np.eye(6).reshape(6, 3, 2)):
        assert_allclose(force.ravel()[k], (loss(TORQUE, FORCE + e) - loss(TORQUE, FORCE - e)) / (2 * h), rtol=1e-6, atol=1e-7)


@pytest.fixture(scope="module")
def loss():
    mechanism = held_cart()
    return jax.jit(lambda torque, force: _loss(mechanism, torque, force))


@pytest.mark.slow
def test_derivatives_by_the_samples_forward_and_in_reverse(loss):
    gradient = deferred(jax.grad(loss, (0, 1)))
    _check_gradient(loss, gradient, 1e-4)
    for a, b in zip(gradient(TORQUE, FORCE), deferred(jax.jacfwd(loss, (0, 1)))(TORQUE, FORCE), strict=True):
        assert_allclose(a, b, rtol=1e-10)


@pytest.mark.slow
def test_derivatives_by_the_samples_in_lanes(loss):
    gradient, forward = jax.jit(jax.grad(loss, (0, 1))), jax.jit(jax.jacfwd(loss, (0, 1)))
    batch = TORQUE * np.linspace(0.0, 1.0, 11)[:, None]
    for function in (gradient, forward):  # eleven members in eight lanes
        found = jax.jit(jax.vmap(function, (0, None)))(batch, FORCE)
        for k in (0, 7, 10):
            for a, b in zip(jax.tree.map(lambda x, k=k: x[k], found), function(batch[k], FORCE), strict=True):
                assert_allclose(a, b, rtol=1e-10, atol=1e-13)


@pytest.mark.slow
def test_second_derivatives_by_the_samples(loss):
    h, gradient = 1e-4, jax.jit(jax.grad(loss))
    second = jax.jit(jax.jacfwd(jax.grad(loss)))(TORQUE, FORCE)
    differences = [(gradient(TORQUE + h * e, FORCE) - gradient(TORQUE - h * e, FORCE)) / (2 * h) for e in np.eye(4)]
    assert_allclose(second, np.stack(differences, 1), rtol=1e-5, atol=1e-6)


def code_of(samples: int) -> list[str]:
    """The text of the machine code of a run, and of its reverse mode."""
    torque, times = udk.Held(np.ones(samples), 0.01), np.linspace(0.0, 1.0, samples + 1)
    motor = udk.Driver(["ground", "cart"], "x", udk.Spline(times, 0 * times))
    mechanism = cart(torque, [0.0, 0.0], drivers={"rail motor": motor})
    compiled = compile_mechanism(mechanism, udk.analyse(mechanism), udk.Auto(), udk.Projection())
    run = compiled.plan.operation
    assert run is not None
    reverse = run.with_cotangents((True,) * run.code.number_count, STORED_POINTS)
    return [generate(operation, 1, 1).written_text for operation in (run, reverse)]


def test_the_code_does_not_depend_on_how_many_samples_there_are():
    """Neither do its operations or its compile time, and they do not depend on the knots of a motion either."""
    assert code_of(10) == code_of(10_000)


@pytest.mark.slow
def test_a_hundred_thousand_samples():
    """Each takes the same time, one step. The gradient with respect to all of them takes as long as a few runs."""
    count, dt = 100_000, 1e-4
    mechanism = udk.Mechanism({"body": udk.Body(1.0, 1.0)}, forces={"push": udk.Force("body", [0.0, 0.0])}, gravity=[0.0, 0.0])
    values = np.sin(np.arange(count) * dt)

    def distance(x):
        push = udk.Held(jnp.stack([x, 0 * x], 1), dt)
        run = udk.simulate(mechanism.with_parameters({NAMES[1]: push}), [0.0, count * dt], max_steps=10**6)
        return run.q[-1, 0, 0], run.stats["steps"]

    (found, steps), slope = jax.jit(jax.value_and_grad(distance, has_aux=True))(values)
    left = dt * (count - np.arange(count))  # from the beginning of each sample to the end
    assert steps <= 2 * count + 10
    assert_allclose(found, np.sum(values * dt * (left - dt / 2)), rtol=1e-9)
    assert_allclose(slope, dt * (left - dt / 2), rtol=1e-7)


# --- step by step


def controlled(mechanism, dt, names=NAMES):
    """Apply inputs (N, ...) to a mechanism and return all states."""

    def advance(state, now):
        t, *values = now
        state = udk.step(mechanism, state, dict(zip(names, values, strict=True)), dt, t, **EXACT)
        return state, state

    return lambda *inputs: jax.lax.scan(advance, udk.assemble(mechanism), (dt * np.arange(len(inputs[0])), *inputs))[1]


@pytest.mark.slow
def test_steps_are_the_run_of_the_same_inputs():
    mechanism, dt = cart(0.0, [0.0, 0.0]), 0.05
    torque, force = np.sin(np.arange(8.0)), np.cos(np.arange(16.0)).reshape(8, 2)
    rollout, ts = jax.jit(controlled(mechanism, dt)), dt * np.arange(9)
    run = jax.jit(lambda a, b: udk.simulate(cart(udk.Held(a, dt), udk.Held(b, dt)), ts, analysis=udk.analyse(mechanism), **EXACT))
    found, expected = rollout(torque, force), run(torque, force)
    assert_allclose(found.q, expected.q[1:], rtol=0, atol=1e-11)
    by_step = deferred(jax.grad(lambda *x: jnp.sum(rollout(*x).v[:, 1, 2] ** 2), (0, 1)))(torque, force)
    by_run = deferred(jax.grad(lambda *x: jnp.sum(run(*x).v[1:, 1, 2] ** 2), (0, 1)))(torque, force)
    jax.tree.map(lambda a, b: assert_allclose(a, b, rtol=1e-8, atol=1e-10), by_step, by_run)
    state = udk.assemble(mechanism)
    for k in range(2):  # outside of a trace, too
        state = udk.step(mechanism, state, dict(zip(NAMES, (torque[k], force[k]), strict=True)), dt, **EXACT)
    assert_allclose(state.q, found.q[1], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_steps_of_several_side_by_side():
    mechanism, dt = cart(0.0, [0.0, 0.0]), 0.05
    torque, force = np.sin(np.arange(8.0)), np.cos(np.arange(16.0)).reshape(8, 2)
    rollout = jax.jit(controlled(mechanism, dt))
    several = jax.jit(jax.vmap(rollout))(np.stack([torque, 0 * torque, -torque]), np.stack([force] * 3))
    assert_allclose(several.q[0], rollout(torque, force).q, rtol=0, atol=1e-12)


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_steps_of_a_driven_mechanism(engine):
    """Time continues from step to step."""
    drive = udk.Driver(["ground", "rod"], "angle", udk.Sine(1.0, 2.0))
    bodies, pin = {"rod": udk.Body(1.0, 1 / 12, [0.5, 0.0])}, udk.Revolute(["ground", "rod"], [[0.0, 0.0], [-0.5, 0.0]])
    mechanism, dt = udk.Mechanism(bodies, {"pin": pin}, {"drive": drive}), 0.1
    state = udk.assemble(mechanism)
    for k in range(3):
        state = udk.step(mechanism, state, None, dt, k * dt, engine=engine)
    assert_allclose(state.q[0, 2], np.sin(0.6), atol=1e-12)


def test_a_step_that_fails_says_why_or_is_not_a_number():
    mechanism = cart(0.0, [0.0, 0.0])
    state = udk.assemble(mechanism)
    with pytest.raises(udk.SimulationError, match="step"):
        udk.step(mechanism, state, None, 10.0, max_steps=2)
    assert np.isnan(jax.jit(lambda dt: udk.step(mechanism, state, None, dt, max_steps=2))(10.0).q).all()
    for inputs, error, said in [
        ({"force.moto.value": 1.0}, udk.SceneError, 'did you mean "force.motor.value"'),
        ({"force.motor.value": [1.0, 2.0]}, udk.SceneError, "must have the shape"),
        ([1.0], TypeError, "inputs must map names"),
    ]:
        with pytest.raises(error, match=said):
            udk.step(mechanism, state, inputs, 0.1)
    with pytest.raises(ValueError, match="dt must be positive"):
        udk.step(mechanism, state, None, 0.0)


def drawn_scene() -> udk.Mechanism:
    """A four-bar with everything that a drawing has numbers of: lengths, a motor, a spring, a damper, a load and friction."""
    return udk.Drawing(
        pins={"O": (0, 0), "C": (100, 0), "A": udk.polar("O", 40, 60), "B": udk.circles(("A", "C"), (120, 80), "left")},
        links={
            "crank": {"pins": ["O", "A"], "density": 7850, "width": 15, "thickness": 5},
            "coupler": {"pins": ["A", "B"], "mass": "0.2 kg", "inertia": "0.001 kg m2"},
            "rocker": {"pins": ["C", "B"], "density": 7850, "width": 15, "thickness": 5},
        },
        ground=["O", "C"],
        motors={"motor": {"pin": "O", "speed": "60 rpm"}},
        springs=[{"between": ["O", "B"], "stiffness": "1 N/mm", "length": 60}],
        dampers=[{"between": ["C", "A"], "damping": "1 N s/m"}],
        loads=[{"pin": "B", "force": ["0 N", "-5 N"]}],
        friction=[{"pin": "B", "coefficient": 0.1, "radius": 5}],
        units={"length": "mm", "angle": "deg"},
    ).mechanism()


def geared() -> udk.Mechanism:
    """Two wheels, the constant of whose gear follows from their angles."""
    bodies = {name: udk.Body(1.0, 0.1, [x, 0.0], 0.3 * x, angular_velocity=w) for name, x, w in (("a", 0, 1.0), ("b", 1.0, -2.0))}
    joints: dict[str, Any] = {
        f"pin {n}": udk.Revolute(["ground", n], [[x, 0.0], [0.0, 0.0]]) for n, x in (("a", 0.0), ("b", 1.0))
    }
    joints["gear"] = udk.Gear(["a", "b"], [0.5, 0.25])
    return udk.Mechanism(bodies, joints, forces={"motor": udk.Torque(["ground", "a"], 1.0)})


@pytest.mark.parametrize("scene", [drawn_scene, geared, udk.library.planetary_gear], ids=["drawing", "gears", "library"])
def test_every_number_of_a_scene_can_be_an_input(scene):
    """Those of a drawing, which change everything that follows from them, and those that follow, given directly; traced, too."""
    mechanism, dt = scene(), 0.01
    for numbers, traced in ((mechanism.independent_parameters(), True), (mechanism.parameters(), False)):
        factors = 1 + 1e-3 * np.sin(np.arange(len(numbers)))
        inputs = {name: factor * np.asarray(x) for factor, (name, x) in zip(factors, numbers.items(), strict=True)}
        changed = mechanism.with_parameters(inputs)
        state = udk.assemble(changed)
        expected = udk.simulate(changed, [0.0, dt], state, **EXACT)
        step = lambda inputs, state=state: udk.step(mechanism, state, inputs, dt, **EXACT)  # noqa: E731
        for found in (step(inputs), jax.jit(step)(inputs)) if traced else (step(inputs),):
            assert_allclose(found.q, expected.q[-1], rtol=0, atol=1e-12)
            assert_allclose(found.v, expected.v[-1], rtol=0, atol=1e-10)


@pytest.mark.slow
def test_derivatives_of_a_step_by_numbers_of_a_drawing():
    mechanism = drawn_scene()
    state, names = udk.assemble(mechanism), ("link.coupler.mass", "motor.motor.speed", "spring.spring1.stiffness")
    names = [name for name in names if name in mechanism.parameters()]
    x0 = np.array([float(mechanism.parameters()[name]) for name in names])

    def torque_of(x):
        after = udk.step(mechanism, state, dict(zip(names, x, strict=True)), 0.02, **EXACT)
        return jnp.sum(after.q**2) + jnp.sum(after.v)

    steps = 1e-5 * np.diag(x0)
    wanted = [(torque_of(x0 + h) - torque_of(x0 - h)) / (2 * h.max()) for h in steps]
    assert_allclose(jax.grad(torque_of)(jnp.asarray(x0)), wanted, rtol=1e-6, atol=1e-8)
    assert_allclose(jax.jit(jax.jacfwd(torque_of))(jnp.asarray(x0)), wanted, rtol=1e-6, atol=1e-8)


def test_an_input_that_is_no_constant_is_refused():
    mechanism = geared()
    with pytest.raises(TypeError, match=r"inputs\['force.motor.value'\] is a Held"):
        held: Any = udk.Held([1.0, 2.0], 0.1)
        udk.step(mechanism, udk.assemble(mechanism), {"force.motor.value": held}, 0.1)


def rubbing(law: Any = "set-valued", **more) -> udk.Mechanism:
    """A block of 1 kg on a rail along x, with a coefficient of friction of 0.3."""
    block, rail = {"block": udk.Body(1.0, 0.1, velocity=(1.0, 0.0))}, udk.Prismatic(("ground", "block"), np.zeros((2, 2)), 0.0)
    return udk.Mechanism(block, {"S": rail}, forces={"rub": udk.Friction("S", coefficient=0.3, law=law), **more})


def test_steps_stick_and_slip_as_runs_do():
    """Eager, compiled and in loops: a block stops after v^2 / (2 mu g), and a force below the static limit does not move it."""
    mech, way = rubbing(), 1 / (2 * 0.3 * 9.81)
    start, states = udk.assemble(mech), []
    for step in (udk.step, jax.jit(udk.step, static_argnums=2)):
        state = start
        for _ in range(5):
            state = step(mech, state, None, 0.1)
        states.append(state)
    scanned, _ = jax.lax.scan(lambda state, _: (udk.step(mech, state, None, 0.1), None), start, length=5)
    for state in (*states, scanned):
        assert_allclose([state.q[0, 0], state.v[0, 0]], [way, 0.0], rtol=0, atol=1e-9)
    sticky = udk.Friction("S", coefficient=0.3, static_coefficient=0.5, law="set-valued")
    pulled = rubbing(rub=sticky, pull=udk.Force("block", [4.0, 0.0]))  # 0.3 and 0.5 of the weight are 2.9 and 4.9 N
    still = udk.State(start.q, 0.0 * start.v)
    assert_allclose(udk.step(pulled, still, None, 1.0).q, start.q, rtol=0, atol=1e-12)
    moved = udk.step(pulled, still, {"force.pull.vector": [6.0, 0.0]}, 1.0, t=2.0).q[0, 0]
    assert_allclose(moved, 0.5 * (6.0 - 0.3 * 9.81), rtol=1e-9)


def test_steps_have_the_derivatives_of_runs_through_sticking():
    """The way to rest is v^2 / (2 mu g); a pull that does not move the block has the derivative zero."""
    mech = rubbing(pull=udk.Force("block", [0.0, 0.0]))

    def end(x):
        moved = mech.with_parameters({"force.rub.coefficient": x[0]})
        return udk.step(moved, udk.assemble(moved), {"force.pull.vector": jnp.stack([x[1] * 0, x[1]])}, 0.5).q[0, 0]

    wanted = np.array([-1 / (2 * 0.3**2 * 9.81), 1 / (2 * 0.3 * 9.81**2)])  # a pull up makes the block lighter
    for slope in (deferred(jax.grad(end)), deferred(jax.jacfwd(end))):
        assert_allclose(slope(jnp.array([0.3, 0.0])), wanted, rtol=1e-6)
    still = udk.assemble(mech)
    along = jax.grad(lambda f: udk.step(mech, udk.State(still.q, 0 * still.v), {"force.pull.vector": [f, 0.0]}, 0.5).q[0, 0])
    assert along(1.0) == 0.0
