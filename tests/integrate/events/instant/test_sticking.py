"""Runs with set-valued friction: closed forms, energy, lanes, derivatives through stick and slip."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import udkjax as udk
from tests.calls import calls_of
from tests.friction import G, pendulum
from udkjax.native.loaded_code import PreparedCall

TOL: dict[str, Any] = {"rtol": 1e-11, "atol": 1e-11}
STICKS: Any = {"law": "set-valued"}


def block(angle: float, uphill: float = 0.0, **friction: Any) -> udk.Mechanism:
    """Return a block of 1 kg on an incline, with a velocity up the slope."""
    along = np.array([np.cos(angle), np.sin(angle)])
    return udk.Mechanism(
        {"block": udk.Body(1.0, 0.01, [0.0, 0.0], angle, velocity=uphill * along)},
        {"S": udk.Prismatic(["ground", "block"], [[0.0, 0.0], [0.0, 0.0]], angle)},
        forces={"rub": udk.Friction("S", **(STICKS | friction))},
    )


def oscillator(coefficient: float = 0.1, stiffness: float = 100.0, mass: float = 2.0, start: float = 0.5) -> udk.Mechanism:
    """Return a block on a rail, on a spring that is free of load at x = 0, and at rest at `start`."""
    return udk.Mechanism(
        {"block": udk.Body(mass, 0.01, [start, 0.0])},
        {"S": udk.Prismatic(["ground", "block"], [[0.0, 0.0], [0.0, 0.0]], 0.0)},
        forces={
            "spring": udk.Spring(["ground", "block"], [[-3.0, 0.0], [0.0, 0.0]], stiffness, 3.0),
            "rub": udk.Friction("S", coefficient=coefficient, **STICKS),
        },
    )


def turns(start: float, band: float) -> list[float]:
    """Return where the oscillator turns round, up to its last place: the amplitude falls by two `band` in each half period."""
    places = [start]
    while abs(places[-1]) > band:
        places.append(-np.sign(places[-1]) * (abs(places[-1]) - 2 * band))
    return places


def belt(static: float, sliding: float, stiffness: float, mass: float, speed: float) -> udk.Mechanism:
    """Return a block on a belt, held back by a spring."""
    return udk.Mechanism(
        {
            "belt": udk.Body(10.0, 0.1, [0.0, -0.1], velocity=[speed, 0.0]),
            "block": udk.Body(mass, 0.01, [0.0, 0.0], velocity=[speed, 0.0]),
        },
        {
            "rail": udk.Prismatic(["ground", "belt"], [[0.0, -0.1], [0.0, 0.0]], 0.0),
            "S": udk.Prismatic(["belt", "block"], [[0.0, 0.1], [0.0, 0.0]], 0.0),
        },
        {"motor": udk.Driver(["ground", "belt"], "x", udk.Polynomial([0.0, speed]), [[0.0, 0.0], [0.0, 0.0]])},
        {
            "spring": udk.Spring(["ground", "block"], [[-3.0, 0.0], [0.0, 0.0]], stiffness, 3.0),
            "rub": udk.Friction("S", coefficient=sliding, static_coefficient=static, **STICKS),
        },
    )


def sticking(mechanism: udk.Mechanism, coefficient: float = 0.2, radius: float = 0.1) -> udk.Mechanism:
    """Return a mechanism without drivers, with set-valued friction in all of its revolutes, slides and slots."""
    base, forces = mechanism.without_origin, dict(mechanism.forces)
    for name, joint in base.joints.items():
        arm: dict[str, Any] = {"radius": radius} if isinstance(joint, udk.Revolute) else {}
        forces[f"rub {name}"] = udk.Friction(name, coefficient=coefficient, **arm, **STICKS)
    return udk.Mechanism(base.bodies, base.joints, {}, forces, mechanism.gravity, mechanism.name)


def test_block_slides_up_and_sticks_for_ever():
    """Up the slope it decelerates by g (sin + mu cos); then it stays in its place, without creep, as mu > tan."""
    angle, coefficient = 0.2, 0.3
    deceleration = G * (np.sin(angle) + coefficient * np.cos(angle))
    stop = 2.0 / deceleration
    solution = udk.simulate(block(angle, 2.0, coefficient=coefficient), [0.0, stop / 2, stop + 1.0, 1000.0], **TOL)
    along = np.asarray(solution.q[:, 0, 0]) / np.cos(angle)
    np.testing.assert_allclose(along, stop * np.array([0.0, 0.75, 1.0, 1.0]), atol=1e-12)
    assert solution.settings["engine"] == "native"
    assert solution.sticking["S"].tolist() == [False, False, True, True]
    assert "S at 2 of 4 times" in str(solution)
    assert solution.events.of("S sticks") == pytest.approx([stop], abs=1e-12)


def test_a_stop_takes_few_calls_of_machine_code():
    """At the start: one state, one decision, the marks of rows, a run. At the stop as many, and a projection."""
    scene = block(0.2, 2.0, coefficient=0.3)
    with calls_of(PreparedCall.__call__) as calls:
        solution = udk.simulate(scene, [0.0, 2.0], **TOL)
    assert solution.events.counts["S sticks"] == 1 and len(calls) <= 9


@pytest.mark.parametrize("law", ["smooth", "set-valued"])
def test_friction_of_rest_below_that_of_sliding_is_refused(law):
    """Stribeck's curve falls from rest to sliding; a joint that sticks by less than it slides by could neither start nor stop."""
    rub = {"coefficient": 0.3, "static_coefficient": 0.2, "law": law}
    pattern = r'"rub" \(force\[0\]\)\.static_coefficient: must be at least the coefficient of sliding, 0\.3, not 0\.2'
    with pytest.raises(udk.SceneError, match=pattern):
        block(0.1, **rub)
    equal = block(0.1, **(rub | {"static_coefficient": 0.3}))
    with pytest.raises(udk.SceneError, match=pattern):
        equal.with_parameters({"force.rub.static_coefficient": 0.2})
    contact = udk.Contact("block", coefficient=0.3, static_coefficient=0.2)
    with pytest.raises(ValueError, match=r"block on ground.*static_coefficient: must be at least the coefficient of sliding"):
        udk.simulate(equal, [0.0, 0.1], events=contact)


