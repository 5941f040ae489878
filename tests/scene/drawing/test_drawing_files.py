"""Format 2 of scene files: units, round trips, and mistakes by name."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax.scene as udk
from tests.elements import BODIES, DRIVERS, FORCES, JOINTS
from udkjax.scene.drawing import Drawing
from udkjax.scene.drawing.drawing_reader import units_of_element
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.numbers.quantities import read_quantity
from udkjax.scene.tables.element_setup import as_leaves
from udkjax.scene.tables.schema import build, table_of

HEAD = "format = 2\n"
MM = HEAD + 'units = {length = "mm", angle = "deg"}\n'
PINS = "[pins]\nO = [0, 0]\nA = [30, 40]\nB = [100, 50]\nC = [120, 0]\n"
CRANK = '[[link]]\nname = "crank"\npins = ["O", "A"]\nmass = 1\n'
ROD = '[[link]]\nname = "rod"\npins = ["A", "B"]\ndensity = 7850\nwidth = 10\nthickness = 5\n'
ROCKER = '[[link]]\nname = "rocker"\npins = ["C", "B"]\nmass = "0.5 kg"\n'
GROUND = 'ground = ["O", "C"]\n'
LINKS = CRANK + ROD + ROCKER
EVERYTHING = (
    MM
    + GROUND
    + PINS
    + 'D = ["3 cm", -20]\nE = [-50, 10]\nF = [-50, 40]\n[velocities]\nA = ["-40 mm/s", "0.03 m/s"]\n'
    + LINKS
    + """
