"""Drawings compared with the same mechanisms written by hand, and their pins as parameters."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import Tracer
from numpy.testing import assert_allclose

import udkjax as udk

SIX_BAR = Path(__file__).parents[3] / "examples" / "six_bar.toml"
FOUR_BAR = {"O": (0.0, 0.0), "A": (0.5, 0.8), "B": (2.6, 1.7), "P": (1.4, 2.2), "C": (2.5, 0.0)}


def four_bar(**more):
    """A crank-rocker with a coupler plate, whose third corner P is a coupler point."""
    links = {
        "crank": udk.Link(["O", "A"], density=1000.0, width=0.1, thickness=0.05),
        "coupler": udk.Link(["A", "B", "P"], density=1000.0, thickness=0.01),
        "rocker": udk.Link(["C", "B"], mass=2.0),
    }
    return udk.Drawing(FOUR_BAR, links, ground=["O", "C"], **more)


def by_hand(pins, links, ground, motor):
    """A mechanism of bars (two pins) and triangles with densities per area, written with bodies and revolute joints."""
    bodies, places = {}, {}
    for name, (through, density, width) in links.items():
        p = np.array([pins[pin] for pin in through], float)
        if len(p) == 2:  # a rectangle and two half discs, which are 4 r / (3 pi) off their straight sides
            length, r = np.hypot(*(p[1] - p[0])), width / 2
            half, off = np.pi * r**2 / 2, 4 * r / (3 * np.pi)
            area = length * width + 2 * half
            moment = length * width * (length**2 + width**2) / 12 + 2 * half * (r**2 / 2 - off**2 + (length / 2 + off) ** 2)
        else:  # a triangle has the second moment of three points at the middles of its sides
            area = abs(np.linalg.det(p[1:] - p[0])) / 2
            middles = (p + np.roll(p, 1, axis=0)) / 2
            moment = area / 3 * np.sum((middles - p.mean(axis=0)) ** 2)
        angle = np.arctan2(*(p[1] - p[0])[::-1])
        bodies[name] = udk.Body(density * area, density * moment, p.mean(axis=0), angle)
        places[name] = p.mean(axis=0), np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    joints = {}
    for pin, place in pins.items():
        pair = (["ground"] if pin in ground else []) + [name for name, (through, *_) in links.items() if pin in through]
        if len(pair) == 2:
            local = [np.array(place) if n == "ground" else places[n][1] @ (place - places[n][0]) for n in pair]
            joints[pin] = udk.Revolute(pair, local)
    crank, speed = motor
    law = udk.Polynomial([np.asarray(bodies[crank].angle), speed])
    return udk.Mechanism(bodies, joints, {"motor": udk.Driver(["ground", crank], "angle", law)})


def test_the_six_bar_moves_as_by_hand():
    drawn = udk.load(SIX_BAR)
    assert len(SIX_BAR.read_text().splitlines()) <= 30
    assert isinstance(drawn.drawing, udk.Drawing)
    pins = {name: np.asarray(place) for name, place in drawn.drawing.pins.items()}
    plate = 7850 * 0.005
    bars = {n: (p, plate, 0.015) for n, p in {"crank": "O2 A", "rocker": "O4 B", "floating": "C D", "output": "O6 D"}.items()}
    links = {n: (p.split(), *rest) for n, (p, *rest) in bars.items()} | {"coupler": (["A", "B", "C"], plate, 0.0)}
    links = {name: links[name] for name in drawn.body_names}
    hand = by_hand(pins, links, drawn.drawing.ground, ("crank", 2 * np.pi))
    for name, value in hand.parameters().items():
        other = drawn.parameters()[name.replace("driver.motor.", "driver.motor1.")]
        assert_allclose(other, value, rtol=1e-13, atol=1e-16, err_msg=name)
    ts = np.linspace(0.0, 1.0, 11)
    assert_allclose(udk.simulate(drawn, ts).q, udk.simulate(hand, ts).q, atol=1e-9)


def test_links_meet_at_pins():
    pins = {"O": (0, 0), "A": (1, 0), "B": (1, 1), "C": (0, 1), "D": (2, 0)}
    links = {name: udk.Link(["A", end], mass=1.0) for name, end in (("one", "O"), ("two", "B"), ("three", "C"), ("four", "D"))}
    mech = udk.Drawing(pins, links, ground=["O", "A"]).mechanism()
    assert {name: joint.bodies for name, joint in mech.joints.items()} == {
        "O": ("ground", "one"),
        "A": ("ground", "one"),
        "A-2": ("ground", "two"),
        "A-3": ("ground", "three"),
        "A-4": ("ground", "four"),
    }
    assert udk.check(mech).residual_before < 1e-15


def test_elements_act_where_they_are_drawn():
    """In the drawn position springs are unloaded, motions start, and everything is closed."""
    pins = {"O": (0, 0), "A": (3, 4), "S": (6, 8), "T": (10, 0), "B": (7, 0), "C": (13, 0)}
    links = {
        "arm": udk.Link(["O", "A", "S"], mass=1.0, width=0.1),
        "block": udk.Link(["A"], mass=1.0, width=0.2),
        "carriage": udk.Link(["B"], mass=2.0, inertia=0.1),
        "wheel": udk.Link(["T"], mass=1.0, width=6.0),
        "pinion": udk.Link(["C"], mass=1.0, width=6.0),
    }
    mech = udk.Drawing(
        pins,
        links,
        ground=["O", "T", "C"],
        slides={"rail": {"link": "carriage", "direction": [1, 1]}, "sleeve": {"link": "block", "along": ["O", "S"], "on": "arm"}},
        gears={"mesh": {"links": ["wheel", "pinion"], "teeth": [30, 15]}},
        motors={
            "feed": {"slide": "rail", "speed": 0.5},
            "drive": {"pin": "T", "motion": udk.Sine(0.3, 2.0)},
            "push": {"pin": "O", "torque": 5.0},
        },
        springs=[{"between": ["A", "B"], "stiffness": 100.0, "damping": 3.0}, {"pin": "O", "stiffness": 7.0, "angle": 0.1}],
        dampers=[{"pin": "C", "damping": 0.1}],
        loads=[{"pin": "S", "force": (0.0, -3.0)}, {"pin": "S", "force": (1.0, 0.0), "frame": "body"}],
        forces={"rub": udk.Friction("C", torque=0.1, velocity=0.01)},
    ).mechanism()
    assert udk.check(mech).residual_before < 1e-15
    assert_allclose(mech.joints["mesh"].radii, [2, 1])
    assert mech.forces["spring2"].bodies == ("ground", "arm") and mech.forces["spring1"].bodies == ("arm", "carriage")
    angle = np.arctan2(4, 3)
    assert_allclose(mech.forces["spring1"].length, np.hypot(4, 4))
    assert_allclose(mech.forces["spring2"].angle, angle + 0.1)
    assert_allclose(mech.forces["load1"].point, [5, 0], atol=1e-15)  # the arm's centre is halfway
    assert_allclose(mech.forces["load2"].vector, [0.6, -0.8])  # along x as drawn, turning with the arm
    sol = udk.simulate(mech, [0.0, 1.0])
    start, end = ({name: np.asarray(q) for name, q in zip(mech.body_names, state, strict=True)} for state in sol.q)
    assert_allclose(end["carriage"] - start["carriage"], [0.5 / np.sqrt(2)] * 2 + [0.0], atol=1e-9)
    assert_allclose(end["wheel"][2], 0.3 * np.sin(2.0), atol=1e-9)
    assert_allclose(end["pinion"][2], -2 * end["wheel"][2], atol=1e-9)
    assert_allclose(end["block"][2] - end["arm"][2], -angle, atol=1e-9)  # it slides on the arm without turning


@pytest.mark.slow
def test_a_cylinder_lifts_a_boom_as_levers_say():
    """The cylinder's lever arm is the distance from O to the line C A, the weight's that of the boom's centre."""
    pins = {"O": (0.0, 0.0), "C": (0.3, -0.2), "A": (0.5, 0.15), "T": (1.5, 0.45)}
    boom = udk.Drawing(
        pins,
        {"boom": udk.Link(["O", "A", "T"], mass=50.0, width=0.08)},
        ground=["O", "C"],
        motors={"lift": {"between": ["C", "A"], "speed": "20 mm/s"}},
    ).mechanism()
    way, arm = np.subtract(pins["A"], pins["C"]), 0.5 * 0.2 + 0.3 * 0.15
    drawn = np.hypot(*way)
    held = 50.0 * 9.81 * 0.75 / (arm / drawn)
    for mechanism in (boom, udk.loads(udk.dumps(boom))):
        slowly = mechanism.with_parameters({"motor.lift.speed": 1e-6})
        assert_allclose(udk.inverse_dynamics(slowly, [0.0]).efforts["lift"], held, rtol=1e-9)
        q = udk.simulate(mechanism, [0.0, 2.0]).q
        tips = [udk.path(mechanism, udk.kinematics(mechanism, None, [0.0, 2.0]), "A"), np.array([pins["C"]] * 2)]
        assert_allclose(np.hypot(*np.subtract(*tips).T), [drawn, drawn + 0.04], rtol=1e-12)
        assert_allclose(q, udk.kinematics(mechanism, None, [0.0, 2.0]).q, atol=1e-9)
    moved = jax.grad(lambda x: udk.inverse_dynamics(slowly.with_parameters({"pin.C": x}), [0.0]).efforts["lift"][0])
    assert np.isfinite(moved(jnp.array(pins["C"]))).all()


