"""Knife edges and wheels: sleighs and carts against closed formulas and an integration of their own by SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import udkjax as udk
from tests.choices import fast
from udkjax.programs.deferred import deferred

A, M, J = 0.3, 2.0, 0.1  # distance of the edge behind the centre (m), mass (kg), inertia (kg m^2)
SPEED, SPIN = 0.8, 1.5  # at the start, of the edge (m/s) and of the sleigh (rad/s)


def sleigh(unit=1.0, **more):
    body = udk.Body(M, J * unit**2, [0.0, 0.0], 0.0, [SPEED * unit, A * SPIN * unit], SPIN)
    return udk.Mechanism(
        {"sleigh": body}, {"edge": udk.KnifeEdge(["ground", "sleigh"], [-A * unit, 0.0], 0.0)}, gravity=(0, 0), **more
    )


def by_scipy(ts, a=A, inertia=J, force=0.0):
    """The motion of Chaplygin's sleigh: u' = a omega^2 + f / M, (J + M a^2) omega' = -M a u omega."""

    def rates(t, y):
        u, omega, angle, *_ = y
        v = a * omega
        place = u * np.cos(angle) - v * np.sin(angle), u * np.sin(angle) + v * np.cos(angle)
        return [a * omega**2 + force / M, -M * a * u * omega / (inertia + M * a * a), omega, *place]

    found = solve_ivp(rates, (0, ts[-1]), [SPEED, SPIN, 0, 0, 0], "DOP853", ts, rtol=1e-12, atol=1e-13).y
    return np.stack([found[3], found[4], found[2]], 1)


def cart(unit=1.0, torques=(0.3, 0.5)):
    """A cart with two driven wheels, seen from above; each rim turns on a pin of the ground."""
    bodies = {"cart": udk.Body(10.0, 0.8 * unit**2, [0, 0], 0.3)}
    joints, forces = {}, {}
    for name, side, torque in (("left", 1, torques[0]), ("right", -1, torques[1])):
        bodies[name] = udk.Body(1.0, 0.02 * unit**2, [0, side * unit])
        joints[f"axle {name}"] = udk.Revolute(["ground", name], [[0, side * unit], [0, 0]])
        joints[name] = udk.Wheel(["ground", "cart"], [0, side * 0.2 * unit], 0.0, ["ground", name], 0.1 * unit)
        forces[f"motor {name}"] = udk.Torque(["ground", name], torque * unit**2)
    return udk.Mechanism(bodies, joints, forces=forces, gravity=(0, 0))


@pytest.mark.parametrize("engine", ["native", "diffrax"])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e3])
def test_a_sleigh_moves_as_chaplygin_says(engine, unit):
    ts, mech = np.linspace(0.0, 3.0, 7), sleigh(unit)
    assert udk.analyse(mech).degrees_of_freedom == 2 and udk.analyse(mech).redundant == ()
    found = udk.simulate(mech, ts, engine=engine, rtol=1e-10, atol=1e-10)
    wanted = by_scipy(ts) * [unit, unit, 1.0]
    assert_allclose(found.q[:, 0, :2], wanted[:, :2], atol=2e-9 * unit)
    assert_allclose(found.q[:, 0, 2], wanted[:, 2], atol=2e-9)
    assert np.ptp(udk.energy(mech, found).total) < 1e-9 * unit**2
    assert np.abs(udk.violation(mech, found)).max() < 1e-14 * unit


METHODS = {
    **{type(x).__name__: {"method": x} for x in (udk.SVD(), udk.Elimination(), udk.Greville())},
    **{type(x).__name__: {"formulation": x} for x in (udk.Augmented(), udk.NullSpaceQR(), udk.CoordinatePartitioning())},
    **{type(x).__name__: {"stabilization": x} for x in (udk.Baumgarte(),)},
    **{type(x).__name__: {"solver": x} for x in (udk.Verner65(), udk.Adams())},
}


@pytest.mark.parametrize("name", [pytest.param(x, marks=[] if x in ("SVD", "Augmented") else pytest.mark.slow) for x in METHODS])
def test_every_method_moves_it_alike(name):
    ts = np.linspace(0.0, 2.0, 3)
    found = udk.simulate(sleigh(), ts, rtol=1e-10, atol=1e-10, **METHODS[name])
    assert_allclose(found.q[:, 0], by_scipy(ts), atol=1e-8)


@pytest.mark.parametrize("engine", fast(["native"], ["native", "diffrax"]))
def test_derivatives_pass_across_the_edge(engine):
    """Neighbouring motions need not obey the edge: they turn another way, and end beside it."""

    def end(p):
        mech = sleigh().with_parameters({"joint.edge.point": jnp.stack([-p[0], 0.0]), "body.sleigh.inertia": p[1]})
        state = udk.State(
            [[0.0, 0.0, 0.0]],
            [[SPEED, p[0] * SPIN, SPIN]] if isinstance(p, list) else jnp.stack([jnp.stack([SPEED, p[0] * SPIN, SPIN])]),
        )
        return udk.simulate(mech, [0.0, 2.0], state, rtol=1e-11, atol=1e-11, engine=engine).q[-1, 0]

    p, ts, h = jnp.array([A, J]), np.array([0.0, 2.0]), 1e-4
    steps = h * np.eye(2)
    wanted = np.stack([(by_scipy(ts, *(p + d))[-1] - by_scipy(ts, *(p - d))[-1]) / (2 * h) for d in steps], 1)
    forward, reverse = deferred(lambda p: (jax.jacfwd(end)(p), jax.jacrev(end)(p)))(p)
    assert_allclose(forward, wanted, atol=2e-6)
    assert_allclose(reverse, forward, atol=1e-7)
    if engine == "native":
        second = deferred(lambda p: jax.jvp(jax.jacrev(end), (p,), (jnp.array([1.0, 0.0]),))[1])(p)[:, 0]
        around = [by_scipy(ts, A + k * 1e-3, J)[-1] for k in (-1, 0, 1)]
        assert_allclose(second, (around[0] - 2 * around[1] + around[2]) / 1e-6, rtol=1e-3)
        lanes = jax.jit(jax.vmap(end))(jnp.array([[A, J], [0.2, 0.3]]))
        assert_allclose(lanes, [by_scipy(ts, *x)[-1] for x in ([A, J], [0.2, 0.3])], atol=1e-8)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e3])
