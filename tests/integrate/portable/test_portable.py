"""The portable engine takes the numbers of a scene with other parameters, and computes what Python computes."""

import base64
import zlib

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.friction import rubbing
from udkjax.integrate.portable import portable_engine, scalar_parameters
from udkjax.scene.tables.checks import SceneError

SLOW = ("parallelogram", "scissor_lift", "door_closer")


def test_parameters_are_named_one_number_at_a_time():
    mechanism = udk.library.slider_crank()
    every = scalar_parameters(mechanism)
    assert every["pin.P[0]"] == pytest.approx(0.5)
    assert scalar_parameters(mechanism, ["pin.P", "gravity[1]"]) == {k: every[k] for k in ("pin.P[0]", "pin.P[1]", "gravity[1]")}
    # A body's numbers follow from the drawing; one that was changed has its own, and goes on having it.
    own = scalar_parameters(mechanism.with_parameters({"body.crank.mass": 3.0}))
    assert own == {**every, "body.crank.mass": 3.0} and "body.crank.mass" not in every


def test_an_engine_has_code_for_the_redundant_rows_that_share_loads():
    engine = portable_engine(rubbing(udk.library.parallelogram()))
    assert engine.data["shared"] and not engine.data["why"]
    assert portable_engine(rubbing(udk.library.four_bar()), runs=False).data["shared"] is None


@pytest.mark.parametrize("name", ["pin.Q", "pin.P[2]", "pin.P[0][0]", "body.crank.mas"])
def test_an_unknown_parameter_is_named(name):
    with pytest.raises(SceneError, match=name.partition("[")[0]):
        portable_engine(udk.library.slider_crank(), [name])


@pytest.mark.parametrize(
    "scene", ["slider_crank", *(pytest.param(n, marks=pytest.mark.slow) for n in ("planetary_gear", "scissor_lift"))]
)
def test_numbers_follow_from_parameters(scene):
    mechanism = getattr(udk.library, scene)()
    engine = portable_engine(mechanism, list(scalar_parameters(mechanism)), pull=False)
    values = np.array([p["value"] for p in engine.data["parameters"]])
    names = [p["name"] for p in engine.data["parameters"]]
    same = np.concatenate([np.ravel(x) for x in mechanism.numbers])
    assert_allclose(engine.numbers(values.tolist())[: engine.numbers.count], same)
    for k in (0, len(values) // 3, len(values) // 2, len(values) - 1):
        other = values.copy()
        other[k] += 0.01 * max(abs(other[k]), 0.1)
        expected = mechanism.with_parameters({names[k]: other[k]})
        assert_allclose(
            engine.numbers(other.tolist())[: engine.numbers.count],
            np.concatenate([np.ravel(x) for x in expected.numbers]),
            rtol=1e-13,
            atol=1e-13,
            err_msg=names[k],
        )


@pytest.fixture(scope="module")
def evaluated():
    """Return a function that evaluates a mechanism at a state with the module of evaluations, and returns arrays by name."""
    from tests.wasm_host import Host

    def evaluate(mechanism, t, q, v):
        engine = portable_engine(mechanism, ["gravity"])
        module = engine.data["modules"]["evaluate"]
        host = Host(zlib.decompress(base64.b64decode(module["code"])), module["data_end"])
        host.begin()
        marks = np.ones(engine.data["marks"])
        marks[list(udk.analyse(mechanism).redundant_rows or ()) if len(marks) else []] = 0.0
        to = host.put(np.concatenate([engine.numbers.base[: engine.numbers.count], marks, engine.data["thresholds"]]))
        host.call("numbers", host.put([p["value"] for p in engine.data["parameters"]]), to)
        work = host.put(np.zeros(module["size"]))
        host.call("prologue", to, work)
        for name, x in (("t", [t]), ("q", q), ("v", v)):
            host.memory.write(host.store, np.asarray(x, float).tobytes(), work + 8 * module["places"][name])
        host.call("accelerations", work, work)
        host.call("energy", work, work)
        sizes = {"a": np.size(q), "energy": 2, "friction_power": 1, "x0": len(engine.data["rows"])}
        found = {name: host.numbers(work + 8 * module["places"][name], size) for name, size in sizes.items()}
        return found | {"places": [effort["place"] for effort in engine.data["efforts"]]}

    return evaluate


@pytest.mark.parametrize("scene", ["slider_crank", *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW)])
def test_accelerations_energies_and_efforts_are_those_of_the_textbook(evaluated, scene):
    if scene == "door_closer":  # springs with dampers, friction and a torque
        mechanism = udk.Mechanism(
            {"door": udk.Body(mass=20.0, inertia=4.0, position=(0.4, 0.0), angular_velocity=0.3)},
            {"hinge": udk.Revolute(bodies=("ground", "door"), points=((0.0, 0.0), (-0.4, 0.0)))},
            {},
            [
                udk.Spring(bodies=("ground", "door"), points=((0.2, -0.3), (0.1, 0.0)), stiffness=300.0, length=0.2, damping=9.0),
                udk.TorsionSpring(bodies=("ground", "door"), stiffness=5.0, angle=0.3, damping=1.0),
                udk.Friction(joint="hinge", torque=0.5, velocity=0.1, coefficient=0.3, radius=0.02),
                udk.Torque(bodies=("ground", "door"), value=2.0),
            ],
        )
    else:
        mechanism = getattr(udk.library, scene)()
    run = udk.simulate(mechanism, [0.0, 0.3])
    t, q, v = 0.3, np.asarray(run.q[1]), np.asarray(run.v[1])
    found = evaluated(mechanism, t, q, v)
    assert_allclose(found["a"], np.asarray(udk.accelerations(mechanism, t, q, v)).ravel(), rtol=1e-9, atol=1e-9)
    energy = udk.energy(mechanism, run)
    assert_allclose(found["energy"], [energy.kinetic[1], energy.potential[1]], rtol=1e-12)
    frictions = [name for name, force in mechanism.forces.items() if isinstance(force, udk.Friction)]
    powers = udk.power_balance(mechanism, run).forces if frictions else {}
    assert_allclose(found["friction_power"], [sum(float(powers[name][1]) for name in frictions)], rtol=1e-9)
    for place, effort in zip(found["places"], udk.efforts(mechanism, run).values(), strict=True):
        assert found["x0"][place] == pytest.approx(float(effort[1]), rel=1e-9)