def ramp(direction, motion: Any = udk.Polynomial([0.0, 2.0]), **units):
    links, slides = {"block": udk.Link(["P"], mass=2.0, width=0.1)}, {"guide": {"link": "block", "direction": direction}}
    push = {"slide": "guide", "motion": motion}
    return udk.Drawing({"P": (0, 0)}, links, slides=slides, motors={"push": push}, units=units).mechanism()


def test_a_direction_is_an_angle_or_any_two_numbers():
    along = np.array([-1.0, 2.0])
    for given in (along, jnp.asarray(along), tuple(along), [-1, 2], list(jnp.asarray(along)), np.arctan2(2.0, -1.0)):
        assert_allclose(ramp(given).joints["guide"].axis, np.arctan2(2.0, -1.0), rtol=1e-15)
    slope = jax.grad(lambda x: ramp([jnp.cos(x), jnp.sin(x)]).joints["guide"].axis)(0.3)
    assert_allclose(slope, 1.0, rtol=1e-14)


@pytest.mark.parametrize("given", [np.zeros(2), [0, 0], np.ones(3), [True, 1], [[1, 2], [3, 4]]], ids=str)
def test_what_is_no_direction_is_the_only_mistake(given):
    with pytest.raises(udk.SceneError) as refused:
        ramp(given)
    (problem,) = refused.value.problems
    assert problem.startswith('slide "guide" (slide[0]).direction: must be a number, not [')