def test_mistakes():
    """The set-valued law has no numbers of the smooth one; a law is one of the two."""
    for wrong, where in (({"speed": 0.1}, "speed"), ({"velocity": 0.1, "torque": 1.0}, "velocity"), ({"law": "coulomb"}, "law")):
        numbers: dict[str, Any] = {"coefficient": 0.1, "radius": 0.1, **STICKS} | wrong
        with pytest.raises(ValueError, match=where):
            udk.Mechanism(
                {"a": udk.Body(1.0, 1.0)},
                {"A": udk.Revolute(["ground", "a"], [[0.0, 0.0], [0.0, 0.0]])},
                forces={"rub": udk.Friction("A", **numbers)},
            )


def test_a_joint_that_sticks_has_one_friction():
    """Two would have one force between them, which the law does not share."""
    torque, more = udk.Friction("A", torque=1.0, **STICKS), udk.Friction("A", coefficient=0.1, radius=0.1, **STICKS)
    for second in (more, torque, udk.Friction("A", torque=1.0, velocity=0.1)):
        with pytest.raises(ValueError, match='joint: "A" has friction already, by force "one"'):
            udk.Mechanism(
                {"a": udk.Body(1.0, 1.0)},
                {"A": udk.Revolute(["ground", "a"], [[0.0, 0.0], [0.0, 0.0]])},
                forces={"one": torque, "two": second},
            )


@pytest.mark.slow
def test_block_turns_round():
    """With mu < tan it comes back with g (sin - mu cos)."""
    angle, coefficient = 0.6, 0.2
    up, down = (G * (np.sin(angle) + sign * coefficient * np.cos(angle)) for sign in (1, -1))
    solution = udk.simulate(block(angle, 2.0, coefficient=coefficient), [0.0, 2.0 / up, 2.0 / up + 1.0], **TOL)
    along = np.asarray(solution.q[:, 0, 0]) / np.cos(angle)
    np.testing.assert_allclose(along, [0.0, 2.0 / up, 2.0 / up - down / 2], atol=1e-11)
    assert solution.events.counts["S turns round"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "jax"])
