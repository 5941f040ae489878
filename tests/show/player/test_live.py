"""Live pages as data: sliders, updates of symbols, and runs that cannot be live."""

import numpy as np
import pytest

import udkjax as udk
from tests.show.player.conftest import Motion
from udkjax.integrate.portable import drawn_points
from udkjax.scene.tables.checks import SceneError
from udkjax.show.player.live_parameters import label_of, section_of, sliders_of, usual_range
from udkjax.show.player.marks.symbol_updates import symbol_updates
from udkjax.show.player.player_data import run_record

COUPLER_POINT = udk.Drawing(
    pins={"A": (0, 0), "B": (1, 2), "C": (3, 2), "D": (4, 0), "P": (2, 3)},
    links={
        "crank": udk.Link(["A", "B"], mass=1),
        "coupler": udk.Link(["B", "P", "C"], mass=1),
        "rocker": udk.Link(["C", "D"], mass=1),
    },
    ground=["A", "D"],
)  # P is on the coupler only


@pytest.fixture(scope="module")
def live(slider_crank, run):
    return udk.animate(slider_crank, run, live=["motor.motor.speed", "pin.P"])


@pytest.mark.slow
def test_sliders_are_of_the_numbers_that_are_named(live, slider_crank):
    sliders = live.data["live"]["sliders"]
    assert [s["name"] for s in sliders] == ["motor.motor.speed", "pin.P[0]", "pin.P[1]"]
    assert [s["name"] for s in sliders] == [p["name"] for p in live.data["live"]["engines"][0]["parameters"]]
    assert [s["unit"] for s in sliders] == ["rad/s", "m", "m"]
    assert all(s["low"] <= s["value"] <= s["high"] for s in sliders)
    everything = sliders_of(slider_crank, True)
    assert {"gravity[1]", "link.rod.mass", "pin.P.velocity[1]"} < {s.name for s in everything}
    assert not any(s.name.startswith(("body.", "joint.")) for s in everything)  # these are determined by the drawing


def test_ranges_are_given_or_depend_on_the_unit(slider_crank):
    (slider,) = sliders_of(slider_crank, {"motor.motor.speed": (1.0, 9.0)})
    assert (slider.low, slider.high) == (1.0, 9.0)
    assert [s.high for s in sliders_of(slider_crank, {"pin.P": (-1.0, 2.5)})] == [2.5, 2.5]
    with pytest.raises(ValueError, match=r"5 to 9 of motor\.motor\.speed does not contain its value 4"):
        sliders_of(slider_crank, {"motor.motor.speed": (5.0, 9.0)})
    assert usual_range("body.a.mass", "kg", 2.0, 1.0, 1.0) == (0.2, 8.0)
    assert usual_range("joint.a.points[0][1]", "m", 2.0, 1.0, 1.0) == (1.5, 2.5)
    assert usual_range("force.s.length", "m", 2.0, 1.0, 1.0) == (0.2, 8.0)
    assert usual_range("body.a.angle", "rad", 0.0, 1.0, 1.0) == (-np.pi, np.pi)
    assert usual_range("pin.B.velocity[1]", "m/s", 2.5e-16, 2.0, 3.0) == (-6.0, 6.0)  # zero but for rounding


@pytest.mark.parametrize(
    ("name", "label", "section"),
    [
        ("joint.A.points[1][0]", "A point 2 x", "Joints"),
        ("gravity[1]", "gravity y", "Gravity"),
        ("motor.motor.speed", "motor speed", "Motors"),
        ("body.arm.angular_velocity", "arm angular velocity", "Initial state"),
        ("joint.mesh.radii[1]", "mesh radii 2", "Joints"),
        ("pin.B[0]", "B x", "Pins"),
        ("driver.crank.motion.coefficients[1]", "crank motion coefficients 2", "Drivers"),
    ],
)
def test_a_slider_has_a_label_and_a_section(name, label, section):
    assert (label_of(name), section_of(name)) == (label, section)


def test_sliders_of_lengths_have_the_names_of_links():
    pins = {"O": (0, 0), "C": (1, 0), "A": udk.polar("O", 0.4, 1.0), "B": udk.circles(("A", "C"), (1.2, 0.8), "left")}
    pins["P"] = udk.polar("A", 0.5, 0.3, line=("A", "B"))
    links = {name: {"pins": list(ends), "mass": 1} for name, ends in {"crank": "OA", "coupler": "ABP", "rocker": "CB"}.items()}
    sliders = sliders_of(udk.Drawing(pins, links, ["O", "C"], motors=[{"pin": "O", "speed": 1.0}]).mechanism(), True)
    found = {one.name: one.label for one in sliders if one.section == "Lengths and angles"}
    assert found == {
        "pin.A.length": "crank",
        "pin.A.angle": "crank angle",
        "pin.B.length[0]": "coupler A-B",
        "pin.B.length[1]": "rocker",
        "pin.P.length": "coupler A-P",
        "pin.P.angle": "coupler A-P angle",
    }