@pytest.mark.parametrize("kind", [list, np.array, jnp.array])
def test_coefficients_are_over_powers_of_the_time_whatever_holds_them(kind):
    motion = {"type": "polynomial", "coefficients": kind([1.0, 2.0])}
    with pytest.raises(udk.SceneError, match=r"coefficients\[1\]: 2.0 needs a unit, as length is in mm and time is in ms"):
        ramp(0.0, motion, length="mm", time="ms")
    found = ramp(0.0, motion, length="mm", velocity="m/s").drivers["push"].motion
    assert_allclose(np.asarray(found(1.0)), 2.001, rtol=1e-15)


def test_a_cam_turns_its_drawn_profile():
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    pins = {"O": (0.0, 0.0), "P": (0.0, 1.0)}
    links = {"cam": udk.Link(["O"], mass=1.0, width=1.0), "follower": udk.Link(["P"], mass=1.0, width=0.1)}
    drawing = udk.Drawing(
        pins,
        links,
        ground=["O"],
        slides={"guide": {"link": "follower", "direction": np.pi / 2}},
        cams={"contact": {"pins": ["O", "P"], "profile": {"angle": angle, "radius": 1.0 + 0.2 * np.cos(angle)}}},
        motors=[{"pin": "O", "speed": 1.0}],
    )
    sol = udk.simulate(drawing.mechanism(), [0.0, np.pi / 2])
    assert_allclose(sol.q[:, 1, 1], [1.0, 1.2], atol=1e-3)  # of the spline through twelve points