def test_static_coefficient_holds_longer(engine):
    """A block at rest on an incline sticks up to its static coefficient."""
    for static, rests in ((0.29, True), (0.28, False)):
        mechanism = block(np.arctan(0.285), coefficient=0.1, static_coefficient=static)
        solution = udk.simulate(mechanism, [0.0, 1.0], engine=engine)
        assert bool(solution.sticking["S"][-1]) is rests
        fall = 0.0 if rests else G * np.cos(np.arctan(0.285)) * (0.285 - 0.1) / 2
        assert np.linalg.norm(solution.q[-1, 0, :2]) == pytest.approx(fall, abs=1e-9)


@pytest.mark.slow
def test_oscillator_stops_within_the_dead_band():
    """The amplitude falls by 4 mu m g / k in a period; the block stops where the spring is weaker than friction."""
    half, places = np.pi / np.sqrt(100.0 / 2.0), turns(0.5, 0.1 * 2.0 * G / 100.0)
    ts = np.append(half * np.arange(len(places)), 1000.0)
    solution = udk.simulate(oscillator(), ts, **TOL)
    np.testing.assert_allclose(solution.q[:, 0, 0], [*places, places[-1]], atol=1e-10)
    assert solution.events.counts["S turns round"] == len(places) - 2
    np.testing.assert_allclose(solution.events.time, half * np.arange(1, len(places)), atol=1e-10)


@pytest.mark.slow
def test_belt_makes_a_limit_cycle():
    """The block sticks to the belt until the spring is as strong as static friction, and slips back to 2 x_d - x_s."""
    static, sliding, k, m, v = 0.5, 0.3, 100.0, 1.0, 0.2
    omega, last, middle = np.sqrt(k / m), static * m * G / k, sliding * m * G / k
    slip = (2 * np.pi - 2 * np.arctan2(last - middle, v / omega)) / omega
    stick = 2 * (last - middle) / v
    starts = last / v + (slip + stick) * np.arange(15)
    solution = udk.simulate(belt(static, sliding, k, m, v), [0.0, *starts], **TOL)
    np.testing.assert_allclose(solution.q[1:, 1, 0], last, atol=1e-10)
    np.testing.assert_allclose(solution.events.of("S slips"), starts[:-1], atol=1e-10)
    np.testing.assert_allclose(solution.events.of("S sticks"), starts[:-1] + slip, atol=1e-10)


@pytest.mark.slow
def test_pendulum_stops_away_from_the_bottom():
    """A thick pin holds the pendulum where its torque is below mu r m g; reference: SciPy, with the force on the pin."""
    m, length, inertia, radius, coefficient = 2.0, 0.5, 0.03 + 2.0 * 0.5**2, 0.1, 0.5

    def acceleration(angle: float, omega: float, sign: float) -> float:
        alpha = 0.0
        for _ in range(60):  # a contraction
            along = -m * length * omega**2 + m * G * np.sin(angle)
            across = m * length * alpha + m * G * np.cos(angle)
            alpha = (-m * G * length * np.cos(angle) - sign * coefficient * radius * np.hypot(along, across)) / inertia
        return alpha

    t, state, sign, times = 0.0, [0.0, 0.0], -1.0, []
    while True:
        stop = lambda _, y: y[1]  # noqa: E731
        stop.terminal, stop.direction = True, -sign
        rate = lambda _, y, sign=sign: [y[1], acceleration(y[0], y[1], sign)]  # noqa: E731
        found = solve_ivp(rate, (t, t + 10.0), state, "DOP853", events=stop, rtol=1e-12, atol=1e-12)
        t, state, sign = float(found.t[-1]), [float(found.y[0, -1]), 0.0], -sign
        times.append(t)
        if length * abs(np.cos(state[0])) < coefficient * radius:
            break
    solution = udk.simulate(pendulum(coefficient=coefficient, radius=radius, **STICKS), [0.0, t, 1000.0], **TOL)
    assert abs(state[0] + np.pi / 2) > 0.01
    np.testing.assert_allclose(solution.q[1:, 0, 2], state[0], atol=1e-9)
    np.testing.assert_allclose(solution.events.time, times, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["four_bar", "slider_crank", "double_pendulum"])