@pytest.mark.parametrize("mechanism", [udk.library.four_bar(), COUPLER_POINT.mechanism()], ids=["four-bar", "coupler point"])
def test_symbols_are_updated_with_the_numbers_that_they_are_made_of(mechanism):
    """With other numbers every updated place is that of the symbols of the changed mechanism."""
    other = mechanism.with_parameters({"pin.C": [2.9, 1.8]})

    def symbols(m):
        still = Motion(ts=np.zeros(1), q=np.asarray(m.q0)[None], v=np.zeros((1, len(m.bodies), 3)))
        record, _ = run_record(m, still, "", (), False, m.drawing.free_pins())
        return record, udk.animate(m, still, measures=()).data["runs"][0]["symbols"], record["traces"]

    (record, before, _), (_, after, traces) = symbols(mechanism), symbols(other)
    count = sum(np.size(x) for x in mechanism.numbers)
    rows = symbol_updates(mechanism, record, before, count)
    numbers = np.concatenate([np.ravel(x) for x in (*other.numbers, *(points for _, points in drawn_points(other)))])
    assert len(rows["frames"]) > 10 and len(rows["points"]) > 10
    for k, which, x, y in rows["frames"]:
        anchor = after[k]["frame"] if which < 0 else after[k]["frame"][which]
        np.testing.assert_allclose(anchor[1:3], numbers[[x, y]], atol=1e-12)
    for k, row, x, y in rows["points"]:
        np.testing.assert_allclose(after[k]["points"][row], numbers[[x, y]], rtol=1e-6, atol=1e-6)  # seven digits are written
    for k, _, x, y in rows["traces"]:
        np.testing.assert_allclose(traces[k][1:], numbers[[x, y]], atol=1e-12)
    links = [k for k, s in enumerate(before) if s["layer"] == "link"]
    assert {k for k, *_ in rows["points"]} == set(links)  # all of them
    assert len(rows["points"]) == sum(len(before[k]["points"]) for k in links)


def test_a_run_that_begins_elsewhere_keeps_its_beginning():
    pendulum = udk.library.simple_pendulum()
    run = udk.simulate(pendulum, np.linspace(0.0, 0.5, 6))
    assert udk.animate(pendulum, run, measures=(), live=["gravity"]).data["live"]["runs"][0]["start"] is None
    later = Motion(ts=np.asarray(run.ts), q=np.asarray(run.q)[[5] * 6], v=np.asarray(run.v)[[5] * 6])
    start = udk.animate(pendulum, later, measures=(), live=["gravity"]).data["live"]["runs"][0]["start"]
    np.testing.assert_allclose(start["q"], np.ravel(run.q[5]))
    np.testing.assert_allclose(start["v"], np.ravel(run.v[5]))


def test_ten_seconds_are_simulated_where_no_run_is_given():
    animation = udk.animate(udk.library.simple_pendulum(), live=["gravity[1]"])
    assert (animation.data["start"], animation.data["end"]) == (0.0, 10.0)
    names = [m["name"] for m in animation.data["runs"][0]["measures"]]
    assert "energy" in names[0] and names[-1] == "violation"


def test_a_live_page_opens_with_the_effort_of_its_driver(slider_crank):
    driven = udk.animate(slider_crank, udk.simulate(slider_crank, np.linspace(0.0, 0.1, 3)), live=["gravity[1]"])
    names = [m["name"] for m in driven.data["runs"][0]["measures"]]
    assert names[0] == "torque of motor" and names[-1] == "violation"


@pytest.mark.slow
def test_the_tolerances_are_those_of_the_run(live):
    pendulum = udk.library.simple_pendulum()
    exact = udk.simulate(pendulum, np.linspace(0.0, 0.5, 6), rtol=1e-11, atol=1e-10)
    settings = udk.animate(pendulum, exact, measures=(), live=["gravity"]).data["live"]["engines"][0]["settings"]
    assert (settings["rtol"], settings["atol"]) == (1e-11, 1e-10)
    settings = live.data["live"]["engines"][0]["settings"]  # the motion has none
    assert (settings["rtol"], settings["atol"]) == (1e-8, 1e-8)


