"""Causes of failed runs are stated correctly: each is compared with what is known about the scene."""

import pickle
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast
from udkjax import Result
from udkjax.equations.systems.function_causes import cause_of

CRANK, COUPLER, ROCKER, GROUND = 1.0, 1.5, 1.2, 2.2  # not Grashof's: the crank has limits
START = np.pi / 3
TOGGLE = np.arccos((CRANK**2 + GROUND**2 - (COUPLER + ROCKER) ** 2) / (2 * CRANK * GROUND))
TS = np.linspace(0.0, 1.0, 11)


def four_bar(scale=1.0, **drivers):
    lengths = tuple(scale * x for x in (CRANK, COUPLER, ROCKER))
    mech = udk.library.four_bar(START, lengths=lengths, ground=scale * GROUND)
    driven = {n: udk.Driver(["ground", "crank"], "angle", udk.Polynomial(c)) for n, c in drivers.items()}
    return udk.Mechanism(dict(mech.bodies), dict(mech.joints), driven, gravity=mech.gravity)


def failed(mech, ts=TS, *arguments, **choices):
    solution = udk.simulate(mech, ts, *arguments, throw=False, **choices)
    assert not solution.result.is_success
    return solution


class Push(udk.ForceElement):
    """A force along x by a law of time and velocity."""

    law: Callable = eqx.field(static=True)

    def loads(self, t, frame):
        return [(self.law(t, frame), 0.0, 0.0)]


def stone(law):
    return udk.Mechanism({"stone": udk.Body(1.0, 1.0, [0.3, 0.2], 0.1, [1.0, 0.5], 0.2)}, forces={"wind": Push("stone", law)})


@pytest.mark.parametrize(
    ("scale", "choices", "ts"),
    [
        (1.0, {}, TS),
        (1e-6, {}, TS),
        (1e3, {}, [0.0, 0.9]),  # long after it
        (1.0, {"stabilization": None}, TS),
    ],
)
def test_a_driver_beyond_the_reach_of_its_linkage(scale, choices, ts):
    solution = failed(four_bar(scale, motor=[START, 2.0]), ts, **choices)
    assert 'driver "motor" asks for' in solution.cause
    assert f"the linkage reaches {TOGGLE:.5g}" in solution.cause.replace(f"{TOGGLE:.6g}", f"{TOGGLE:.5g}")
    assert f"at {(TOGGLE - START) / 2:.4g}" in solution.cause and "pins B, C, D in line" in solution.cause
    assert "Projection" not in solution.cause


@pytest.mark.slow
def test_a_dead_point_without_pins_in_line(scale=1e-6):
    """The coupler ends at the middle of a rod whose ends slide on perpendicular lines: on a circle, as with a rocker."""
    plain = four_bar(scale)
    joints = {name: plain.joints[name] for name in "AB"}
    bodies = {name: plain.bodies[name] for name in ("crank", "coupler")}
    middle, corner = np.array(plain.joints["C"].points[0]), scale * np.array([GROUND, 0.0])
    x, y, angle = udk.assemble(plain).q[1]
    c, s = np.cos(angle), np.sin(angle)
    C = np.array([x, y]) + np.array([[c, -s], [s, c]]) @ middle
    across, up = C - corner
    bodies["rod"] = udk.Body(scale, scale**3, C, np.arctan2(-up, across))
    bodies["block"] = udk.Body(scale, scale**3, corner + [2 * across, 0.0])
    joints["C"] = udk.Revolute(["coupler", "rod"], [middle, [0.0, 0.0]])
    joints["E"] = udk.Revolute(["rod", "block"], [[scale * ROCKER, 0.0], [0.0, 0.0]])
    joints["line"] = udk.Prismatic(["ground", "block"], [corner, [0.0, 0.0]], axis=0.0)
    joints["other line"] = udk.Slot(["ground", "rod"], [corner, [-scale * ROCKER, 0.0]], axis=np.pi / 2)
    motor = udk.Driver(["ground", "crank"], "angle", udk.Polynomial([START, 2.0]))
    cause = failed(udk.Mechanism(bodies, joints, {"motor": motor}, gravity=plain.gravity)).cause
    assert f"the linkage reaches {TOGGLE:.5g}" in cause.replace(f"{TOGGLE:.6g}", f"{TOGGLE:.5g}")
    assert "in line" not in cause and "a dead point of A, B, C, E, line, other line" in cause, cause


def test_a_run_does_not_go_on_beyond_the_reach_of_its_linkage():
    """After a full turn the motion would be within reach again, but no motion leads there."""
    solution = failed(four_bar(motor=[START, 3.0]), np.array([0.0, 2 * np.pi / 3]), rtol=1e-6, atol=1e-6)
    assert solution.result == udk.Result.drift
    assert float(solution.time) == pytest.approx((TOGGLE - START) / 3.0, rel=1e-2)
    assert "the linkage reaches" in solution.cause and solution.stats["steps"] < 2000


