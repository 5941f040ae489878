"""Motions of pins and links, types, dead points, time ratios and transmission against closed formulas of textbooks."""

# pyright: reportOptionalMemberAccess=false, reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize_scalar

import udkjax as udk
from udkjax.positions.answers.centres import centres_table
from udkjax.positions.answers.characteristics import acute_range
from udkjax.positions.answers.linkage_type import four_bars, mobility
from udkjax.statics.resting_forces import forces_table

MM = {"length": "mm", "angle": "deg"}


def four_bar(crank=40, coupler=120, rocker=80, ground=100, **more):
    pins = {
        "O": (0, 0),
        "C": (ground, 0),
        "A": udk.polar("O", crank, 60),
        "B": udk.circles(("A", "C"), (coupler, rocker), "left"),
    }
    links = {"crank": {"pins": ["O", "A"], "mass": 1}, "coupler": {"pins": ["A", "B"], "mass": 1}}
    links["rocker"] = {"pins": ["C", "B"], "mass": 1}
    return udk.Drawing(pins | more, links, ["O", "C"], motors={"motor": {"pin": "O", "speed": "60 rpm"}}, units=MM).mechanism()


def by_vectors(angle, omega, alpha, crank, coupler, rocker, ground):
    """Angles, rates and accelerations of coupler and rocker from the loop of vectors a + b = d + c, by complex numbers."""
    a = crank * np.exp(1j * angle)
    arm = ground - a
    d = abs(arm)
    beta = np.arccos((coupler**2 + d**2 - rocker**2) / (2 * coupler * d))
    b = coupler * np.exp(1j * (np.angle(arm) + beta))
    c = a + b - ground
    velocity = 1j * a * omega
    J = np.array([[(1j * b).real, (-1j * c).real], [(1j * b).imag, (-1j * c).imag]])
    w = np.linalg.solve(J, [-velocity.real, -velocity.imag])
    rest = -(1j * alpha - omega**2) * a + w[0] ** 2 * b - w[1] ** 2 * c
    return np.angle([b, c]), w, np.linalg.solve(J, [rest.real, rest.imag]), a + b


def test_the_motion_of_all_pins_and_links_at_an_angle():
    found = udk.motion_at(four_bar(), "40 deg", rate="300 rpm", acceleration="50 rad/s2")
    omega = 300 * np.pi / 30
    angles, rates, accelerations, end = by_vectors(np.radians(40), omega, 50.0, 0.04, 0.12, 0.08, 0.1)
    for k, name in enumerate(("coupler", "rocker")):
        assert_allclose(found.links[name][0], [angles[k], rates[k], accelerations[k]], rtol=1e-11)
    c, w, alpha = end - 0.1, rates[1], accelerations[1]
    expected = [end, 1j * w * c, (1j * alpha - w**2) * c]
    assert_allclose(found.pins["B"][0], np.array([[z.real, z.imag] for z in expected]), rtol=1e-11)
    assert list(found.pins) == ["A", "B"]  # those that move
    text = repr(found)
    assert "at 40 deg, the angle of O-A from the x axis; at 31.4159 rad/s (300 rpm)" in text and "omega (rad/s)" in text
    assert f"{abs(expected[1]) * 1000:.6g}" in text  # mm/s


CAM = """format = 2
units = {length = "mm", angle = "deg"}
ground = ["A"]
link = [{name = "disc", pins = ["A"], mass = 1, width = 30}, {name = "follower", pins = ["B", "C"], mass = 1, width = 10}]
slide = [{link = "follower", direction = [0, 1]}]
cam = [{pins = ["A", "B"], profile = {base = 40, law = ["cycloidal", "cycloidal"], angle = [180, 180], lift = [24, -24]}}]
motor = [{pin = "A", speed = "60 rpm"}]

[pins]
A = [0, 0]
B = [0, 40]
C = [5.51091059616e-15, 130]
"""


def test_rounding_is_zero_where_everything_rests_for_an_instant():
    """At its lowest place the follower of a cycloidal cam has neither velocity nor acceleration."""
    mechanism = udk.loads(CAM)
    motion = udk.motion_at(mechanism, 0)
    pins, links = motion.tables()
    assert pins.rows == [["B", "0", "40", "0", "0", "0", "0"], ["C", "0", "130", "0", "0", "0", "0"]]
    assert links.rows == [["disc", "0", "6.28319", "0", "1"], ["follower", "90", "0", "0", ""]]
    centres = centres_table(mechanism, udk.kinematics(mechanism, "motor1", [0.0], rate=6.28), motion.count)
    assert {row[0]: row[1:] for row in centres.rows}["disc and follower"] == ["0", "0"]
    forces = forces_table(mechanism, np.asarray(mechanism.q0))
    assert {row[0]: row[1] for row in forces.rows}["motor1 holds by"] == "0 N m"
    moving = udk.motion_at(mechanism, [0, 30]).tables()[0].rows
    assert float(moving[1][4]) > 1  # of B at 30 degrees, in mm/s