def test_velocities_of_pins():
    """A link moves with its pins: its centre turns about O at 2 rad/s, and goes on without forces."""
    pins, links = {"O": (0, 0), "A": (3, 4)}, {"bar": udk.Link(["O", "A"], mass=1.0)}
    mech = udk.Drawing(pins, links, ground=["O"], velocities={"A": (-8, 6)}, gravity=(0, 0)).mechanism()
    assert_allclose(mech.v0, [[-4, 3, 2]])
    assert_allclose(udk.simulate(mech, [0, 1]).v[-1, 0, 2], 2.0, rtol=1e-8)


def test_pins_move_what_hangs_on_them():
    mech = four_bar().mechanism()
    moved = mech.with_parameters({"pin.B": (2.9, 1.6), "link.crank.width": 0.2})
    pins = FOUR_BAR | {"B": (2.9, 1.6)}
    again = udk.Drawing(
        pins, four_bar().links | {"crank": udk.Link(["O", "A"], density=1000.0, width=0.2, thickness=0.05)}, ground=["O", "C"]
    ).mechanism()
    assert moved.parameters().keys() == again.parameters().keys()
    for name, value in moved.parameters().items():
        assert_allclose(value, again.parameters()[name], rtol=1e-15, err_msg=name)
    assert_allclose(mech.parameters()["pin.B"], (2.6, 1.7))


def test_what_was_changed_by_hand_stays_when_pins_move():
    mech = four_bar().mechanism().with_parameters({"body.coupler.mass": 9.0, "joint.B.points[0][0]": 0.7, "gravity": (0, -1)})
    moved = mech.with_parameters({"pin.B[0]": 2.7}).with_parameters({"pin.B": (2.8, 1.7), "body.crank.mass": 3.0})
    assert list(moved.direct) == ["body.coupler.mass", "body.crank.mass", "joint.B.points[0][0]"]
    found = moved.parameters()
    assert [float(found[f"body.{name}.mass"]) for name in ("coupler", "crank", "rocker")] == [9.0, 3.0, 2.0]
    assert found["joint.B.points"][0][0] == 0.7 and found["gravity"][1] == -1 and found["pin.B"][0] == 2.8
    with pytest.raises(udk.SceneError, match=r'no parameter "pin\.Q"'):
        mech.with_parameters({"pin.Q": (0, 0)})
    with pytest.raises(udk.SceneError, match="the same place"):
        mech.with_parameters({"pin.B": FOUR_BAR["A"]})


def test_mechanisms_with_the_same_numbers_given_directly_are_stacked():
    """Numbers given directly are separate leaves: two copies share a program, and each keeps its own when a pin moves."""
    given = [{"body.coupler.mass": mass, "joint.B.points[0][0]": x} for mass, x in ((4.0, 0.6), (9.0, 0.7))]
    plain, heavy = (four_bar().mechanism().with_parameters(values) for values in given)
    traces = []

    @jax.jit
    def moved(mechanism):
        traces.append(0)
        found = mechanism.with_parameters({"pin.B": jnp.array([2.8, 1.7])})
        return {name: value for name, value in found.parameters().items() if name.startswith(("body", "joint"))}

    wanted = [mechanism.with_parameters({"pin.B": (2.8, 1.7)}).parameters() for mechanism in (plain, heavy)]
    both = jax.vmap(moved)(jax.tree.map(lambda *xs: jnp.stack(xs), plain, heavy))
    for k, mechanism in enumerate((plain, heavy)):
        for name, value in moved(mechanism).items():
            assert_allclose(value, wanted[k][name], rtol=1e-14, atol=1e-16, err_msg=name)
            assert_allclose(both[name][k], wanted[k][name], rtol=1e-14, atol=1e-16, err_msg=name)
    assert len(traces) == 1  # one program for both, and for the batch
    assert [float(x["body.coupler.mass"]) for x in wanted] == [4.0, 9.0]
    assert [float(x["joint.B.points"][0][0]) for x in wanted] == [0.6, 0.7]