def test_the_reach_of_a_length_and_the_error_of_a_run():
    """A cylinder moves the ends of two links of 1 m apart: they are in line at 2 m."""
    link = lambda angle, at: udk.Body(1.0, 0.1, at, angle)  # noqa: E731
    tip = np.array([np.cos(1.0), np.sin(1.0)])
    bodies = {"a": link(1.0, tip / 2), "b": link(-1.0, tip * [1.5, 0.5])}
    joints = {
        "P": udk.Revolute(["ground", "a"], [[0.0, 0.0], [-0.5, 0.0]]),
        "Q": udk.Revolute(["a", "b"], [[0.5, 0.0], [-0.5, 0.0]]),
        "R": udk.Slot(["ground", "b"], [[0.0, 0.0], [0.5, 0.0]], axis=0.0),
    }
    ends = [[0.0, 0.0], [0.5, 0.0]]
    ram = udk.Driver(["ground", "b"], "distance", udk.Polynomial([2 * np.cos(1.0), 1.5]), ends)
    with pytest.raises(udk.SimulationError, match=r'"ram" asks for 2\.\d+ m at .*; the linkage reaches 2 m, at 0\.61') as caught:
        udk.simulate(udk.Mechanism(bodies, joints, {"ram": ram}), TS)
    assert caught.value.solution.result in (Result.drift, Result.step_too_small)


def test_drivers_that_contradict_each_other():
    later = failed(four_bar(one=[START, 0.2], two=[START, 0.2, 0.5]))
    assert 'drivers "one" and "two" contradict each other' in later.cause
    with pytest.raises(udk.AssemblyError, match=r'drivers "one" and "two" contradict each other: remove one'):
        udk.simulate(four_bar(one=[START, 0.2], two=[START, 0.4]), TS)
    with pytest.raises(udk.AssemblyError, match=r'Without drivers it closes: driver "one" asks for 9 rad at 0 s, and is at 1\.0'):
        udk.simulate(four_bar(one=[9.0, 0.2]), TS)


@pytest.mark.parametrize("events", [None, pytest.param(udk.JointLimit("pin", upper=9.0), marks=pytest.mark.slow)])
def test_initial_states_that_are_open_or_not_finite(pendulum, events):
    """They are reported for a single run and in a batch."""
    state = udk.assemble(pendulum)
    q = jnp.stack([state.q, state.q.at[0, 0].add(0.1), state.q.at[0, 1].set(jnp.nan), state.q])
    v = jnp.stack([state.v, state.v, state.v, state.v.at[0, 2].set(jnp.inf)])
    codes = [Result.successful, Result.initial_state_open, Result.invalid_argument, Result.invalid_argument]
    run = lambda q, v: udk.simulate(pendulum, TS, udk.State(q, v), events=events)  # noqa: E731
    batch = jax.jit(jax.vmap(run))(q, v)
    assert batch.code.tolist() == codes and np.all(batch.time[1:] == 0.0)
    single = failed(pendulum, TS, udk.State(q[1], v[1]), events=events)
    assert 'the initial state is open (m, rad): "pin" (0.1)' in single.cause


def test_an_open_state_of_a_system_is_measured():
    """Without advice to assemble it, which is for mechanisms."""
    bead = udk.ConstrainedSystem(
        mass=lambda q: jnp.eye(3),
        force=lambda t, q, v: jnp.array([0.0, 0.0, -9.81]),
        constraint=lambda t, q: jnp.array([q @ q - 1.0]),
    )
    off = failed(bead, TS, udk.State(np.array([2.0, 0, 0]), np.zeros(3)))
    assert "the initial state is open: constraint[0] is 3;" in off.cause and "assemble" not in off.cause


def test_what_nothing_stabilizes_says_so_and_what_is_left_out_too(pendulum):
    loose = failed(pendulum, rtol=1e-4, atol=1e-4, stabilization=None, drift_tol=1e-6)
    assert '"pin"' in loose.cause and "stabilize them, by Projection()" in loose.cause
    mech = udk.library.parallelogram(-0.8)
    state = udk.assemble(mech)
    bent = mech.with_parameters({"joint.A2.points[0][0]": 1.01})
    open_state = failed(bent, TS, state, analysis=udk.analyse(mech))
    assert open_state.result == Result.initial_state_open and '"A2" (0.01)' in open_state.cause


