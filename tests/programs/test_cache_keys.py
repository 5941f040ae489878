"""Keys of caches have everything that a stored result depends on: scenes that differ only in which numbers are absent, in turn.

A structure that forgets which numbers are None takes the first of such scenes for the second, most of all if both have equally
many numbers of the same shapes.
"""

import dataclasses
import inspect
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.study.identify.problem import prediction

TS = np.linspace(0.0, 0.2, 3)
EXACT: Any = {"rtol": 1e-10, "atol": 1e-10}
PIN = ["ground", "rod"], [[0.0, 0.0], [-0.5, 0.0]]
RAIL = ["ground", "block"], [[0.0, 1.0], [0.1, 0.0]]


def scene(*forces: udk.ForceElement, joints: Any = None, drivers: Any = None) -> udk.Mechanism:
    """A rod on a pin, and a block on a rail."""
    bodies = {
        "rod": udk.Body(1.0, 1 / 12, [0.5, 0.0], 0.0, [0.0, 0.5], 1.0),
        "block": udk.Body(2.0, 0.1, [0.3, 1.0], velocity=[0.5, 0.0]),
    }
    joints = {"pin": udk.Revolute(*PIN), "rail": udk.Prismatic(*RAIL, axis=0.0)} | (joints or {})
    return udk.Mechanism(bodies, joints, drivers, list(forces))


class Pair(NamedTuple):
    """Two scenes that differ in which optional numbers of a class are there."""

    cls: type
    fields: tuple[str, ...]
    first: udk.Mechanism
    second: udk.Mechanism
    first_events: Any = None
    second_events: Any = None


def of_force(cls: type, fields: str, first: dict[str, Any], second: dict[str, Any]) -> Pair:
    return Pair(cls, tuple(fields.split()), scene(cls(**first)), scene(cls(**second)))


def of_joint(cls: type, fields: str, first: dict[str, Any], second: dict[str, Any]) -> Pair:
    more = {"pin": cls(**first)}, {"pin": cls(**second)}
    return Pair(cls, tuple(fields.split()), scene(joints=more[0]), scene(joints=more[1]))


RUB: dict[str, Any] = {"joint": "pin", "coefficient": 0.3, "radius": 0.1}
SPRING: dict[str, Any] = {"bodies": ["rod", "block"], "points": [[0.5, 0.0], [0.0, 0.0]], "stiffness": 30.0, "length": 0.5}
TWIST: dict[str, Any] = {"bodies": ["ground", "rod"], "stiffness": 3.0}
TURN: dict[str, Any] = {"bodies": ["ground", "rod"], "coordinate": "x", "motion": udk.Polynomial([0.5, 0.0, -0.2])}
FLOOR: dict[str, Any] = {"body": "rod", "point": [0.5, 0.0], "through": [1.0, 0.02], "normal": [0.6, -0.8], "restitution": 0.5}
SMOOTH, RUBBED = udk.Contact(**FLOOR), udk.Contact(**FLOOR, coefficient=0.2)
TWICE = udk.Contact(**FLOOR, coefficient=0.2, static_coefficient=0.4)

