"""Named numbers of drawings, and numbers given by expressions of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import Tracer

import udkjax as udk
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.numbers.formula import Measured, evaluate, names_in

TEXT = """format = 2
units = {length = "mm", angle = "deg"}
gravity = [0.0, 0.0]
ground = ["O", "C"]

[numbers]
rod = "3*r"
r = 40.0
w = "60.0 rpm"
d = "1.0 in"
phi = "60.0 deg"

[pins]
O = [0.0, 0.0]
C = ["2.5*r", 0.0]
A = {from = "O", length = "r", angle = "phi"}
B = {from = ["A", "C"], length = ["rod", 80.0], side = "left"}

[[link]]
name = "crank"
pins = ["O", "A"]
density = 7850.0
width = "d/2"
thickness = "sqrt(25)"

[[link]]
name = "coupler"
pins = ["A", "B"]
mass = 1.0

[[link]]
name = "rocker"
pins = ["C", "B"]
mass = 1.0

[[motor]]
name = "motor1"
pin = "O"
speed = "2*w"
"""
PLAIN = {"2.5*r": 100.0, "rod": 120.0, "r": 40.0, "phi": 60.0, "d/2": 12.7, "sqrt(25)": 5.0}


@pytest.fixture(scope="module")
def mech():
    return udk.loads(TEXT)


def test_a_drawing_with_expressions_is_the_drawing_of_their_values(mech):
    head, _, body = TEXT.partition("[numbers]")
    text = head + body[body.index("[pins]") :].replace('"2*w"', '"120 rpm"')
    for expression, value in PLAIN.items():
        text = text.replace(f'"{expression}"', f"{value}")
    plain = udk.loads(text).parameters()
    found = {name: x for name, x in mech.parameters().items() if not name.startswith("number.")}
    assert list(found) == list(plain)
    for name, x in plain.items():
        np.testing.assert_allclose(found[name], x, rtol=1e-15, atol=1e-18, err_msg=name)


def test_files_keep_expressions_as_written(mech, tmp_path):
    assert udk.dumps(mech) == TEXT
    udk.save(mech.with_parameters({"number.r": 41.5}), tmp_path / "other.toml")
    assert (tmp_path / "other.toml").read_text() == TEXT.replace("r = 40.0", "r = 41.5")


def test_the_leaves_are_the_named_numbers_and_not_what_follows(mech):
    names = list(mech.independent_parameters())
    assert names[:5] == ["gravity", "number.r", "number.w", "number.d", "number.phi"]
    assert "pin.A.length" not in names
    assert names[5:8] == ["pin.O", "pin.C[1]", "pin.B.length[1]"]
    changed = eqx.tree_at(lambda m: m.drawing.own_groups["number"]["r"].value, mech, jnp.array(44.0))
    assert changed.drawing.length_texts()["coupler"] == "A-B 132 mm"
    assert mech.unit_of("number.w") == "rpm"
    assert "number   d                    value 1 in" in str(mech.drawing)


def test_named_numbers_are_changed_differentiated_and_mapped_as_others_are(mech):
    def height(r):
        return udk.assemble(mech.with_parameters({"number.r": r})).q[1, 1]

    step = 1e-3
    values = jax.vmap(height)(jnp.array([40.0 - step, 40.0, 40.0 + step]))
    slope, curve = jax.grad(height)(40.0), jax.grad(jax.grad(height))(40.0)
    np.testing.assert_allclose(slope, (values[2] - values[0]) / (2 * step), rtol=1e-7)
    np.testing.assert_allclose(curve, (values[2] - 2 * values[1] + values[0]) / step**2, rtol=1e-3)
    at_once = eqx.filter_grad(lambda m: udk.assemble(m).q[1, 1])(mech).independent_parameters()
    np.testing.assert_allclose(at_once["number.r"], slope, rtol=1e-12)
    assert float(jax.jit(height)(40.0)) == pytest.approx(float(values[1]), rel=1e-14)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (udk.Held([1.0, 2.0], 0.1), "number.r: must be a number, not Held"),
        (np.nan, "number.r: must be finite, not nan"),
        (1e300, "pins.[AB]: its place is no finite number"),
        (-40.0, "pins.A.length: must be > 0, not -0.04"),
    ],
)
def test_named_numbers_that_cannot_be_are_named(mech, value, said):
    with pytest.raises(udk.SceneError, match=said):
        mech.with_parameters({"number.r": value})


def test_what_is_computed_within_a_trace_stays_concrete():
    mech = udk.loads(TEXT)
    jax.jit(lambda x: x + sum(map(jnp.sum, mech.parameters().values())) + jnp.sum(mech.with_parameters({"number.r": x}).q0))(40.0)
    kept = mech.parameters(), mech.independent_parameters(), mech.q0, mech.v0, mech.bodies, mech.joints, mech.drivers
    assert not any(isinstance(x, Tracer) for x in jax.tree.leaves(kept))


def test_members_of_a_sweep_are_single_runs_whatever_their_size():
    """The scales to which closing is relative are those of the member: the sides of this linkage all follow from one number."""
    text = TEXT.replace('["rod", 80.0]', '["rod", "2*r"]').replace(
        "mass = 1.0", "density = 7850.0\nwidth = 10.0\nthickness = 5.0"
    )
    mech, ts, sizes = udk.loads(text), np.linspace(0.0, 0.1, 3), [0.004, 40.0, 4e5]
    found = udk.sweep(mech, {"number.r": sizes}, ts, progress=False)
    for r, q in zip(sizes, np.asarray(found.q_end), strict=True):
        alone = udk.simulate(mech.with_parameters({"number.r": r}), ts).q[-1]
        np.testing.assert_allclose(q, alone, rtol=1e-10, atol=1e-12 * r)


def test_runs_of_both_engines_and_their_derivatives_follow_a_named_number(mech):
    ts = np.linspace(0.0, 0.2, 3)

    def end(r, engine):
        return udk.simulate(mech.with_parameters({"number.r": r}), ts, engine=engine).q[-1, 2, 2]

    native, plain = end(41.0, "native"), end(41.0, "diffrax")
    np.testing.assert_allclose(native, plain, atol=1e-9)
    difference = (end(41.001, "native") - end(40.999, "native")) / 0.002
    np.testing.assert_allclose(jax.grad(end)(41.0, "native"), difference, rtol=1e-5)


def test_sweeps_and_designs_change_named_numbers(mech):
    found = udk.sweep(mech, {"number.r": [39.0, 40.0]}, np.linspace(0.0, 0.1, 3))
    assert found.sizes["number.r"] == 2
    from udkjax.synthesis.design import _all_pins

    assert _all_pins(mech) == ["number.r", "number.phi", "pin.O", "pin.C[1]", "pin.B.length[1]"]


@pytest.mark.parametrize("name", ["pin.A.length", "pin.B.length", "pin.B.length[0]", "pin.C", "number.rod", "motor.motor1.speed"])
def test_a_number_that_an_expression_gives_is_not_changed_beside_it(mech, name):
    shape = np.shape(mech.parameters()[name.partition("[")[0]]) if "[" not in name else ()
    with pytest.raises(udk.SceneError, match=rf'{name.replace("[", ".").replace("]", ".")}: is given by the expression ".*"'):
        mech.with_parameters({name: np.ones(shape)})


def test_other_entries_of_such_a_number_are_changed(mech):
    changed = mech.with_parameters({"pin.B.length[1]": 0.085, "pin.C[1]": 0.01})
    assert changed.drawing.length_texts()["rocker"] == "C-B 85 mm"
    assert 'C = ["2.5*r", 10.0]' in udk.dumps(changed)


def test_drawings_in_python_take_numbers(mech):
    pins = {"O": (0, 0), "C": ("2.5*r", 0), "A": udk.polar("O", "r", 60), "B": udk.circles("AC", ("3*r", 80), "left")}
    links = {name: {"pins": list(ends), "mass": 1} for name, ends in {"crank": "OA", "coupler": "AB", "rocker": "CB"}.items()}

    def lengths(r):
        drawing = udk.Drawing(pins, links, ["O", "C"], units={"length": "mm", "angle": "deg"}, numbers={"r": r})
        return drawing.lengths()["ground"]["O", "C"]

    np.testing.assert_allclose(lengths(40), 0.1, rtol=1e-15)
    np.testing.assert_allclose(jax.grad(lengths)(40.0), 0.0025, rtol=1e-14)


def test_expressions_compute_in_the_units_of_the_drawing():
    numbers = {"r": Measured(40.0, ""), "w": Measured(2.0, "rad/s"), "l": Measured(3.0, "m"), "a": Measured(30.0, "rad")}

    def value(text):
        return evaluate(text, numbers, lambda unit: np.pi / 180 if unit == "rad" else 1.0)

    for text, expected, unit in (
        ("r/4 + 1", 11.0, ""),
        ("-2^2", -4.0, ""),
        ("2**-1", 0.5, ""),
        ("l*2 + 1", 7.0, "m"),
        ("l/l", 1.0, ""),
        ("sin(a) * r", 20.0, ""),
        ("cos(60)", 0.5, ""),
        ("atan2(1, 1) + a", 75.0, "rad"),
        ("acos(0)", 90.0, "rad"),
        ("hypot(l, 4)", 5.0, "m"),
        ("abs(-r) * pi", 40 * np.pi, ""),
    ):
        found = value(text)
        assert found.value == pytest.approx(expected, rel=1e-14), text
        assert found.unit == unit, text
    assert names_in("2*r + sin(q1) + pi") == ("r", "q1")
    assert names_in("r; import os") is names_in("r.real") is names_in("[r]") is names_in("f(r)") is None


QUANTITIES = {"F": "100 N", "k": "2 N/mm", "v": "100 mm/s", "t": "500 ms", "T": "10 N m", "r": "50 mm", "w": "60 rpm"}
QUANTITIES |= {"m": "200 g", "a": "90 deg", "J": "0.3 kg m2", "n": 3.0, "half": "r/2", "area": "r**2", "c": "2 N m/rad"}


@pytest.mark.parametrize(
    "units", [{}, {"length": "mm", "angle": "deg"}, {"force": "kN", "torque": "N mm", "time": "ms", "mass": "g"}]
)
@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("F/k", "m", 0.05),
        ("v*t", "m", 0.05),
        ("k*r", "N", 100.0),
        ("T/r + F", "N", 300.0),
        ("w*t", "rad", np.pi),
        ("w*r - v", "m/s", 0.1 * np.pi - 0.1),
        ("n*half", "m", 0.075),
        ("n/t", "rad/s", 6.0),
        ("area/half", "m", 0.1),
        ("sqrt(area + 3*r^2)", "m", 0.1),
        ("sqrt(k/m)", "rad/s", 100.0),
        ("m*r**2", "kg m2", 5e-4),
        ("hypot(w*r, v)", "m/s", np.hypot(0.1 * np.pi, 0.1)),
        ("atan2(v*t, r)", "rad", np.pi / 4),
        ("c*a", "N m", np.pi),
        ("J*w/t", "N m", 1.2 * np.pi),
        ("F*r/(k*half)", "m", 0.1),
        ("r/half", "", 2.0),
        ("sin(w*t/6)", "", 0.5),
        ("abs(-T)", "N m", 10.0),
    ],
)
def test_products_of_quantities_do_not_depend_on_the_units_of_the_file(text, unit, value, units):
    drawing_units, problems = Units(units), []
    drawing_units.read_numbers(QUANTITIES, problems)
    found = drawing_units.convert("x", text, unit, problems)
    assert problems == [] and found == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "unit", "message"),
    [
        ("r**2", "m", '"r**2" is measured in m2; m is needed here'),
        ("F*v", "N", '"F*v" is measured in m2 kg/s3; N is needed here'),
        ("1/t", "m", '"1/t" is measured in 1/s; m is needed here'),
        ("a", "", '"a" is measured in rad; a number without a unit is needed here'),
        ("w*r + F", "m/s", "it adds a quantity in m rad/s and one in N"),
        ("hypot(r, t)", "m", "hypot of a quantity in m and one in s"),
        ("2**t", "m", "an exponent must be a plain number, not a quantity in s"),
        ("r**n", "m", "the power of a quantity in m needs an exponent without named numbers"),
        ("sqrt(r)", "m", "a quantity in m to the power 0.5 has no unit"),
        ("asin(r)", "rad", "asin needs a plain number, such as a ratio, not a quantity in m"),
        ("cos(r/t)", "", "cos needs an angle, not a quantity in m/s"),
    ],
)
def test_expressions_of_another_quantity_are_refused(text, unit, message):
    units, problems = Units({"length": "mm"}), []
    units.read_numbers(QUANTITIES, problems)
    assert units.convert("x", text, unit, problems) is None
    assert problems == [f"x: {message}"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('length = "r"', 'length = "2*q"', 'pins.A.length: there is no number named "q"'),
        ('length = "r"', 'length = "w"', 'pins.A.length: "w" is measured in rad/s; m is needed here'),
        ('speed = "2*w"', 'speed = "2*r"', 'motor "motor1" (motor[0]).speed: "2*r" needs a unit'),
        ('length = "r"', 'length = "w + d"', "it adds a quantity in rad/s and one in m"),
        ("r = 40.0", 'r = "rod/3"', "numbers.rod: refers to itself, directly or through other numbers"),
        ("r = 40.0", "sin = 40.0", 'numbers.sin: "sin" has a meaning in expressions already'),
        ("r = 40.0", "r = true", "numbers.r: must be a number, not true"),
        ("r = 40.0", 'r = "40 furlongs"', "numbers.r: "),
        ("gravity = [0.0, 0.0]", 'gravity = [0.0, "2*3"]', 'gravity[1]: "2*3" needs a unit'),
        ("r = 40.0", "r = -40.0", "pins.A.length: must be > 0, not -0.04"),
        ('width = "d/2"', 'width = "d/0"', "must be"),
        ('length = "r"', 'length = "r mm"', "pins.A.length: must be a number"),
    ],
)
def test_mistakes_name_the_place_and_the_cure(old, new, message):
    assert old in TEXT
    with pytest.raises(udk.SceneError) as error:
        udk.loads(TEXT.replace(old, new))
    assert message in str(error.value)