@pytest.mark.slow
def test_pins_are_differentiated_and_batched():
    """A coupler point's error with respect to all pins agrees with differences. Under vmap each member equals its own run."""
    drawing = four_bar(motors=[{"pin": "O", "speed": 2.0}])
    mech, ts = drawing.mechanism(), np.linspace(0.0, 1.0, 3)
    names, target = list(FOUR_BAR), np.array([1.0, 2.0])

    def error(places):
        moved = mech.with_parameters({f"pin.{name}": place for name, place in zip(names, places, strict=True)})
        x, y, angle = udk.simulate(moved, ts).q[-1, 1]
        arm = places[3] - (places[1] + places[2] + places[3]) / 3  # of P, as drawn
        turn = angle - jnp.arctan2(*(places[2] - places[1])[::-1])
        c, s = jnp.cos(turn), jnp.sin(turn)
        point = jnp.stack([x + c * arm[0] - s * arm[1], y + s * arm[0] + c * arm[1]])
        return jnp.sum((point - target) ** 2)

    at, step = jnp.array([FOUR_BAR[name] for name in names]), 1e-5
    found = jax.grad(error)(at)
    steps = step * jnp.eye(at.size).reshape(-1, *at.shape)
    ahead, back = jnp.split(jax.vmap(error)(jnp.concatenate([at + steps, at - steps])), 2)
    assert_allclose(found, ((ahead - back) / (2 * step)).reshape(at.shape), atol=1e-6)
    assert_allclose(ahead[0], error(at + steps[0]), rtol=1e-9)


def test_a_traced_pin_keeps_machine_code_and_concrete_numbers():
    mech = four_bar().mechanism()

    @jax.jit
    def crank(place):
        moved = mech.with_parameters({"pin.P": place})
        assert isinstance(moved.bodies["coupler"].mass, Tracer) and not isinstance(moved.bodies["crank"].mass, Tracer)
        sol = udk.simulate(moved, [0.0, 0.1])
        assert sol.settings["engine"] == "native"
        return sol.q[-1, 0]

    expected = udk.simulate(mech.with_parameters({"pin.P": (1.5, 2.3)}), [0.0, 0.1]).q[-1, 0]
    assert_allclose(crank(jnp.array([1.5, 2.3])), expected, rtol=1e-12)


def test_a_pin_that_makes_a_redundant_row_independent_is_noticed():
    """A parallelogram with three equal cranks moves; if one has another length it is stiff, traced or not."""
    pins = {f"O{k}": (k, 0.0) for k in range(3)} | {f"A{k}": (k + 0.6, 0.8) for k in range(3)}
    links = {f"link{k}": udk.Link([f"O{k}", f"A{k}"], mass=1.0) for k in range(3)}
    links["coupler"] = udk.Link(["A0", "A1", "A2"], mass=2.0, width=0.0)
    mech = udk.Drawing(pins, links, ground=["O0", "O1", "O2"]).mechanism()
    assert udk.check(mech).degrees_of_freedom == 1

    @jax.jit
    def code(place):
        return udk.simulate(mech.with_parameters({"pin.A1": place}), [0.0, 0.5]).code

    assert code(jnp.array([1.6, 0.8])) == udk.Result.successful
    assert code(jnp.array([1.7, 0.7])) != udk.Result.successful


def test_a_mechanism_with_a_drawing_passes_through_jit():
    mech = four_bar().mechanism()
    mass = jax.jit(lambda m, x: m.with_parameters({"link.coupler.density": x}).bodies["coupler"].mass)
    assert_allclose(mass(mech, 2000.0), 2 * mech.bodies["coupler"].mass, rtol=1e-15)
    assert udk.analyse(mech).degrees_of_freedom == 1 and mech.without_origin.drawing is None


@pytest.mark.filterwarnings("error")
def test_choices_may_be_strings_of_numpy():
    pins = {
        "O": (0.0, 0.0),
        "C": (2.0, 0.0),
        "A": (0.0, 1.0),
        "B": udk.circles(("A", "C"), (2.0, 2.0), np.array(["left", "right"])[0]),
    }
    links = {"crank": {"pins": ["O", "A"]}, "coupler": {"pins": ["A", "B"]}, "rocker": {"pins": ["C", "B"]}}
    mech = udk.Drawing(pins, links, ground=["O", "C"]).mechanism()
    assert mech.with_parameters({"pin.B.length": [2.1, 2.0]}).q0.shape == (3, 3)