LAWS = {
    "grows": (lambda t, _: 1.0 / (0.55 - t) ** 2, {}, 'force "wind" grows without bound'),
    "not finite": (lambda t, _: jnp.where(t < 0.45, 0.1, jnp.nan), {}, 'force "wind" is not finite from about 0.45'),
    "dry": (lambda t, f: -50.0 * jnp.sign(f.vx), {"max_steps": 3000}, 'force "wind" jumps with the velocity'),
    "stiff": (
        lambda t, f: -1e7 * f.vx,
        {"max_steps": 500, "solver": diffrax.Dopri8()},
        'force "wind" damps at a rate of 1e+07 1/s',
    ),
    "stiff without stabilization": (
        lambda t, f: -1e7 * f.vx,
        {"max_steps": 3000, "solver": diffrax.Dopri8()},
        'force "wind" damps at a rate of 1e+07 1/s',
    ),
    "slow": (lambda t, f: -f.x, {"max_steps": 2}, "steps made .* % of the way; at this pace"),
}


@pytest.mark.parametrize("name", fast(set(LAWS) - {"dry"}, LAWS))
def test_loads_that_a_run_cannot_follow_are_named(name):
    law, choices, words = LAWS[name]
    with pytest.raises(udk.SimulationError, match=words.replace("+", r"\+")):
        udk.simulate(stone(law), TS, **choices)


def test_a_cause_belongs_to_its_solution_alone():
    """All solutions have one tree structure, and a solution made from others does not state a wrong cause."""
    one, other = failed(four_bar(motor=[START, 2.0])), udk.simulate(four_bar(motor=[START, 0.1]), TS)
    assert jax.tree.structure(one) == jax.tree.structure(failed(four_bar(motor=[START, 1.9])))
    moved = eqx.tree_at(lambda s: s.time, one, 0.1)
    assert "motor" in one.cause and "motor" not in moved.cause and "end time" in other.cause
    assert pickle.loads(pickle.dumps(one.found_cause)).text(int(one.code), float(one.time)) in one.cause


@pytest.mark.parametrize("tol", [1e-9, *(pytest.param(x, marks=pytest.mark.slow) for x in (1e-4, 1e-6, 1e-8, 1e-11))])
@pytest.mark.parametrize("end", [0.5, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_run_does_not_follow_the_positions_nearest_to_a_dead_point(tol, end):
    """A five-link press whose crank a motor turns at 60 rpm: beyond its reach nearest positions are open, and go on."""
    pins = {"A": (-10, 40), "B": (10, 80), "C": (75, 165), "D": (115, 85), "E": (140, 20), "F": (190, 165), "G": (220, 40)}
    links = {"crank": "AB", "plate": "BCD", "rocker": "DE", "coupler": "CF", "output": "FG"}
    bars = {name: udk.Link(list(ends), mass=0.1) for name, ends in links.items()}
    motors = [{"pin": "A", "speed": "60 rpm"}]
    press = udk.Drawing(pins, bars, ["A", "E", "G"], motors=motors, units={"length": "mm"}).mechanism()
    solution = failed(press, np.linspace(0.0, end, 11), rtol=tol, atol=tol, max_steps=5000)
    assert solution.result in (Result.drift, Result.step_too_small)
    assert float(solution.time) == pytest.approx(0.12112, abs=1e-4 if tol < 1e-5 else 1e-2)
    assert "dead point: pins B, D, E in line" in solution.cause


class Bumper(udk.ForceElement):
    """A force along x beyond an angle: a kink, at which steps of a run end."""

    def loads(self, t, frame):
        return [(-jnp.maximum(frame.angle - 9.0, 0.0), 0.0, 0.0)]


@pytest.mark.parametrize("count", [3, 11])
@pytest.mark.parametrize("tol", [1e-4, 1e-6, 1e-9])
def test_a_run_with_kinks_ends_at_the_reach_of_its_driver_too(tol, count):
    """The last output is closed, and the state that is open lies between it and the next."""
    mech = four_bar(motor=[START, 2.0])
    mech = udk.Mechanism(dict(mech.bodies), dict(mech.joints), dict(mech.drivers), {"bumper": Bumper("rocker")})
    solution = failed(mech, np.linspace(0.0, 2.0, count), rtol=tol, atol=tol)
    assert solution.settings["kinks"] == "located"
    assert solution.result in (Result.drift, Result.step_too_small)
    assert f"the linkage reaches {TOGGLE:.6g} rad" in solution.cause


@pytest.mark.parametrize(
    ("values", "cause"),
    [
        ({"mass": np.diag([1.0, 1e-11])}, ""),
        ({"mass": 1e-9 * np.diag([1.0, 1e-11])}, ""),  # small in every unit, but not singular
        ({"mass": np.diag([1.0, 1e-13])}, "the mass matrix is not positive definite: its eigenvalues are 1e-13 to 1"),
        ({"mass": np.diag([1.0, np.nan]), "force": np.zeros(2)}, "mass of the system is not finite"),
        ({"mass": np.diag([np.inf, 1.0]), "force": [np.nan, 0.0]}, "mass and force of the system are not finite"),
    ],
)
def test_causes_of_systems(values, cause):
    found = cause_of(values)
    assert found.startswith(cause) and bool(found) is bool(cause)