@pytest.mark.parametrize("pins", [["O", "A"], ["A", "O"]])
def test_an_angle_counts_from_the_ground_whatever_the_order_of_the_pins(pins):
    mech = four_bar()
    drawing = udk.Drawing(mech.drawing.pins, dict(mech.drawing.links) | {"crank": udk.Link(pins, mass=1.0)}, ["O", "C"],
                          motors={"m": {"pin": "O", "speed": 1}})  # fmt: skip
    for at in ("120 deg", 2 * np.pi / 3, "-240 deg", "480 deg"):
        place = udk.motion_at(drawing.mechanism(), at).pins["A"][0, 0]
        assert_allclose(place, [-0.02, 0.02 * 3**0.5], atol=1e-12)
    with pytest.raises(udk.SceneError, match='at: "mm" does not fit; it is measured in rad, deg'):
        udk.motion_at(drawing.mechanism(), "40 mm")


def test_values_of_a_drawing_in_degrees_are_degrees():
    many = udk.motion_at(four_bar(), [0, 90, "0.5 turns"])
    assert_allclose(many.pins["A"][:, 0], [[0.04, 0], [0, 0.04], [-0.04, 0]], atol=1e-15)
    assert "driver (deg)" in repr(many)


@pytest.mark.parametrize(
    ("lengths", "kind"),
    [
        ((40, 120, 80, 100), "crank-rocker"),
        ((80, 120, 40, 100), "rocker-crank"),
        ((100, 120, 80, 40), "double crank"),
        ((100, 40, 80, 120), "double rocker"),
        ((90, 60, 80, 120), "triple rocker"),
        ((40, 100, 40, 100), "change point"),
    ],
)
def test_grashof_s_types(lengths, kind):
    crank, coupler, rocker, ground = lengths
    (found,) = four_bars(four_bar(crank, coupler, rocker, ground), udk.Coordinate(("ground", "crank")))
    assert found.kind == kind and found.pins == ("O", "A", "B", "C") and found.links == ("ground", "crank", "coupler", "rocker")
    assert_allclose(found.lengths, np.array([ground, crank, coupler, rocker]) / 1000)
    (turned,) = four_bars(four_bar(crank, coupler, rocker, ground), udk.Coordinate(("ground", "rocker")))
    swapped = {"crank-rocker": "rocker-crank", "rocker-crank": "crank-rocker"}
    assert turned.kind == swapped.get(kind, kind) and turned.links == ("ground", "rocker", "coupler", "crank")


def test_dead_points_time_ratio_and_transmission_of_a_crank_rocker():
    a, b, c, d = 40.0, 120.0, 80.0, 100.0
    found = udk.characteristics(four_bar())
    # Dead points: crank and coupler in line, at distances b + a and b - a of O and B.
    stretched, folded = (np.arccos((d**2 + r**2 - c**2) / (2 * d * r)) for r in (b + a, b - a))
    at = np.sort(np.array([stretched, folded + np.pi]) % (2 * np.pi))
    rocker = found.outputs["rocker"]
    assert_allclose(np.sort(np.array(rocker.dead_points) % (2 * np.pi)), at, rtol=1e-12)
    ends = [np.pi - np.arccos((d**2 + c**2 - r**2) / (2 * d * c)) for r in (b + a, b - a)]
    assert_allclose(rocker.extent, abs(ends[0] - ends[1]), rtol=1e-12)
    way = at[1] - at[0]
    assert_allclose(rocker.time_ratio, max(way, 2 * np.pi - way) / min(way, 2 * np.pi - way), rtol=1e-12)
    # Transmission: extreme with the crank along the ground.
    mu = [np.arccos((b**2 + c**2 - r**2) / (2 * b * c)) for r in (d - a, d + a)]
    assert_allclose(found.transmission_angles["B"], sorted(min(x, np.pi - x) for x in mu), rtol=1e-12)
    assert found.mobility.counted == found.mobility.true == 1 and found.turns
    lines = found.lines()
    assert lines["type"].startswith("crank-rocker") and "the angle of O-A" in lines["driver"]


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e3])
def test_speeds_of_a_whitworth_quick_return_are_extreme_above_and_below_its_pin(unit):
    r, e = 0.1 * unit, 0.05 * unit  # the pin of the lever lies within the circle of the crank
    pins = {"O": (0, 0), "C": (0, -e), "A": udk.polar("O", r, 1.0)}
    links = {"crank": {"pins": ["O", "A"], "mass": 1}, "lever": {"pins": ["C"], "mass": 1, "width": r}}
    slots = [{"pin": "A", "along": ["C", "A"], "on": "lever"}]
    mech = udk.Drawing(pins, links, ["O", "C"], slots=slots, motors=[{"pin": "O", "speed": 1.0}]).mechanism()
    found = udk.characteristics(mech)
    ratios = found.outputs["lever"].speed_ratios
    assert ratios is not None
    slow, fast = ratios
    assert_allclose([slow.ratio, fast.ratio], [r / (r + e), r / (r - e)], rtol=1e-12)
    assert_allclose(np.sin([slow.at[0], fast.at[0]]), [1.0, -1.0], rtol=1e-12)
    assert found.lines()["speed ratio of lever"] == "0.666667 at 90 deg to 2 at 270 deg"