def test_a_pull_is_a_spring_to_a_place_and_a_damper():
    from udkjax.integrate.portable.pull import PULL_PREFIX, Pull, with_pulls

    mechanism = udk.Mechanism({"ball": udk.Body(mass=2.0, inertia=1.0)}, gravity=(0.0, 0.0))
    held = with_pulls(mechanism).with_parameters(
        {f"force.{PULL_PREFIX}ball.{k}": x for k, x in {"stiffness": 8.0, "damping": 1.0, "target": [1.0, 0.0]}.items()}
    )
    ts = np.linspace(0.0, 3.0, 7)
    rate, decay = np.sqrt(8.0 / 2.0 - (1.0 / 4.0) ** 2), 1.0 / 4.0  # of x'' + x'/2 + 4 (x - 1) = 0
    expected = 1.0 - np.exp(-decay * ts) * (np.cos(rate * ts) + decay / rate * np.sin(rate * ts))
    assert_allclose(udk.simulate(held, ts, rtol=1e-10, atol=1e-10).q[:, 0, 0], expected, atol=1e-8)
    assert_array_equal(udk.simulate(with_pulls(mechanism), ts).q, udk.simulate(mechanism, ts).q)
    # At a point off the centre the power of the damper, by force and torque, is -damping |dp/dt|^2.
    frame = udk.Frame.at((0.3, -0.2), 0.7)._replace(vx=0.4, vy=-1.1, omega=2.3)
    (x, y, torque), (vx, vy) = (
        Pull(("ball",), [0.5, -0.2], [1.0, 0.0], 8.0, 1.5).loads(0.0, frame)[0],
        frame.velocity((0.5, -0.2)),
    )
    assert_allclose(x * frame.vx + y * frame.vy + torque * frame.omega, -1.5 * (vx**2 + vy**2))


def test_numbers_of_conditions_follow_those_of_the_mechanism():
    """The axis of a slide is a number of the scene, and of a condition about the position along it."""
    from udkjax.arrays import number
    from udkjax.integrate.events.law.conditions import WithinLimit, joint_coordinate
    from udkjax.integrate.events.run.condition_program import condition_numbers

    class Passes:
        def expand(self, mechanism):
            slide = joint_coordinate(mechanism, "slide", "a test")
            return [udk.Event(WithinLimit(slide, number(1.3), number(1.0)), udk.Log(), name="passes")]

    axis = "joint.slide.axis"
    mechanism = udk.Mechanism(
        {"block": udk.Body(1.0, 0.1)},
        {"slide": udk.Prismatic(("ground", "block"), [(0.0, 0.0), (0.0, 0.0)], axis=0.2)},
    )
    engine = portable_engine(mechanism, [axis], events=[Passes()])
    first, count = engine.numbers.count + engine.numbers.knots, engine.data["of_events"][0]
    numbers = engine.numbers([0.7])[first : first + count]
    changed = Passes().expand(mechanism.with_parameters({axis: 0.7}))
    assert_array_equal(numbers, np.concatenate([np.ravel(x) for x in condition_numbers(changed)]))
    assert 0.7 in numbers and 0.2 not in numbers