def test_energy_falls_until_all_joints_stick(name):
    """With friction in all joints; those of a closed chain lock each other."""
    mechanism, ts = sticking(getattr(udk.library, name)()), np.linspace(0.0, 40.0, 401)
    solution = udk.simulate(mechanism, ts, rtol=1e-9, atol=1e-9)
    energy = np.asarray(udk.energy(mechanism, solution).total)
    assert np.all(np.diff(energy) < 1e-12 * np.abs(energy).max())
    assert all(bool(x[-1]) for x in solution.sticking.values())
    assert np.abs(solution.v[-1]).max() < 1e-12
    assert solution.settings["engine"] == "native"


@pytest.mark.slow
def test_lanes_equal_single_runs():
    mechanism, ts = oscillator(), [0.0, 1.0, 50.0]

    def places(coefficient):
        return udk.simulate(mechanism.with_parameters({"force.rub.coefficient": coefficient}), ts, **TOL).q[:, 0, 0]

    coefficients = jnp.linspace(0.05, 0.3, 7)
    np.testing.assert_allclose(jax.vmap(places)(coefficients), jnp.stack([places(x) for x in coefficients]), atol=1e-12)


@pytest.mark.slow
def test_derivatives_pass_through_stick_and_slip():
    """In motion against differences; of the last place against the closed form x = +-(x0 - 2 n mu m g / k)."""
    mechanism = oscillator()

    def place(x, t):
        numbers = {
            "force.rub.coefficient": x[0],
            "force.spring.stiffness": x[1],
            "body.block.position": jnp.stack([x[2], 0.0 * x[2]]),
        }
        return udk.simulate(mechanism.with_parameters(numbers), [0.0, t], **TOL).q[-1, 0, 0]

    at, steps = jnp.array([0.1, 100.0, 0.5]), np.array([1e-6, 1e-3, 1e-6])
    moving = jax.grad(place)(at, 1.1)
    np.testing.assert_allclose(jax.jacfwd(place)(at, 1.1), moving, rtol=1e-10)
    differences = [(place(at + step, 1.1) - place(at - step, 1.1)) / (2 * step.max()) for step in np.diag(steps)]
    np.testing.assert_allclose(moving, differences, rtol=1e-6)
    n = len(turns(0.5, 0.1 * 2.0 * G / 100.0)) - 1
    sign = -((-1) ** n)
    closed = [sign * 2 * n * 2.0 * G / 100.0, -sign * 2 * n * 0.1 * 2.0 * G / 100.0**2, -sign]
    np.testing.assert_allclose(jax.grad(place)(at, 100.0), closed, rtol=1e-9)
    np.testing.assert_allclose(jax.jacfwd(place)(at, 100.0), closed, rtol=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_stick_slip_cycle():
    """From stick to slip and back, with respect to both coefficients, the spring and the belt."""
    mechanism = belt(0.5, 0.3, 100.0, 1.0, 0.2)

    def place(x):
        numbers = {"force.rub.static_coefficient": x[0], "force.rub.coefficient": x[1], "force.spring.stiffness": x[2]}
        return udk.simulate(mechanism.with_parameters(numbers), [0.0, 1.1], **TOL).q[-1, 1, 0]

    at, steps = jnp.array([0.5, 0.3, 100.0]), np.array([1e-6, 1e-6, 1e-3])
    gradient = jax.grad(place)(at)
    np.testing.assert_allclose(jax.jacfwd(place)(at), gradient, rtol=1e-9)
    differences = [(place(at + step) - place(at - step)) / (2 * step.max()) for step in np.diag(steps)]
    np.testing.assert_allclose(gradient, differences, rtol=1e-5)


def test_a_held_force_that_grows_past_the_limit():
    """A block rests under 3 N, slides under 7 N, and stops without a force: its samples are those of the state's time."""
    steps = udk.Held([[3.0, 0.0], [7.0, 0.0], [0.0, 0.0]], 0.5)
    base = block(0.0, coefficient=0.5)
    mechanism = udk.Mechanism(base.bodies, base.joints, {}, {**base.forces, "pull": udk.Force("block", steps)})
    a, drag = 7.0 - 0.5 * G, 0.5 * G
    solution = udk.simulate(mechanism, [0.0, 0.5, 1.0, 5.0], **TOL)
    np.testing.assert_allclose(solution.q[:, 0, 0], [0.0, 0.0, a / 8, a / 8 + (a / 2) ** 2 / (2 * drag)], atol=1e-11)
    assert solution.settings["engine"] == "native"
    assert solution.events.of("S slips") == pytest.approx([0.5], abs=1e-11)
    assert solution.events.of("S sticks") == pytest.approx([1.0 + a / 2 / drag], abs=1e-11)


@pytest.mark.slow
def test_a_joint_that_an_event_locks_under_a_held_force():
    base = udk.Mechanism({"block": udk.Body(1.0, 0.01)}, {"S": udk.Prismatic(["ground", "block"], [[0.0, 0.0], [0.0, 0.0]], 0.0)})
    pull = udk.Force("block", udk.Held([[1.0, 0.0], [2.0, 0.0]], 0.5))
    mechanism = udk.Mechanism(base.bodies, base.joints, {}, {"pull": pull})
    lock = udk.Event(lambda t, at: t - 0.75, udk.Lock("S"), name="lock")
    solution = udk.simulate(mechanism, [0.0, 0.75, 1.0], events=lock, **TOL)
    assert solution.settings["engine"] == "native"
    np.testing.assert_allclose(solution.q[:, 0, 0], [0.0, 0.125 + 0.125 + 0.0625, 0.3125], atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["four_bar", "double_pendulum"])
def test_a_held_force_on_joints_that_stick(name):
    """As a torque of the same values between the same times, by pieces of a run each with a constant torque."""
    still = sticking(getattr(udk.library, name)())
    body = still.body_names[0]

    def with_torque(value) -> udk.Mechanism:
        forces = {**still.forces, "motor": udk.Torque(["ground", body], value)}
        return udk.Mechanism(still.bodies, still.joints, {}, forces, still.gravity, still.name)

    values, state = np.random.default_rng(1).normal(0.0, 20.0, 6), None  # the motion is chaotic: each piece is compared by itself
    ts = np.linspace(0.0, 3.0, 31)
    found = udk.simulate(with_torque(udk.Held(values, 0.5)), ts, **TOL)
    assert found.settings["engine"] == "native"
    for k, value in enumerate(values):
        part = udk.simulate(with_torque(value), ts[5 * k : 5 * k + 6], state, **TOL)
        np.testing.assert_allclose(found.q[5 * k : 5 * k + 6], part.q, atol=1e-8)
        state = udk.State(found.q[5 * k + 5], found.v[5 * k + 5])


@pytest.mark.slow
def test_with_events():
    """A joint limit throws the block back; a released joint takes its friction with it."""
    wall = udk.JointLimit("S", lower=-0.2, restitution=0.5)
    solution = udk.simulate(oscillator(), np.linspace(0.0, 50.0, 201), events=wall, **TOL)
    assert solution.events.counts["S.lower"] > 0
    assert bool(solution.sticking["S"][-1])
    assert np.all(np.diff(udk.energy(oscillator(), solution).total) < 1e-12)
    release = udk.Event(lambda t, at: t - 2.0, udk.Release("S"), name="off")
    still = block(0.2, coefficient=0.3)
    fall = udk.simulate(still, [0.0, 2.0, 3.0], events=release, **TOL)
    np.testing.assert_allclose(fall.q[-1, 0, :2], [0.0, -G / 2], atol=1e-10)


@pytest.mark.slow
def test_constant_torque_sticks():
    """A flywheel under a constant torque of friction stops after I omega / torque, and stays."""
    mechanism = udk.Mechanism(
        {"wheel": udk.Body(1.0, 0.5, angular_velocity=3.0)},
        {"A": udk.Revolute(["ground", "wheel"], [[0.0, 0.0], [0.0, 0.0]])},
        forces={"rub": udk.Friction("A", torque=0.2, **STICKS)},
    )
    solution = udk.simulate(mechanism, [0.0, 1.0, 100.0], **TOL)
    stop = 0.5 * 3.0 / 0.2
    np.testing.assert_allclose(solution.q[:, 0, 2], [0.0, 3.0 - 0.2, 3.0 * stop / 2], atol=1e-11)
    assert solution.events.of("A sticks") == pytest.approx([stop], abs=1e-11)


@pytest.mark.slow
def test_a_driven_joint_begins_to_slide_with_its_driver():
    """A crank that is driven from rest, without a jump of its acceleration, and a bob that sticks to it at first."""
    mechanism = udk.Mechanism(
        {"crank": udk.Body(1.0, 0.1, [0.25, 0.0]), "bob": udk.Body(1.0, 0.05, [0.5, -0.3])},
        {
            "A": udk.Revolute(["ground", "crank"], [[0.0, 0.0], [-0.25, 0.0]]),
            "B": udk.Revolute(["crank", "bob"], [[0.25, 0.0], [0.0, 0.3]]),
        },
        {"motor": udk.Driver(["ground", "crank"], "angle", udk.Polynomial([0.0, 0.0, 0.0, 1.0, -0.4]))},
        {name: udk.Friction(name, coefficient=0.3, radius=0.05, **STICKS) for name in "AB"},
    )
    solution = udk.simulate(mechanism, np.linspace(0.0, 2.5, 26), **TOL)
    assert solution.events.of("A slips") == pytest.approx([0.0], abs=1e-9)
    assert solution.events.of("A turns round") == pytest.approx([1.875], abs=1e-9)  # where the rate of the driver is zero
    assert solution.events.of("B slips")[0] > 0.1
    assert solution.settings["engine"] == "native"


class Bumper(udk.ForceElement):
    """A stiff spring (N/m) with a damper (N s/m), which a point below 0.3 m compresses."""

    stiffness: float
    damping: Any

    def loads(self, t, *frames):
        depth = -0.3 - frames[0].y
        return [(0.0, jnp.where(depth > 0.0, self.stiffness * depth - self.damping * frames[0].vy, 0.0), 0.0)]


@pytest.mark.parametrize("solver", [None, diffrax.Kvaerno5()])
@pytest.mark.parametrize("damping", [1e4, 1e5, 1e6])
def test_a_joint_that_creeps_into_a_stiff_bumper_does_not_reverse_again_and_again(damping, solver):
    """Its speed decays to errors of the steps, which are no reversals; the rod comes to rest within the friction of its pin."""
    mu, radius, along = 0.2, 0.02, np.sqrt(1 - 0.2**2)
    bodies = {
        "rod": udk.Body(1.0, 1 / 12, position=[0.5 * along, -0.1], angle=np.arcsin(-0.2)),
        "tip": udk.Body(0.5, 0.01, position=[along, -0.2]),
    }
    joints = {
        "A": udk.Revolute(["ground", "rod"], [[0.0, 0.0], [-0.5, 0.0]]),
        "B": udk.Revolute(["rod", "tip"], [[0.5, 0.0], [0.0, 0.0]]),
    }
    forces = {
        "rub": udk.Friction("A", coefficient=mu, radius=radius, law="set-valued"),
        "bumper": Bumper(["tip"], 1e7, jnp.asarray(damping)),
    }
    chosen = {} if solver is None else {"solver": solver}
    run = udk.simulate(udk.Mechanism(bodies, joints, forces=forces), [0.0, 4.0], **chosen)
    assert run.events.counts["A turns round"] <= 2
    assert len(run.events.unresolved) == 0
    # About the pin, with the arm sqrt(1 - 0.3^2) m of the bumper: its force less the weights, at most mu r |R|.
    force, weight, arm = 1e7 * (-0.3 - run.q[-1, 1, 1]), 9.81 * 1.5, np.sqrt(1 - 0.3**2)
    assert abs(arm * (force - 9.81 * 1.0)) <= mu * radius * (weight - force) * (1 + 1e-3)


class Dwell(udk.Motion):
    """Turns by one radian in the first second, rests for half a second, and turns back."""

    def __call__(self, t):
        def rise(x):
            return x**3 * (10 - 15 * x + 6 * x**2)

        return 0.5 + rise(jnp.clip(t, 0.0, 1.0)) - rise(jnp.clip(t - 1.5, 0.0, 1.0))

    @property
    def breakpoints(self):
        return [0.0, 1.0, 1.5, 2.5]


def dwelling_slider_crank(motion: udk.Motion, coefficient: Any = 0.2, crank: float = 0.5) -> udk.Mechanism:
    """Return a slider-crank, driven at the crank, with friction in slide and pin."""
    c, s = np.cos(crank), np.sin(crank)
    d = np.sqrt(4 - s**2)
    return udk.Mechanism(
        {
            "crank": udk.Body(1.0, 0.1, [c / 2, s / 2], crank),
            "rod": udk.Body(1.0, 0.1, [c + d / 2, s / 2], -np.arcsin(s / 2)),
            "slider": udk.Body(1.0, 0.1, [c + d, 0.0]),
        },
        {
            "A": udk.Revolute(["ground", "crank"], [[0.0, 0.0], [-0.5, 0.0]]),
            "B": udk.Revolute(["crank", "rod"], [[0.5, 0.0], [-1.0, 0.0]]),
            "C": udk.Revolute(["rod", "slider"], [[1.0, 0.0], [0.0, 0.0]]),
            "S": udk.Prismatic(["ground", "slider"], [[0.0, 0.0], [0.0, 0.0]], 0.0),
        },
        {"motor": udk.Driver(["ground", "crank"], "angle", motion)},
        {
            "slide": udk.Friction("S", coefficient=coefficient, **STICKS),
            "pin": udk.Friction("B", coefficient=coefficient, radius=0.05, **STICKS),
        },
    )


DWELL_TIMES = np.array([0.5, 0.9, 1.1, 1.2, 1.4, 1.6, 2.0, 2.6, 3.0])


@pytest.mark.parametrize("engine", ["native", pytest.param("diffrax", marks=pytest.mark.slow)])
def test_a_joint_that_a_driver_holds_at_rest_sticks(engine):
    """Its speed becomes zero and stays there without a change of sign; one that only turns round does not stick."""
    rests = (DWELL_TIMES > 1.0) & (DWELL_TIMES < 1.5) | (DWELL_TIMES > 2.5)
    run = udk.simulate(dwelling_slider_crank(Dwell()), [0.0, *DWELL_TIMES], engine=engine)
    for joint in ("S", "B"):
        np.testing.assert_array_equal(run.sticking[joint][1:], rests, err_msg=joint)
    turning = udk.simulate(dwelling_slider_crank(udk.Polynomial([-0.5, 1.0]), crank=-0.5), [0.0, 0.4, 0.5, 0.6], engine=engine)
    assert not turning.sticking["S"].any() and not turning.sticking["B"].any()  # at 0.5 s the slide turns round


class SlowStart(udk.Motion):
    """Begins to move with t^3; at its breakpoint the speed still counts as zero along a run, but no longer in a state."""

    def __call__(self, t):
        return t**3

    @property
    def breakpoints(self):
        return [1e-5]


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_joint_that_a_driver_moves_slowly_slips_after_a_breakpoint(engine):
    """A window that ends while the speed is still within the tolerance does not take the event away."""
    slide = block(0.0, coefficient=0.3)
    at_origin = [[0.0, 0.0], [0.0, 0.0]]
    slide = udk.Mechanism(
        slide.bodies, slide.joints, {"motor": udk.Driver(["ground", "block"], "x", SlowStart(), at_origin)}, slide.forces
    )
    run = udk.simulate(slide, [0.0, 0.05, 0.1], engine=engine)
    assert run.sticking["S"].tolist() == [True, False, False]
    assert [run.events.names[int(k)] for k in run.events.index] == ["S slips"]


def test_joints_that_drivers_hold_stick_in_lanes():
    @jax.jit
    @jax.vmap
    def sticking(coefficient):
        return udk.simulate(dwelling_slider_crank(Dwell(), coefficient), DWELL_TIMES - 0.45).sticking["S"]

    times = DWELL_TIMES - 0.45
    rests = (times > 1.0) & (times < 1.5) | (times > 2.5)
    np.testing.assert_array_equal(sticking(jnp.array([0.1, 0.2]))[:, 1:], [rests[1:]] * 2)