def test_runs_of_a_mechanism_share_an_engine_and_a_parameter_of_a_single_run_has_a_slider(slider_crank, run):
    pendulum = udk.library.simple_pendulum()
    runs = {"one": run, "two": run, "other": udk.simulate(pendulum, np.linspace(0.0, 0.5, 6))}
    mechanisms = {"one": slider_crank, "two": slider_crank, "other": pendulum}
    data = udk.animate(mechanisms, runs, live=["pin.P[0]", "gravity[1]"]).data["live"]
    assert [each["engine"] for each in data["runs"]] == [0, 0, 1] and len(data["engines"]) == 2
    assert [s["name"] for s in data["sliders"]] == ["gravity[1]", "pin.P[0]"]
    assert [each["sliders"] for each in data["runs"]] == [[[0, -9.81], [1, 0.5]]] * 2 + [[[0, -9.81]]]


def test_the_torque_of_a_driver_is_among_its_measures(live):
    assert "torque of motor" in [m["name"] for m in live.data["runs"][0]["measures"]]


def test_a_run_that_cannot_be_live_is_refused_with_the_reason(slider_crank, run):
    with pytest.raises(SceneError, match=r"pin\.Q"):
        udk.animate(slider_crank, run, live=["pin.Q"])
    unstable = udk.simulate(slider_crank, np.linspace(0.0, 0.1, 3), stabilization=None, drift_tol=1.0)
    with pytest.raises(ValueError, match="simulates with projection, but the run has stabilization=NoneType"):
        udk.animate(slider_crank, unstable, live=True)


def test_the_events_of_a_live_run_are_those_of_its_simulation(slider_crank):
    passes = udk.Event(lambda t, at: at["slider"].x - 1.3, udk.Log(), name="passes")
    with_events = udk.simulate(slider_crank, np.linspace(0.0, 1.0, 21), events=passes)
    with pytest.raises(ValueError, match="the run has events, whose conditions the page needs: give `animate` the same"):
        udk.animate(slider_crank, with_events, live=["gravity"])
    without = udk.simulate(slider_crank, np.linspace(0.0, 1.0, 21))
    with pytest.raises(ValueError, match="was not simulated with the events passes"):
        udk.animate(slider_crank, without, live=["gravity"], events=[passes])
    with pytest.raises(ValueError, match="needed only for a live page"):
        udk.animate(slider_crank, with_events, events=passes)
    shown, happened = udk.animate(slider_crank, with_events).data["runs"][0]["events"], with_events.events
    assert happened is not None and len(happened.time) > 0
    assert [event["name"] for event in shown] == ["passes"] * len(happened.time)
    np.testing.assert_array_equal([event["t"] for event in shown], happened.time)
    assert udk.animate(slider_crank, without).data["runs"][0]["events"] == []


def test_ten_seconds_with_events_are_simulated_where_no_run_is_given():
    pendulum = udk.library.simple_pendulum()
    body = pendulum.body_names[0]
    animation = udk.animate(pendulum, live=["gravity[1]"], events=udk.Event(lambda t, at: at[body].x, udk.Log(), name="bottom"))
    assert {event["name"] for event in animation.data["runs"][0]["events"]} == {"bottom"}
    assert [name for name in animation.data["live"]["engines"][0]["events"]["names"] if name] == ["bottom"]


def test_numbers_are_shown_in_the_units_of_the_drawing(slider_crank):
    """60 rpm and 30 mm in a drawing in mm and degrees; the values of sliders are in SI units, as are scenes without units."""
    pins, links = {"O": (0, 0), "A": (30, 40)}, {"crank": {"pins": ["O", "A"], "mass": 2}}
    motors, wanted = {"motor": {"pin": "O", "speed": "60 rpm"}}, ["motor.motor.speed", "pin.A", "link.crank.mass"]
    units = {"length": "mm", "angle": "deg"}
    speed, *place, mass = sliders_of(udk.Drawing(pins, links, ground=["O"], motors=motors, units=units).mechanism(), wanted)
    assert (speed.shown, *[x.shown for x in place], mass.shown) == ("rpm", "mm", "mm", "kg")
    assert [x.value * x.per_unit for x in (speed, *place, mass)] == pytest.approx([60, 30, 40, 2], rel=1e-14)
    assert speed.value == pytest.approx(2 * np.pi) and speed.unit == "rad/s" and place[0].value == pytest.approx(0.03)
    assert all(x.shown == x.unit and x.per_unit == 1 for x in sliders_of(slider_crank, True))


def test_pins_that_must_stay_in_line_have_no_sliders_unless_named():
    lift = udk.library.scissor_lift()
    assert {slider.name for slider in sliders_of(lift, True) if slider.unit == "m" and slider.section == "Pins"} == {
        "pin.end[0]",
        "pin.end[1]",
    }
    assert [slider.name for slider in sliders_of(lift, ["pin.middle0"])] == ["pin.middle0[0]", "pin.middle0[1]"]