PAIRS = {
    "torque or coefficient": of_force(
        udk.Friction, "torque velocity coefficient radius", {"joint": "pin", "torque": 0.3, "velocity": 0.1}, RUB
    ),
    "static or viscous": of_force(
        udk.Friction, "static_coefficient viscous", RUB | {"static_coefficient": 0.6}, RUB | {"viscous": 0.6}
    ),
    "length of a guide": of_force(
        udk.Friction, "length speed", {"joint": "rail", "coefficient": 0.3}, {"joint": "rail", "coefficient": 0.3, "length": 0.1}
    ),
    "damped spring": of_force(udk.Spring, "damping", SPRING, SPRING | {"damping": 2.0}),
    "damped torsion spring": of_force(udk.TorsionSpring, "damping", TWIST, TWIST | {"damping": 2.0}),
    "angle of a rail": Pair(
        udk.Prismatic,
        ("angle",),
        scene(joints={"rail": udk.Prismatic(*RAIL, axis=0.0)}),
        scene(joints={"rail": udk.Prismatic(*RAIL, axis=0.0, angle=0.1)}),
    ),
    "length of a rod": of_joint(
        udk.Distance,
        "length",
        {"bodies": PIN[0], "points": [[0.0, 0.3], [0.0, 0.0]]},
        {"bodies": PIN[0], "points": [[0.0, 0.3], [0.0, 0.0]], "length": 0.6},
    ),
    "angle of a rod": of_joint(udk.Angle, "angle", {"bodies": PIN[0]}, {"bodies": PIN[0], "angle": 0.2}),
    "angle of a weld": of_joint(
        udk.Weld,
        "angle",
        {"bodies": ["block", "rod"], "points": PIN[1]},
        {"bodies": ["block", "rod"], "points": PIN[1], "angle": 0.2},
    ),
    "points of a driver": Pair(
        udk.Driver,
        ("points", "axis"),
        scene(drivers={"turn": udk.Driver(**TURN, points=PIN[1][::-1])}, joints={"pin": udk.Slot(*PIN, axis=1.5)}),
        scene(drivers={"turn": udk.Driver(**TURN, axis=0.2)}, joints={"pin": udk.Slot(*PIN, axis=1.5)}),
    ),
    "slides or angles that are coupled": Pair(
        udk.Coupling,
        ("axis", "points"),
        scene(joints={"coupled": udk.Coupling(["ground", "block"], ["ground", "rod"], [0.3, 0.5], 0.0, points=np.zeros((2, 2)))}),
        scene(joints={"coupled": udk.Coupling(["ground", "block"], ["ground", "rod"], [0.0, 0.5]), "rail": udk.Slot(*RAIL, 0.0)}),
    ),
    "slides and angles that are coupled": Pair(
        udk.Coupling,
        ("to_axis", "to_points"),
        scene(
            joints={
                "coupled": udk.Coupling(["ground", "rod"], ["ground", "block"], [-0.6, 2.0], None, 0.0, None, np.zeros((2, 2)))
            }
        ),
        scene(joints={"coupled": udk.Coupling(["ground", "rod"], ["ground", "block"], [-0.6, 2.0], None, 0.0)}),
    ),
    "lower or upper limit": Pair(
        udk.JointLimit,
        ("lower", "upper"),
        scene(),
        scene(),
        udk.JointLimit("pin", lower=-0.01),
        udk.JointLimit("pin", upper=0.01),
    ),
    "contact that rubs": Pair(udk.Contact, ("coefficient", "static_coefficient"), scene(), scene(), SMOOTH, RUBBED),
    "static contact": Pair(udk.Contact, ("static_coefficient",), scene(), scene(), RUBBED, TWICE),
}
ELSEWHERE = {  # tested with their own subjects: they are no numbers of a scene, or of drawings, whose elements are compared above
    "Augmented", "CoordinatePartitioning", "Verner65", "Coordinate", "PinMotion", "Solution", "ConstrainedSystem", "Candidate",
    "Parameter", "Start", "Effort", "Link", "Cam", "LiftProfile", "SwingProfile", "Kinematics", "LeastGaps",
}  # fmt: skip


def test_every_optional_number_of_an_element_is_in_a_pair():
    seen = {(pair.cls.__name__, field) for pair in PAIRS.values() for field in pair.fields}
    for name in udk.__all__:
        cls = getattr(udk, name)
        if not inspect.isclass(cls) or not dataclasses.is_dataclass(cls) or name in ELSEWHERE or name.endswith("Goal"):
            continue
        if issubclass(cls, udk.pinv.Pseudoinverse):
            continue  # `rank_tol` of all methods, in tests/pinv
        missing = [f.name for f in dataclasses.fields(cls) if f.default is None and (name, f.name) not in seen]
        assert missing == [], f"{name}: give a pair of scenes with and without {missing}"


QUICK = ("torque or coefficient", "damped spring", "lower or upper limit")


@pytest.mark.parametrize("name", [x if x in QUICK else pytest.param(x, marks=pytest.mark.slow) for x in PAIRS])
@pytest.mark.filterwarnings("ignore::udkjax.positions.assembling.assembly.AssemblyWarning")
def test_scenes_that_differ_in_absent_numbers_are_told_apart(name):
    """In turn, eagerly and in one compiled function; with events, too. The first is computed again after the second."""
    pair, found = PAIRS[name], {"eager": [], "jit": []}
    compiled = jax.jit(lambda mechanism, events: udk.simulate(mechanism, TS, events=events, throw=False, **EXACT).q)
    for mechanism, events in (
        (pair.first, pair.first_events),
        (pair.second, pair.second_events),
        (pair.first, pair.first_events),
    ):
        found["eager"].append(np.asarray(udk.simulate(mechanism, TS, events=events, throw=False, **EXACT).q))
        found["jit"].append(np.asarray(compiled(mechanism, events)))
    first, second, again = found["eager"]
    assert_allclose(again, first, rtol=0, atol=0)
    assert np.isfinite(first).all() and np.isfinite(second).all()
    if name not in ("static contact", "slides and angles that are coupled"):  # differs at rest only; the points are the default
        assert np.abs(first - second).max() > 1e-6
    assert_allclose(found["jit"], found["eager"], rtol=0, atol=1e-9)
    if pair.first_events is None:
        for mechanism, wanted in ((pair.first, first), (pair.second, second), (pair.first, first)):
            state = udk.assemble(mechanism)
            assert_allclose(udk.step(mechanism, state, None, TS[-1], **EXACT).q, wanted[-1], rtol=0, atol=1e-8)
            a = [np.ravel(udk.accelerations(m, 0.0, state.q, state.v)) for m in (mechanism, udk.loads(udk.dumps(mechanism)))]
            assert_allclose(*a, rtol=0, atol=1e-9)