[[link]]
name = "block"
pins = ["D"]
mass = 2
width = 20
[[link]]
name = "plate"
pins = ["B", "E", "F"]
outline = [[-60, 0], [110, 0], [110, 60], [-60, 50]]
density = "7.85 g/cm3"
thickness = 2
[[slide]]
link = "block"
direction = 30
[[slot]]
pin = "A"
along = ["O", "A"]
on = "plate"
[[gear]]
links = ["crank", "rocker"]
teeth = [20, 40]
[[cam]]
pins = ["E", "D"]
profile = {angle = [0, 120, 240], radius = [20, 25, 30]}
links = ["plate", "block"]
[[motor]]
pin = "O"
motion = {type = "sine", amplitude = 30, frequency = "2 rad/s"}
[[motor]]
slide = "slide1"
motion = {type = "polynomial", coefficients = [0, "10 mm/s", "0.2 m/s2"]}
[[motor]]
name = "brake"
pin = "C"
torque = "-2 N m"
[[spring]]
between = ["O", "B"]
stiffness = "2.5 kN/m"
length = 100
[[damper]]
pin = "C"
damping = "0.1 N m s/rad"
[[load]]
link = "rod"
force = [0, -3]
[[body]]
name = "bob"
mass = 1
inertia = "20 kg mm2"
position = [30, 10]
[[joint]]
name = "string"
type = "slot"
bodies = ["rod", "bob"]
points = [[0, 0], [0, 0]]
axis = [0, 1]
[[driver]]
name = "lead"
bodies = ["ground", "bob"]
coordinate = "x"
motion = {type = "spline", times = [0, 1], values = [30, 35]}
[[force]]
type = "friction"
joint = "A"
torque = "10 N mm"
velocity = "1 deg/s"
"""
)


def problems(text):
    with pytest.raises(udk.SceneError) as info:
        udk.loads(text)
    return info.value.problems


def test_everything_comes_back_in_its_units():
    mech = udk.loads(EVERYTHING)
    text = udk.dumps(mech)
    again = udk.loads(text)
    assert udk.dumps(again) == text
    assert 'units = {length = "mm", angle = "deg"}' in text and "A = [30.0, 40.0]" in text and "direction = 30.0" in text
    assert jax.tree.structure(again) == jax.tree.structure(mech)
    for a, b in zip(jax.tree.leaves(mech), jax.tree.leaves(again), strict=True):
        assert np.array_equal(a, b)


def test_numbers_are_read_in_their_units():
    found = udk.loads(EVERYTHING).parameters()
    expected = {
        "pin.D": [0.03, -0.02],
        "pin.A.velocity": [-0.04, 0.03],
        "link.rod.width": 0.01,
        "link.rod.density": 7850,
        "link.plate.density": 7850,
        "slide.slide1.direction": np.pi / 6,
        "motor.motor1.motion.amplitude": np.pi / 6,
        "motor.motor2.motion.coefficients": [0, 0.01, 0.2],
        "spring.spring1.stiffness": 2500,
        "body.bob.inertia": 2e-5,
        "body.bob.position": [0.03, 0.01],
        "joint.string.axis": np.pi / 2,
        "driver.lead.motion.values": [0.03, 0.035],
        "force.friction1.torque": 0.01,
        "force.friction1.velocity": np.pi / 180,
    }
    for name, value in expected.items():
        assert_allclose(found[name], value, rtol=1e-14, err_msg=name)


def test_what_a_drawing_no_longer_says_is_written_by_hand():
    mech = udk.loads(MM + GROUND + PINS + LINKS)
    heavier = mech.with_parameters({"body.crank.mass": 2.0})
    assert udk.dumps(mech).startswith("format = 2") and udk.dumps(heavier).startswith("format = 1")
    assert udk.loads(udk.dumps(heavier)).bodies["crank"].mass == 2.0
    assert udk.dumps(mech.with_parameters({"link.crank.mass": 2.0})).startswith("format = 2")


def test_numbers_of_numpy_and_jax_are_plain_numbers():
    """Whole arrays, entries of arrays, and traced numbers, in the same units as others."""
    link = {"link": {"pins": ["O", "A"], "mass": 1}}

    def length(pin):
        return Drawing({"O": (0, 0), "A": pin}, link, ground=["O"], units={"length": "mm"}).pins["A"]

    for pin in (np.array([3, 4]), (np.int64(3), np.float32(4)), jnp.array([3.0, 4.0])):
        assert_allclose(length(pin), [0.003, 0.004])
    assert_allclose(jax.jacfwd(length)(jnp.array([3.0, 4.0])), 1e-3 * np.eye(2))


def test_the_text_of_a_drawing_without_units_is_in_si_units():
    drawing = udk.Drawing({"O": (0, 0), "A": (1 / 3, 0.1)}, {"bar": udk.Link(["O", "A"], mass=1)}, ground=["O"], name="bar")
    text = udk.dumps(drawing)
    assert "units" not in text and f"A = [{1 / 3!r}, 0.1]" in text
    assert udk.dumps(udk.loads(text)) == text


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("60 rpm", "rad/s", 2 * np.pi),
        ("-1.5e-3 kN/mm", "N/m", -1500.0),
        ("9 kg", "kg", 9.0),
        (".5 N m/deg", "N m/rad", 90 / np.pi),
    ],
)
def test_quantities(text, unit, value):
    assert_allclose(read_quantity(text, unit), value, rtol=1e-15)


def drawn(old="", new="", *, head=HEAD, pins="", end=""):
    """The text of a four-bar with further elements, and `new` in place of `old`."""
    text = head + GROUND + PINS + pins + LINKS + end
    return text.replace(old, new) if old else text


MISTAKES = [
    # units
    (drawn('"0.5 kg"', '"0.5 m"', head=MM), 'link "rocker" (link[2]).mass: "m" does not fit; it is measured in kg, g'),
    (drawn('"0.5 kg"', '"0.5 stone"', head=MM), 'link "rocker" (link[2]).mass: "stone" is not a known unit'),
    (drawn('"0.5 kg"', '"half"', head=MM), 'link "rocker" (link[2]).mass: must be a number, or a string'),
    (drawn('"0.5 kg"', '"5"', head=MM), 'link "rocker" (link[2]).mass: "5" has no unit'),
    (drawn("[0, 0]", '[0, "1 s"]', head=MM), 'pins.O[1]: "s" does not fit; it is measured in m, mm, cm'),
    (drawn(head=MM + "gravity = [0, -9.81]\n"), "gravity[1]: -9.81 needs a unit, as length is in mm here: write"),
    (
        drawn(head=MM, end='[[motor]]\npin = "O"\nspeed = 5'),
        'motor "motor1" (motor[0]).speed: 5 needs a unit, as angle is in deg here',
    ),
    (drawn(head=HEAD + 'units = {lenght = "mm"}\n'), 'units.lenght: unknown quantity; did you mean "length"?'),
    (drawn(head=HEAD + 'units = {length = "kg"}\n'), 'units.length: "kg" does not fit'),
    # names
    (drawn("[pins]", "[pin]"), 'pin: unknown key; did you mean "pins"?'),
    (drawn("[[link]]", "[[links]]"), "links: unknown key; write [[link]]"),
    (drawn(end='[[weld]]\nlinks = ["rod", "crank"]'), "weld: unknown key; known are "),
    (
        drawn(end='[[motor]]\nlink = "crank"\nspeed = 1'),
        'motor "motor1" (motor[0]).link: unknown key; known are ',
    ),
    (
        drawn(end='[[motor]]\npin = "O"\nspeed = "60 RPM"'),
        'motor "motor1" (motor[0]).speed: "RPM" is not a known unit; did you mean "rpm"?',
    ),
    (drawn('"C", "B"', '"C", "b"'), 'link "rocker" (link[2]).pins[1]: no pin named "b"; did you mean "B"?'),
    (drawn('ground = ["O", "C"]', 'ground = ["Q", "C"]'), 'ground[0]: no pin named "Q"'),
    (drawn('"rocker"', '"rod"'), 'link "rod" (link[2]).name: taken by another link'),
    (drawn('"rocker"', '"ground"'), 'link "ground" (link[2]).name: "ground" is the fixed frame'),
    (drawn(end='[[motor]]\nname = "A"\npin = "O"\nspeed = 1'), 'motor "A" (motor[0]).name: taken by pin "A"'),
    (drawn('name = "rod"\n', ""), "link[1].name: missing"),
    (drawn("width", "widht"), 'link "rod" (link[1]).widht: unknown key; did you mean "width"?'),
    # who meets whom
    (drawn(pins="S = [1, 1]\n"), "pins.S: no link uses it"),
    (drawn('ground = ["O", "C"]', 'ground = ["O", "C", "S"]', pins="S = [1, 1]\n"), 'ground[2]: no link reaches pin "S"'),
    (drawn('["O", "A"]', "[]"), 'link "crank" (link[0]).pins: a link needs at least one pin'),
    (drawn(pins="S = [9, 9]\n", end='[[link]]\nname = "x"\npins = ["S"]\nmass = 1'), 'link "x" (link[3]).width: a link of one'),
    (drawn('["O", "A"]', '["A", "A"]'), 'link "crank" (link[0]).pins: names a pin twice'),
    (drawn("width = 10\n", ""), 'link "rod" (link[1]).width: missing'),
    (drawn("thickness = 5\n", ""), 'link "rod" (link[1]).thickness: missing'),
    (drawn("density = 7850\n", ""), 'link "rod" (link[1]): give a density, with a thickness, or a mass'),
    (
        drawn(pins="S = [200, 9]\nT = [200, 90]\n", end='[[link]]\nname = "x"\npins = ["S", "T"]\nmass = 1'),
        'link "x" (link[3]).pins: the link is not connected to the ground or to another link',
    ),
    (
        drawn('ground = ["O", "C"]', 'ground = ["O", "C", "A"]', end='[[motor]]\npin = "A"\nspeed = 1'),
        'motor "motor1" (motor[0]).pin: "A" must join two links, or a link and the ground; it joins ground, crank, rod; '
        'say which two, such as of = ["ground", "crank"]',
    ),
    (drawn(end='[[motor]]\npin = "O"'), 'motor "motor1" (motor[0]).speed: give one of speed, motion and torque'),
    (
        drawn(end='[[motor]]\npin = "O"\nbetween = ["O", "B"]\nspeed = 1'),
        'motor "motor1" (motor[0]).pin: give a pin, a slide, or two',
    ),
    (drawn(end='[[motor]]\nbetween = ["A", "O"]\nspeed = 1'), 'motor "motor1" (motor[0]).between: both pins are on "crank"'),
    (drawn(end='[[motor]]\nbetween = ["O", "B"]\ntorque = 1'), 'motor "motor1" (motor[0]).torque: a cylinder does not turn'),
    (
        drawn(end='[[motor]]\nbetween = ["O", "B"]\nspeed = "1 rpm"'),
        'motor "motor1" (motor[0]).speed: "rpm" does not fit; it is measured in m/s',
    ),
    (
        drawn(end='[[motor]]\npin = "O"\nof = ["crank", "rod"]\nspeed = 1'),
        'motor "motor1" (motor[0]).of: "rod" is not at pin "O", where there are ground, crank',
    ),
    (
        drawn(end='[[spring]]\nbetween = ["O", "C"]\nstiffness = 1'),
        'spring "spring1" (spring[0]).between: both pins are on "ground"',
    ),
    (drawn(end='[[load]]\npin = "O"'), 'load "load1" (load[0]).force: give a force, or a torque'),
    (drawn(end='[[slide]]\nlink = "rod"'), 'slide "slide1" (slide[0]).along: give two pins, or a direction'),
    (drawn(end='[[slot]]\npin = "O"\ndirection = 1\nlink = "rod"'), 'slot "slot1" (slot[0]).link: "rod" has no pin "O"'),
    (drawn(end='[[gear]]\nlinks = ["rod", "crank"]\nteeth = [1, 2]'), 'gear "gear1" (gear[0]).links: "rod" must share'),
    (
        drawn(end='[[gear]]\nlinks = ["crank", "rocker"]\nradii = [50, 50]'),
        'gear "gear1" (gear[0]).radii: wheels of these radii are 100 m apart, and their centres 120 m',
    ),
    # geometry
    (drawn("[100, 50]", "[30, 40]"), 'pins.B: is at the same place as pin "A"'),
    (drawn("[100, 50]", "[100, 50e3]"), "pins.B: is 5e+04 m away from the other pins"),
    (drawn('"C", "B"]', '"C", "A", "B"]\nwidth = 10'), 'link "rocker" (link[2]).pins: "A" is 68.7 m off the bar from "C" to "B"'),
    (
        drawn('["O", "A"]', '["O", "A", "S"]', pins="S = [60, 80]\n"),
        'link "crank" (link[0]).pins: the corners lie on one line, and enclose no area',
    ),
    (drawn('["O", "A"]', '["O", "B", "A", "C"]'), 'link "crank" (link[0]).pins: the polygon crosses itself'),
    (
        drawn(end="outline = [[500, 500], [600, 500], [600, 600]]"),
        'link "rocker" (link[2]).outline: crosses none of the pins "C", "B"',
    ),
    (
        drawn(end='[[slot]]\npin = "B"\nalong = ["O", "C"]'),
        'slot "slot1" (slot[0]).pin: "B" is 50 m off the line through "O" and "C"',
    ),
]


@pytest.mark.parametrize(("text", "expected"), MISTAKES, ids=[expected for _, expected in MISTAKES])
def test_mistakes_are_named(text, expected):
    found = problems(text)
    assert any(problem.startswith(expected) for problem in found), found


def test_all_mistakes_at_once_and_none_twice():
    text = MM + 'ground = ["O", "c"]\n' + PINS.replace("[30, 40]", '["3 kg", 40]') + LINKS.replace("width = 10", "width = -1")
    assert problems(text) == [
        'ground[1]: no pin named "c"; did you mean "C"?',
        'pins.A[0]: "kg" does not fit; it is measured in m, mm, cm',
        'link "rod" (link[1]).width: must be >= 0, not -1',
    ]


def test_a_file_of_a_wrong_drawing_is_named(tmp_path):
    path = Path(tmp_path / "wrong.toml")
    path.write_text(HEAD + PINS + CRANK)
    with pytest.raises(udk.SceneError, match=r"wrong\.toml"):
        udk.load(path)


SAMPLES = {
    "torque": udk.Torque(["a", "b"], udk.Held([0.7, -0.2], 0.5, 0.1)),
    "force": udk.Force("a", udk.Held([[1.0, 2.0], [3.0, 4.0]], 0.5, 0.1)),
    "servo": udk.TorsionSpring(["a", "b"], 3.0, angle=udk.Held([0.1, 0.2], 0.5, 0.1)),
}
# Units that all differ from SI's.
OTHER_UNITS = {"length": "mm", "angle": "deg", "mass": "g", "time": "ms", "force": "kN", "torque": "N mm", "density": "g/cm3"}
OTHER_UNITS |= {"inertia": "g mm2", "velocity": "mm/s", "angular_velocity": "rpm", "acceleration": "g", "stiffness": "N/mm"}
OTHER_UNITS |= {"damping": "N s/mm", "torsional_stiffness": "N mm/rad", "torsional_damping": "N mm s/rad"}


def numbers_by_place(table, place=()):
    """Return the numbers of nested tables and lists by the keys and indices that lead to them."""
    if isinstance(table, dict | list):
        items = table.items() if isinstance(table, dict) else enumerate(table)
        return {k: x for key, value in items for k, x in numbers_by_place(value, (*place, key)).items()}
    return {place: table} if not isinstance(table, bool | tuple) and table is not None and table != "ground" else {}


@pytest.mark.parametrize("element", [*BODIES.values(), *JOINTS.values(), *DRIVERS.values(), *FORCES.values(), *SAMPLES.values()])
def test_every_number_of_an_element_is_written_and_read_in_the_units_of_the_file(element):
    """All numbers but those without a unit change, and come back."""
    cls = type(element)
    variant, law = units_of_element(cls, table_of(element))
    si, other = (Units(units).write_table(element, variant, law) for units in ({}, OTHER_UNITS))
    problems = []
    back = build(cls, Units(OTHER_UNITS).convert_table("x", cls, other, problems, variant, law))
    assert problems == []
    for x, y in zip(jax.tree.leaves(element), jax.tree.leaves(as_leaves(back)), strict=True):
        assert_allclose(y, x, rtol=1e-15)
    written, unchanged = numbers_by_place(other), set()
    for place, value in numbers_by_place(si).items():
        if isinstance(value, float) and value and written[place] == value:
            unchanged.add(next(key for key in reversed(place) if isinstance(key, str)))
    assert unchanged == set()