def test_speed_of_a_slide_in_the_units_of_the_drawing():
    """A scotch yoke: the slide follows the cosine of the crank."""
    pins = {"O": (0, 0), "A": udk.polar("O", 50, 20), "P": (90, 0)}
    links = {"crank": {"pins": ["O", "A"], "mass": 1}, "yoke": {"pins": ["P"], "mass": 1, "width": 20}}
    slots = [{"pin": "A", "direction": 90, "on": "yoke"}]
    given = {"slides": [{"link": "yoke", "direction": 0}], "slots": slots, "motors": [{"pin": "O", "speed": "60 rpm"}]}
    found = udk.characteristics(udk.Drawing(pins, links, ["O"], **given, units=MM).mechanism())
    ratios = found.outputs["yoke"].speed_ratios
    assert ratios is not None
    least, most = ratios
    assert_allclose([least.ratio, most.ratio], [-0.05, 0.05], rtol=1e-12)
    assert_allclose(np.cos([*least.at, *most.at]), np.zeros(2), atol=1e-12)
    assert found.lines()["speed ratio of yoke"] == "-50 mm/rad at 90 deg to 50 mm/rad at 270 deg"


def test_speeds_of_a_crank_rocker_are_those_of_its_loop():
    found = udk.characteristics(four_bar()).outputs["rocker"].speed_ratios

    def ratio(angle):
        return by_vectors(angle, 1.0, 0.0, 0.04, 0.12, 0.08, 0.1)[1][1]

    for sign, extreme in zip((1, -1), found, strict=True):
        k = np.argmin([sign * ratio(x) for x in np.linspace(0, 2 * np.pi, 200)])
        around = np.linspace(0, 2 * np.pi, 200)[k] + np.array([-0.05, 0.05])
        best = minimize_scalar(lambda x, sign=sign: sign * ratio(x), bounds=around, method="bounded", options={"xatol": 1e-9})
        assert_allclose(extreme.ratio, sign * best.fun, rtol=1e-12)
        assert_allclose(np.cos(extreme.at[0] - best.x), 1.0, rtol=1e-12)
        near = extreme.at[0] + np.array([-1e-4, 1e-4])
        assert_allclose(*map(ratio, near), rtol=1e-10)  # the place itself, to more digits than a minimum tells


def test_a_constant_speed_has_no_place():
    found = udk.characteristics(udk.library.parallelogram(), "body.link1.angle")
    text = {title: words for title, words in found.lines().items() if title.startswith("speed")}
    assert text and set(text.values()) == {"constantly 1"}
    assert udk.characteristics(four_bar(90, 60, 80, 120)).outputs["rocker"].speed_ratios is None  # toggles: without limit


def test_acute_angles_fold():
    deg = np.radians
    assert_allclose(acute_range(deg(20), deg(70)), deg([20, 70]))
    assert_allclose(acute_range(deg(80), deg(130)), deg([50, 90]))
    assert_allclose(acute_range(deg(-30), deg(20)), deg([0, 30]), atol=1e-15)
    assert_allclose(acute_range(deg(150), deg(220)), deg([0, 40]), atol=1e-15)


@pytest.mark.slow  # test_dead_points_time_ratio_and_transmission_of_a_crank_rocker
def test_toggles_limit_a_triple_rocker():
    found = udk.characteristics(four_bar(90, 60, 80, 120))
    assert not found.turns and len(found.limits) == 2
    reach = np.arccos((120**2 + 90**2 - 140**2) / (2 * 120 * 90))  # coupler and rocker in line
    assert_allclose(found.limits, [-reach, reach], rtol=1e-12)
    assert "toggles at" in found.lines()["driver"]