LAWS: list[dict[str, Any]] = [{"torque": 0.3, "velocity": 0.1}, {"coefficient": 0.3, "radius": 0.1}]
RUBS = [scene(udk.Friction("pin", **law)) for law in LAWS]


def estimate(mechanism: udk.Mechanism) -> float:
    """The mass of the rod, from a motion of the block and rod with another one."""
    truth = mechanism.with_parameters({"body.rod.mass": 1.2})
    run = udk.simulate(truth, TS, **EXACT)
    data = {"time": TS, "body.rod.angle": np.asarray(run.q[:, 0, 2])}
    return float(udk.identify(mechanism, data, ["body.rod.mass"], progress=False).values[0])


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_laws_of_friction_are_identified_one_after_the_other(order):
    """Both have two numbers of the same shapes: `torque` and `velocity`, or `coefficient` and `radius`."""
    prediction._program.cache_clear()
    for k in order:
        assert estimate(RUBS[k]) == pytest.approx(1.2, rel=1e-6)


def test_records_with_other_conditions_of_the_same_shapes():
    """The numbers of a record's conditions have names."""
    prediction._program.cache_clear()
    mechanism = scene(udk.Torque(["ground", "rod"], 0.0), udk.Force("block", [0.0, 0.0]))
    for name in ("body.block.mass", "body.block.inertia", "force.torque1.value"):
        run = udk.simulate(mechanism.with_parameters({"body.rod.mass": 1.2, name: 0.7}), TS, **EXACT)
        data = {"time": TS, "body.rod.angle": np.asarray(run.q[:, 0, 2])}
        record = udk.Record(data.pop("time"), data, conditions={name: 0.7})
        found = udk.identify(mechanism, [record], ["body.rod.mass"], progress=False)
        assert float(found.values[0]) == pytest.approx(1.2, rel=1e-6)


def test_a_sweep_over_mechanisms_that_differ_in_absent_numbers():
    for pair in (PAIRS["torque or coefficient"], PAIRS["static or viscous"]):
        data = udk.sweep(pair.first, {"mechanism": [pair.first, pair.second, pair.first]}, TS, ["final"], progress=False)
        wanted = [np.asarray(udk.simulate(m, TS).q[-1]) for m in (pair.first, pair.second, pair.first)]
        assert_allclose(data["q_end"], wanted, rtol=0, atol=1e-9)


def test_systems_that_differ_in_absent_functions():
    """A pendulum by a potential, by the same force, and without either; rows of positions, or of velocities alone."""
    given: Any = {"q0": np.array([1.0, 0.0]), "v0": np.array([0.0, 1.0])}
    rod, rate = {"constraint": lambda t, q: q @ q - 1.0}, {"velocity_constraint": lambda t, q, v: q @ v}
    mass, height = lambda q: 2.0 * jnp.eye(2), {"potential": lambda t, q: 19.62 * q[1]}
    weight = {"force": lambda t, q, v: jnp.array([0.0, -19.62])}
    kinds = [rod | height, rod | weight, rate | height, rate | weight, rod, rod | height]
    ends = [udk.simulate(udk.ConstrainedSystem(mass, **kind, **given), TS, **EXACT) for kind in kinds]
    for run in ends[1:4]:
        assert_allclose(run.q, ends[0].q, rtol=0, atol=1e-8)
    assert_allclose(ends[5].q, ends[0].q, rtol=0, atol=0)
    assert_allclose(ends[4].q[-1], [np.cos(0.2), np.sin(0.2)], rtol=0, atol=1e-8)
    potential = [np.asarray(udk.energy(udk.ConstrainedSystem(mass, **kind, **given), ends[0]).potential) for kind in kinds]
    assert_allclose(potential[0], 19.62 * np.asarray(ends[0].q)[:, 1], atol=1e-12)
    assert_allclose(potential[5], potential[0], rtol=0, atol=0)
    assert not np.any(potential[1])


ACTIONS = (udk.Log(), udk.Impact(0.5), udk.Stop(), udk.Release("pin"), udk.Lock("pin"), udk.Impact(0.3, at_rest="stop"))
RETURNED = (-1.0, 0.5, -1.0, -1.0, 0.0, 0.3)  # rate after over rate before, with the sign of a rebound


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_actions_at_the_same_condition_one_after_another(engine):
    """The code of a run has room for all numbers of its events, also for those that no condition uses."""
    ts = np.linspace(0.0, 0.2, 3)
    for action, ratio in (*zip(ACTIONS, RETURNED, strict=True), *zip(ACTIONS[::-1], RETURNED[::-1], strict=True)):
        event = udk.Event(lambda t, frames: frames["rod"].angle + 0.05, action, name="met")
        run = udk.simulate(scene(), ts, events=event, engine=engine, throw=False, **EXACT)
        assert run.events is not None and run.events.of("met")[0] == pytest.approx(0.18, abs=0.05), action
        before, after = (float(x[0, 0, 2]) for x in (run.events.v_before, run.events.v_after))
        assert after == pytest.approx(-ratio * before, abs=1e-7), action