def test_a_cart_is_driven_by_its_two_wheels(unit):
    mech = cart(unit)
    analysis = udk.analyse(mech)
    assert analysis.degrees_of_freedom == 2 and analysis.redundant == (("right", 0),)  # two edges in line
    push, turn = 0.8 / 0.1 / (10 + 2 * 0.02 / 0.1**2), 0.2 / 0.1 * 0.2 / (0.8 + 2 * 0.02 * 0.2**2 / 0.1**2)
    end = udk.simulate(mech, [0.0, 2.0])
    vx, vy, omega = np.asarray(end.v[-1, 0])
    assert_allclose([np.hypot(vx, vy), omega], [2 * push * unit, 2 * turn], rtol=1e-8)
    assert_allclose(np.arctan2(vy, vx), float(end.q[-1, 0, 2]), atol=1e-9)
    loads = udk.reactions(mech, end, frame="joint")
    forward = sum(float(loads[name]["cart"][-1, 0]) for name in ("left", "right"))
    assert_allclose(forward, 10 * push * unit, rtol=1e-7)


def test_a_steered_wheel_leads_a_tricycle_on_a_circle():
    wheelbase, steering = 0.5, 0.4
    bodies = {"frame": udk.Body(5.0, 0.5, [0.2, 0.0], 0.0, [1.0, 0.0]), "fork": udk.Body(0.5, 0.01, [wheelbase, 0.0], steering)}
    joints = {
        "rear": udk.KnifeEdge(["ground", "frame"], [-0.2, 0.0], 0.0),
        "head": udk.Revolute(["frame", "fork"], [[wheelbase - 0.2, 0.0], [0.0, 0.0]]),
        "front": udk.KnifeEdge(["ground", "fork"], [0.0, 0.0], 0.0),
    }
    bars = {"bars": udk.Driver(["frame", "fork"], "angle", udk.Polynomial([steering]))}
    mech = udk.Mechanism(bodies, joints, bars, gravity=(0, 0))
    assert udk.analyse(mech).degrees_of_freedom == 1
    start = udk.assemble(mech, given={"body.frame(-0.2, 0).vx": 1.0})
    found = udk.simulate(mech, np.linspace(0.0, 2.0, 9), start, rtol=1e-10, atol=1e-10)
    assert_allclose(found.v[:, 0, 2], np.tan(steering) / wheelbase, rtol=1e-8)  # at constant speed
    rear = np.asarray(udk.path(mech, found, "frame", (-0.2, 0.0)))
    centre = np.array([0.0, wheelbase / np.tan(steering)])
    assert_allclose(np.hypot(*(rear - centre).T), wheelbase / np.tan(steering), rtol=1e-8)


def test_positions_are_closed_as_if_there_were_no_edge():
    """The guess is off its rail across the edge, which forbids no position."""
    joints = {
        "rail": udk.Slot(["ground", "sled"], np.zeros((2, 2)), axis=0.0),
        "edge": udk.KnifeEdge(["ground", "sled"], [0.0, 0.0], 0.0),
    }
    mech = udk.Mechanism({"sled": udk.Body(1.0, 0.1, [0.3, 0.2], 0.1, [1.0, 0.5], 0.2)}, joints)
    state = udk.assemble(mech)
    assert_allclose(state.q[0, :2], [0.3, 0.0], atol=1e-12)
    assert_allclose(state.v[0], [0.0, 0.0, 0.2], atol=1e-12)  # the slot leaves x, the edge its own direction: both forbid to move
    moved = jax.jit(jax.jacfwd(lambda x: udk.assemble(mech.with_parameters({"body.sled.position": x})).q[0]))(
        jnp.array([0.3, 0.2])
    )
    assert_allclose(moved, [[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]], atol=1e-9)


def test_an_edge_is_released_by_an_event():
    lift = udk.Event(lambda t, frames: t - 1.0, udk.Release("edge"), name="lift")
    found = udk.simulate(sleigh(), [0.0, 1.0, 2.0], events=[lift], rtol=1e-10, atol=1e-10)
    free = np.asarray(found.v[1, 0])
    assert_allclose(found.q[1, 0], by_scipy(np.array([0.0, 1.0]))[-1], atol=1e-8)
    assert_allclose(found.q[2, 0], found.q[1, 0] + free, atol=1e-8)  # it slides on without any force


@pytest.mark.parametrize(
    ("call", "what"),
    [
        (lambda mech: udk.kinematics(mech, "body.sleigh.angle", [0.0, 1.0]), "a driver"),
        (lambda mech: udk.travel(mech, "body.sleigh.angle"), "a driver"),
        (lambda mech: udk.branches(mech, "body.sleigh.angle", 0.0), "a driver"),
        (udk.equilibrium, "equilibrium"),
        (udk.equilibria, "equilibrium"),
        (lambda mech: udk.modes(mech, udk.State(mech.q0, 0 * mech.v0)), "modes"),
        (udk.mjcf_text, "knifeedge"),
    ],
)
def test_functions_of_positions_refuse_an_edge_by_name(call, what):
    with pytest.raises(udk.SceneError, match=f"{what}.*edge|edge.*{what}"):
        call(sleigh())