def test_gruebler_counts_a_parallelogram_s_third_crank():
    pins = {"O": (0, 0), "C": (1, 0), "E": (2, 0), "A": (0, 1), "B": (1, 1), "D": (2, 1)}
    links = {"crank": {"pins": ["O", "A"], "mass": 1}, "second": {"pins": ["C", "B"], "mass": 1}}
    links |= {"third": {"pins": ["E", "D"], "mass": 1}, "coupler": {"pins": ["A", "B", "D"], "mass": 1, "width": 0.1}}
    mech = udk.Drawing(pins, links, ["O", "C", "E"], motors={"motor": {"pin": "O", "speed": 1.0}}).mechanism()
    found = mobility(mech)
    assert found.counted == 0 and found.true == 1
    assert found.words == "1; Gruebler's count of 5 links and 6 joints says 0"


def test_instant_centres_lie_in_line():
    mech = four_bar()
    motion = udk.kinematics(mech, "motor", [1.2], rate=3.0)
    centres = udk.instant_centres(mech, motion.q[0], motion.v[0])
    place = {pair: one.place for pair, one in centres.items()}
    pins = udk.pin_motion(mech, motion).pins
    assert_allclose(place["ground", "crank"], [0, 0], atol=1e-12)
    assert_allclose(place["crank", "coupler"], pins["A"][0, 0], rtol=1e-10)
    for trio in (["ground", "crank", "rocker"], ["ground", "coupler", "rocker"], ["crank", "coupler", "rocker"]):
        one, two, three = (place[pair] for pair in ((trio[0], trio[1]), (trio[1], trio[2]), (trio[0], trio[2])))
        assert abs(np.linalg.det([two - one, three - one])) < 1e-10  # Kennedy's theorem
    rates = np.asarray(motion.v)[0, :, 2]
    x = place["crank", "rocker"][0]  # omega_rocker / omega_crank from its distances to the two fixed centres
    assert_allclose(x / (x - 0.1), rates[2] / rates[0], rtol=1e-10)


def test_a_pin_in_a_slot_has_the_answers_of_a_slider():
    pins = {"A": (0, 0), "B": udk.polar("A", 50, 60), "C": (160.988783333, -20)}
    links, given = {"crank": {"pins": ["A", "B"], "mass": 1}, "rod": {"pins": ["B", "C"], "mass": 1}}, {"units": MM}
    given |= {"motors": [{"pin": "A", "speed": "60 rpm"}]}
    slot = udk.Drawing(pins, links, ["A"], slots=[{"pin": "C", "direction": [1, 0]}], **given).mechanism()
    links = links | {"block": {"pins": ["C"], "mass": 1, "width": 20}}
    slide = udk.Drawing(pins, links, ["A"], slides=[{"link": "block", "direction": [1, 0]}], **given).mechanism()
    pin, block = udk.characteristics(slot).outputs["C"], udk.characteristics(slide).outputs["block"]
    assert_allclose(pin.extent, np.sqrt(0.2**2 - 0.02**2) - np.sqrt(0.1**2 - 0.02**2), rtol=1e-10)
    assert_allclose(
        [pin.extent, pin.time_ratio, *pin.dead_points], [block.extent, block.time_ratio, *block.dead_points], rtol=1e-9
    )
    assert pin.speed_ratios is not None and block.speed_ratios is not None
    assert_allclose([x.ratio for x in pin.speed_ratios], [x.ratio for x in block.speed_ratios], rtol=1e-12)


def test_the_ram_of_whitworths_quick_return():
    """A stroke of 2 r, with the angle 2 acos(e / a) of the crank for the way back."""
    pins = {"A": (0, 0), "B": udk.polar("A", 50, 60), "E": (0, -30), "F": (110, -30)}
    pins |= {"C": udk.polar("E", 70, 180, line=("E", "B"))}
    links = {name: {"pins": list(ends), "mass": 1} for name, ends in {"crank": "AB", "lever": "CE", "rod": "CF"}.items()}
    slots = [{"pin": "B", "along": ["C", "E"], "on": "lever"}, {"pin": "F", "direction": [1, 0]}]
    motors = [{"pin": "A", "speed": "60 rpm"}]
    ram = udk.characteristics(udk.Drawing(pins, links, ["A", "E"], slots=slots, motors=motors, units=MM).mechanism()).outputs["F"]
    back = 2 * np.arccos(30 / 50)
    assert_allclose([ram.extent, ram.time_ratio], [0.14, (2 * np.pi - back) / back], rtol=1e-9)
