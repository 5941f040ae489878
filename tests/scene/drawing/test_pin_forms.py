"""Pins by lengths and angles: their places, exact derivatives, files, and mistakes by name."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportAttributeAccessIssue=false

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.scene.drawing import pin_forms
from udkjax.scene.drawing.mistakes import shape_mistakes

MM = {"length": "mm", "angle": "deg"}
PINS = {
    "B": udk.circles(("A", "C"), (120, 80), "left"),
    "P": udk.polar("A", 50, 30, line=("A", "B")),
    "O": (0, 0),
    "A": udk.polar("O", 40, 60),
    "C": udk.polar("O", 100, along=(3, 0)),
    "M": udk.on_line("C", "B", share=0.5),
    "N": udk.on_line("C", "B", length="2 cm", off=10),
}
LINKS = {
    "crank": {"pins": ["O", "A"], "mass": 1, "width": 10},
    "coupler": {"pins": ["A", "B", "P"], "density": 7850, "thickness": 5},
    "rocker": {"pins": ["C", "N", "B", "M"], "mass": 1},
}


def four_bar(**pins):
    motors = {"motor": {"pin": "O", "speed": "60 rpm"}}
    return udk.Drawing(PINS | pins, LINKS, ["O", "C"], motors=motors, units=MM).mechanism()


def places(mech):
    return {name: np.asarray(place) * 1000 for name, place in mech.drawing.pins.items()}


def test_places_follow_from_lengths_and_angles():
    found = places(four_bar())
    assert list(found) == list(PINS)
    A, B, C = found["A"], found["B"], found["C"]
    assert_allclose(A, [20, 20 * 3**0.5])
    assert_allclose(C, [100, 0])
    assert_allclose([np.hypot(*(B - A)), np.hypot(*(B - C))], [120, 80], rtol=1e-14)
    assert np.linalg.det([C - A, B - A]) > 0  # on the left
    assert_allclose(found["P"] - A, 50 / 120 * np.array([[3**0.5, -1], [1, 3**0.5]]) / 2 @ (B - A), rtol=1e-13)
    assert_allclose(found["M"], (B + C) / 2)
    assert_allclose(found["N"] - C, [[20 / 80, -10 / 80], [10 / 80, 20 / 80]] @ (B - C), rtol=1e-13)
    right = places(four_bar(B=udk.circles(("A", "C"), (120, 80), "right")))["B"]
    middle = (B + right) / 2
    assert_allclose(np.linalg.det([C - A, middle - A]), 0, atol=1e-10)
    assert udk.check(four_bar()).residual_before < 1e-15


def umbrella(**more):
    """Two ribs on each side of a pole, with stretchers from its runner; those of one side lie in two layers."""
    pins, links = {"N": (0, 400), "R": (0, 80)}, {"runner": {"pins": ["R"], "mass": 0.05, "width": 30}}
    for side, name in ((1, "r"), (-1, "l")):
        pins |= {f"J{name}1": udk.circles(("N", "R"), (200, 240), "left" if side > 0 else "right")}
        pins |= {f"T{name}1": udk.polar("N", 500, 0, line=("N", f"J{name}1")), f"J{name}2": udk.stacked(f"J{name}1")}
        pins |= {f"T{name}2": udk.stacked(f"T{name}1")}
        for k in (1, 2):
            links[f"rib {name}{k}"] = {"pins": ["N", f"J{name}{k}", f"T{name}{k}"], "mass": 0.04, "width": 5}
            links[f"stretcher {name}{k}"] = {"pins": ["R", f"J{name}{k}"], "mass": 0.02}
    slides, motors = {"pole": {"link": "runner", "direction": [0, 1]}}, {"push": {"slide": "pole", "speed": "100 mm/s"}}
    return udk.Drawing(pins | more, links, ["N"], slides=slides, motors=motors, units={"length": "mm"})


def test_stacked_pins_do_not_join_the_links_of_two_layers():
    mech = umbrella().mechanism()
    pairs = [joint.bodies for joint in mech.joints.values()]
    assert ("rib r2", "stretcher r2") in pairs and len(pairs) == 13 and not {("rib r1", "rib r2")} & {*pairs}
    count = udk.analyse(mech)
    assert count.degrees_of_freedom == 0 and count.redundant == ()  # separate pins leave no redundant row
    one = np.asarray(udk.simulate(mech, [0.0, 0.3]).q[-1])
    layers = [[mech.body_names.index(f"rib r{k}") for k in (1, 2)], [mech.body_names.index(f"stretcher l{k}") for k in (1, 2)]]
    for first, second in layers:
        assert_allclose(one[first], one[second], atol=1e-9)
    moved = mech.with_parameters({"pin.Jr1.length": [0.21, 0.24]})
    found = places(moved)
    assert_allclose(found["Jr2"], found["Jr1"])
    assert_allclose(np.hypot(*(found["Jr2"] - found["N"])), 210)
    text = udk.dumps(mech)
    assert 'Jr2 = {stacked = "Jr1"}' in text and udk.dumps(udk.loads(text)) == text

    def points(lengths):
        return mech.with_parameters({"pin.Jr1.length": lengths}).joints["Jr2"].points

    slope = jax.jit(jax.jacfwd(points))(jnp.array([0.2, 0.24]))
    assert np.all(np.isfinite(slope)) and np.any(slope)


def test_stacks_may_be_high_but_not_circular():
    pins = {"O": (0, 0), "C": udk.stacked("B"), "B": udk.stacked("A"), "A": (0, 1)}
    links = {f"arm {end}": {"pins": ["O", end], "mass": 1} for end in "ABC"}
    arms = udk.Drawing(pins, links, ["O"], velocities={"A": (2, 0), "C": (1, 0)}).mechanism()
    assert_allclose(arms.v0[:, 2], [-2, -2, -1])  # the pin below moves the others, unless they have velocities of their own
    with pytest.raises(udk.SceneError, match=r'or write \{stacked = "Jr1"\} if its links lie in another layer'):
        umbrella(Jr2=udk.circles(("N", "R"), (200, 240), "left")).mechanism()
    with pytest.raises(udk.SceneError, match="refers to"):
        umbrella(Jr1=udk.stacked("Jr2"))
    with pytest.raises(udk.SceneError, match='no pin named "Q"'):
        umbrella(Jr2=udk.stacked("Q"))


NUMBERS = ["pin.B.length", "pin.P.length", "pin.P.angle", "pin.O", "pin.A.length", "pin.A.angle", "pin.C.length", "pin.C.along"]
NUMBERS += ["pin.M.share", "pin.N.length", "pin.N.off"]


@pytest.mark.slow
def test_derivatives_of_places_by_every_number():
    mech = four_bar()
    given = {name: mech.parameters()[name] for name in NUMBERS}
    assert {n for n, x in mech.parameters().items() if n.startswith("pin.")} == set(NUMBERS)

    def all_places(values):
        return jnp.stack(list(mech.with_parameters(values).drawing.pins.values()))

    slopes = jax.jacobian(all_places)(given)
    reverse = jax.jacrev(all_places)(given)
    for name, value in given.items():
        for k in np.ndindex(np.shape(value)):
            step = np.zeros(np.shape(value))
            step[k] = 1e-6
            ends = [np.asarray(all_places(given | {name: value + s * step})) for s in (-1, 1)]
            assert_allclose(slopes[name][(..., *k)], (ends[1] - ends[0]) / 2e-6, atol=1e-7, err_msg=name)
            assert_allclose(reverse[name][(..., *k)], slopes[name][(..., *k)], atol=1e-14)


@pytest.mark.slow  # test_derivatives_of_places_by_every_number covers the forms
def test_a_coupler_point_by_every_length_and_angle():
    """The point after a turn by a tenth: the pins and the motion of the linkage together."""
    mech = four_bar()
    names = ["pin.B.length", "pin.A.length", "pin.A.angle", "pin.C.length", "pin.P.length", "pin.P.angle"]
    given = {name: mech.parameters()[name] for name in names}

    def height(values):
        changed = mech.with_parameters(values)
        motion = udk.kinematics(changed, "motor", jnp.asarray([1.1, 1.7]))
        return udk.path(changed, motion, "P")[-1, 1]

    slopes = jax.jit(jax.grad(height))(given)
    for name, value in given.items():
        for k in np.ndindex(np.shape(value)):
            step = np.zeros(np.shape(value))
            step[k] = 1e-6
            ends = [float(height(given | {name: value + s * step})) for s in (-1, 1)]
            assert_allclose(slopes[name][k], (ends[1] - ends[0]) / 2e-6, atol=1e-7, err_msg=name)


@pytest.mark.slow
def test_circles_that_touch_have_a_pin_without_derivatives():
    def place(r, s=80.0):
        return four_bar(A=udk.polar("O", 40, 180), B=udk.circles(("A", "C"), (r, s), "left")).drawing.pins["B"]

    assert_allclose(place(60.0), [0.02, 0.0], atol=1e-12)
    drawing = four_bar(A=udk.polar("O", 40, 180), B=udk.circles(("A", "C"), (60, 80), "left")).drawing
    assert drawing.touching_pins() == ["B"] and four_bar().drawing.touching_pins() == []
    assert slider_crank(50 * np.sin(np.pi / 3) - 10).drawing.touching_pins() == ["P"]
    mech = four_bar(A=udk.polar("O", 40, 0))
    touching = {"pin.B.length": jnp.array([0.03, 0.03]), "pin.A.length": jnp.array(0.04)}

    def through(values):
        return mech.with_parameters(values).drawing.pins["B"]

    for derivative in (jax.jacfwd, jax.jacrev):
        assert np.isnan(np.asarray(derivative(through)(touching)["pin.B.length"])).any()
    apart = jax.vmap(lambda r: through({"pin.B.length": jnp.stack([r, 0.03])}))(jnp.array([0.01, 0.04]))
    assert np.isnan(apart[0]).any() and np.isfinite(apart[1]).all()


def test_files_keep_the_form():
    mech = four_bar()
    text = udk.dumps(mech)
    assert 'A = {from = "O", length = 40.0, angle = 60.0}' in text
    assert 'P = {from = "A", length = 50.0, angle = 30.0, line = ["A", "B"]}' in text
    assert 'B = {from = ["A", "C"], length = [120.0, 80.0], side = "left"}' in text
    assert 'M = {from = "C", to = "B", share = 0.5}' in text and 'C = {from = "O", length = 100.0, along = [3.0, 0.0]}' in text
    again = udk.loads(text)
    assert udk.dumps(again) == text
    for one, other in zip(jax.tree.leaves(mech), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    longer = mech.with_parameters({"pin.A.length": 0.045})
    assert 'A = {from = "O", length = 45.0, angle = 60.0}' in udk.dumps(longer)


def test_numbers_of_forms_are_leaves_and_places_are_not():
    mech = four_bar()
    longer = eqx.tree_at(lambda m: m.drawing.groups["pin"]["A"].length, mech, jnp.asarray(0.05))
    assert_allclose(np.hypot(*longer.drawing.pins["A"]), 0.05)
    assert_allclose(eqx.tree_at(lambda m: m.drawing.pins["O"], mech, jnp.ones(2)).drawing.pins["A"][0], 1.02)
    with pytest.raises(udk.SceneError, match='place of pin "A" is no leaf of the drawing: it follows from lengths and angles'):
        eqx.tree_at(lambda m: m.drawing.pins["A"], mech, jnp.ones(2))


@pytest.mark.parametrize(
    ("pins", "problem"),
    [
        (
            {"A": udk.polar("O", 36.9, 60), "B": udk.circles(("A", "C"), (120, 20), "left")},
            r"A and C are 87\.5877 mm apart; circles of 120 mm and 20 mm do not meet: they need between 100 mm and 140 mm",
        ),
        (
            {"B": udk.circles(("A", "C"), (40, 40), "left")},
            r"A and C are 87.178 mm apart; circles of 40 mm and 40 mm do not meet: they need more than 0, and at most 80 mm",
        ),
        ({"A": udk.polar("B", 40, 60)}, r"pins\.B: a circle of references, B from A, A from B: give B by coordinates"),
        ({"A": udk.polar("B", 40, 60)}, r"pins\.P: is never reached, as it refers to \"A\", which cannot be placed"),
        ({"A": udk.polar("A", 40, 60)}, r"pins\.A: refers to itself"),
        ({"A": udk.polar("O", 40)}, r"pins\.A\.angle: give an angle, or along"),
        ({"A": udk.polar("O", 40, 60, along=(1, 0))}, r"pins\.A\.angle: give an angle, or along"),
        ({"A": udk.polar("O", 40, along=(0, 0))}, r"pins\.A\.along: must have a direction"),
        ({"A": udk.polar("O", -40, 60)}, r"pins\.A\.length: must be > 0"),
        ({"A": udk.polar("O", "40 s", 60)}, r"pins\.A\.length: \"s\" does not fit; it is measured in m, mm, cm"),
        ({"A": udk.polar("Q", 40, 60)}, r"pins\.A\.from: no pin named \"Q\""),
        ({"A": udk.polar("O", 40, 60, line=("C",))}, r"pins\.A\.line: must name two pins"),
        ({"A": {"form": "O", "length": 40, "angle": 60}}, r"pins\.A\.form: unknown key; did you mean \"from\"\?"),
        ({"B": {"from": ["A", "C"], "length": [120, 80]}}, r"pins\.B\.side: missing"),
        ({"B": {"from": ["A", "C"], "length": [120, 80], "side": "up"}}, r"pins\.B\.side: must be one of \"left\", \"right\""),
        ({"B": udk.circles(("A", "A"), (120, 80), "left")}, r"pins\.B\.from: must name two pins"),
        ({"M": udk.on_line("C", "B")}, r"pins\.M\.share: give a share of the distance, or a length"),
        ({"M": udk.on_line("C", "C", 0.5)}, r"pins\.M\.to: must be another pin than from"),
        ({"A": (100, 0), "M": udk.on_line("C", "A", 0.5)}, r"pins\.(B|M): (A and C|\"C\" and \"A\") are"),
    ],
)
def test_mistakes_name_the_pins(pins, problem):
    with pytest.raises(udk.SceneError, match=problem):
        four_bar(**pins)


def test_numbers_that_leave_no_place_are_refused():
    with pytest.raises(udk.SceneError, match="do not meet: they need between 180 mm and 220 mm"):
        four_bar().with_parameters({"pin.B.length": (0.2, 0.02)})


def slider_crank(length=200, along=(2, 0), **pins):
    pins = {"O": (0, 0), "E": (0, 10), "A": udk.polar("O", 50, 60), "P": udk.on_rail("A", length, "E", along)} | pins
    links = {"crank": {"pins": ["O", "A"], "mass": 1}, "rod": {"pins": ["A", "P"], "mass": 1}}
    links["piston"] = {"pins": ["P"], "mass": 1, "width": 10}
    return udk.Drawing(pins, links, ["O"], [{"link": "piston", "direction": [1, 0]}], units=MM).mechanism()


@pytest.mark.slow
def test_a_pin_on_a_rail_is_that_of_a_slider():
    mech = slider_crank()
    A, P = places(mech)["A"], places(mech)["P"]
    assert_allclose(P, [25 + np.sqrt(200**2 - (A[1] - 10) ** 2), 10], rtol=1e-14)
    assert places(slider_crank(P=udk.on_rail("A", 200, "E", (1, 0), "behind")))["P"][0] < 0
    assert 'P = {from = "A", length = 200.0, on = "E", along = [2.0, 0.0], side = "ahead"}' in udk.dumps(mech)
    given = {name: mech.parameters()[name] for name in ("pin.P.length", "pin.P.along", "pin.E", "pin.A.angle")}
    slopes = jax.jacobian(lambda values: mech.with_parameters(values).drawing.pins["P"])(given)
    for name, value in given.items():
        for k in np.ndindex(np.shape(value)):
            step = np.zeros(np.shape(value))
            step[k] = 1e-6
            ends = [np.asarray(mech.with_parameters({name: value + s * step}).drawing.pins["P"]) for s in (-1, 1)]
            assert_allclose(slopes[name][(..., *k)], (ends[1] - ends[0]) / 2e-6, atol=1e-7)
    with pytest.raises(udk.SceneError, match=r"A is 33\.3013 mm off the line through E; a length of 20 mm does not reach it"):
        slider_crank(20)
    with pytest.raises(udk.SceneError, match=r"pins\.P\.along: must have a direction"):
        slider_crank(along=(0, 0))


def test_lengths_of_links_are_shown_in_the_unit_of_the_drawing():
    mech = four_bar()
    assert "length A-B 120 mm, B-P" in repr(mech) and "length C-N 22.3607 mm, N-B 60.8276 mm, B-M 40 mm, M-C 40 mm" in repr(mech)
    assert_allclose(mech.drawing.lengths()["ground"][("O", "C")], 0.1)


def test_a_pin_that_only_others_refer_to_is_a_point_of_the_ground():
    """A construction point: no link has it."""
    mech = four_bar(X=udk.on_line("O", "C", 0.5), A=udk.polar("O", 40, 60, line=("O", "X")))
    assert mech.drawing.locate_pin("X")[0] == "ground"


def test_references_are_followed_and_pins_are_compared_in_few_steps(monkeypatch):
    """Each pin was compared with all pairs of the others, and each reference looked for in all pins."""
    count, asked, norm = 400, [], np.linalg.norm

    class CountedPin(pin_forms.PolarPin):
        @property
        def references(self):
            asked.append(1)
            return super().references

    def pin(x: float) -> pin_forms.Pin:
        return pin_forms.Pin(position=[x, 0.0])

    pins = {f"p{k}": CountedPin(from_=f"p{k - 1}", length=1.0, angle=0.1) for k in range(count, 0, -1)} | {"p0": pin(0.0)}
    monkeypatch.setattr(np.linalg, "norm", lambda *given, **choices: asked.append(1) or norm(*given, **choices))
    assert pin_forms.in_order(pins) == [f"p{k}" for k in range(count + 1)]
    row = {f"p{k}": pin(float(k)) for k in range(count)}
    assert list(shape_mistakes(row, {})) == []
    assert len(asked) < 5 * count
    found = list(shape_mistakes(row | {"far": pin(1e6), "on": pin(7.0 + 1e-7)}, {}))
    assert ["pins.on: is at the same place as pin" in x for x in found] == [True, False]
    assert "pins.far: is 1e+06 m away from the other pins, which are within 399 m of each other" in found[1]
