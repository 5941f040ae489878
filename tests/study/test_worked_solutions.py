"""Worked solutions of ten textbook exercises: every printed line holds, both branches close, polygons fit the motion."""

import re

import numpy as np
import pytest

import udkjax as udk
from udkjax.scene.numbers.formula import evaluate
from udkjax.study.worked.exercises import exercises, read_variation, write_exercises
from udkjax.study.worked.loops import VectorLoop
from udkjax.study.worked.terms import SumOfTerms

MM = {"length": "mm", "angle": "deg"}
HOLDS = 1e-9  # relative to the largest term of a line


def drawn(pins, links, ground, motor, **more):
    shaped = {1: {"width": 20}, 3: {"width": 10}}
    tables = {name: {"pins": list(ends), "mass": 1, **shaped.get(len(ends), {})} for name, ends in links.items()}
    return udk.Drawing(pins, tables, list(ground), motors=[motor], units=MM, gravity=(0, 0), **more).mechanism()


TURNS = {"pin": "O", "speed": "60 rpm"}
BARS = {"crank": "OA", "coupler": "AB", "rocker": "CB"}


def four_bar(side):
    pins = {"O": (0, 0), "C": (100, 0), "A": udk.polar("O", 40, 60), "B": udk.circles(("A", "C"), (120, 80), side)}
    return drawn(pins, BARS, "OC", TURNS)


def slider(**rod_end):
    pins = {"O": (0, 0), "A": udk.polar("O", 50, 60), "P": udk.on_rail("A", 150, "R", (1, 0)), "R": (0, -20)}
    links = {"crank": "OA", "rod": "AP"}
    return drawn(pins, links | rod_end.pop("links", {}), "O", rod_end.pop("motor", TURNS), **rod_end)


def quick_return(off):
    pins = {"C": (0, 0), "O": (0, 250), "A": udk.polar("O", 100, 30), "E": udk.polar("C", 500, 0, line=("C", "A"))}
    if not off:
        slots = [{"pin": "A", "along": ["C", "E"], "on": "lever"}]
        return drawn(pins, {"crank": "OA", "lever": "CE"}, "CO", TURNS, slots=slots)
    slots = [{"pin": "A", "direction": [0.2, 0.9], "on": "lever"}]
    return drawn(pins, {"crank": "OA", "lever": "CE"}, "CO", TURNS, slots=slots)


def whitworth():
    pins = {"A": (0, 0), "B": udk.polar("A", 50, 60), "E": (0, -30), "F": (110, -30)}
    pins |= {"D": udk.polar("E", 110, 0, line=("E", "B")), "C": udk.polar("E", 70, 180, line=("E", "B"))}
    slots = [{"pin": "B", "along": ["C", "D"], "on": "lever"}, {"pin": "F", "direction": [1, 0]}]
    return drawn(pins, {"crank": "AB", "lever": "CED", "rod": "CF"}, "AE", {"pin": "A", "speed": "60 rpm"}, slots=slots)


def scotch_yoke():
    pins = {"O": (0, 0), "A": udk.polar("O", 40, 60), "Y": (90, 0)}
    slides, slots = [{"link": "yoke", "direction": [1, 0]}], [{"pin": "A", "direction": [0, 1], "on": "yoke"}]
    return drawn(pins, {"crank": "OA", "yoke": "Y"}, "O", TURNS, slides=slides, slots=slots)


def six_bar():
    pins = {"O": (0, 0), "C": (100, 0), "A": udk.polar("O", 40, 60), "B": udk.circles(("A", "C"), (120, 80), "left")}
    pins |= {"D": udk.on_line("C", "B", share=0.5), "F": (230, 20), "G": udk.circles(("D", "F"), (110, 70), "left")}
    return drawn(pins, BARS | {"rocker": "CDB", "rod": "DG", "output": "FG"}, "OCF", TURNS)


def driven_slide():
    block = {"links": {"block": "P"}, "slides": {"rail": {"link": "block", "direction": [1, 0]}}}
    return slider(motor={"slide": "rail", "speed": "100 mm/s"}, **block)


EXERCISES = {
    "open four-bar": (lambda: four_bar("left"), "40 deg", 1),
    "crossed four-bar": (lambda: four_bar("right"), "40 deg", 1),
    "offset slider-crank": (lambda: slider(links={"block": "P"}, slides=[{"link": "block", "direction": [1, 0]}]), "40 deg", 1),
    "pin in a slot": (lambda: slider(slots=[{"pin": "P", "direction": [1, 0]}]), "130 deg", 1),
    "quick return": (lambda: quick_return(False), "40 deg", 1),
    "quick return off the line": (lambda: quick_return(True), "20 deg", 1),
    "Whitworth": (whitworth, "40 deg", 2),
    "Scotch yoke": (scotch_yoke, "130 deg", 1),
    "six-bar": (six_bar, "75 deg", 2),
    "slide with a motor": (driven_slide, "-10 mm", 1),
}


TERNARY = {"D": (100, 40), "E": (130, 80), "F": (170, 50), "P": (130, -20), "O": (0, 0), "A": udk.polar("O", 20, 70)}


def triad(links, ground="", pins=None, **more):
    """A ternary link on three legs: the rod from the crank, a rocker, and one given by `links` or a slot."""
    legs = {"crank": "OA", "rod": "AD", "plate": "DEF", "rocker": "PE"} | links
    shaped = {1: {"width": 20}}
    tables = {name: {"pins": list(ends), "mass": 1, **shaped.get(len(ends), {})} for name, ends in legs.items()}
    pins = TERNARY | (pins or {})
    return udk.Drawing(pins, tables, list(f"OP{ground}"), motors=[TURNS], units=MM, gravity=(0, 0), **more).mechanism()


LEG = {"pins": {"Q": (190, -50)}, "ground": "Q"}
BLOCK = {"pins": {"Q": (190, -50), "R": (260, 30)}, "ground": "Q", "slides": [{"link": "block", "direction": [1, 0]}]}
TRIADS = {  # with the numbers of loops that are solved together
    "triad": (lambda: triad({"leg": "FQ"}, **LEG), "100 deg", [2]),
    "triad with a slot": (lambda: triad({}, slots=[{"pin": "F", "direction": [2, 1]}]), "100 deg", [2]),
    "triad and a slider": (lambda: triad({"leg": "FQ", "arm": "FR", "block": "R"}, **BLOCK), "100 deg", [2, 1]),
}


@pytest.fixture(scope="module")
def solutions():
    return {name: udk.worked_solution(make(), at, digits=15) for name, (make, at, _) in (EXERCISES | TRIADS).items()}


def value(text: str) -> float:
    return float(evaluate(text, {}, lambda unit: np.pi / 180 if unit == "rad" else 1.0).value)


@pytest.mark.parametrize("name", EXERCISES | TRIADS)
def test_each_printed_line_holds_with_the_printed_numbers(solutions, name):
    solution, loops = solutions[name], (EXERCISES | TRIADS)[name][2]
    assert [len(one.loops) for one in solution.loops] == ([1] * loops if isinstance(loops, int) else loops)
    assert len(solution.lines) > 10 * len(solution.loops)
    for line in solution.lines:
        left, right, *result = line.text(solution.style).split(" = ")
        if line.left is not None and not result:  # a solution alone, which the next lines put in
            assert float(right.split(" ")[0]) * solution.style.size(line.left.unit) == pytest.approx(line.left.value, rel=HOLDS)
        elif not result:  # a closure: a sum that is zero
            assert abs(value(left)) <= HOLDS * line.right.scale * 1e3, left
        else:
            found = float(result[0].split(" ")[0])
            assert value(right) == pytest.approx(found, rel=HOLDS, abs=HOLDS), line.text(solution.style)


@pytest.mark.parametrize("name", EXERCISES)
def test_both_branches_close_the_loop_and_one_is_the_position(solutions, name):
    solution = solutions[name]
    for one in solution.loops:
        assert [branch.is_actual for branch in one.branches].count(True) == 1
        assert len(one.branches) == (1 if len(one.loops[0].slides) == 2 else 2)
        for branch in one.branches:
            left = {line.left.name: line.left.value for line in branch.lines}
            sizes = closes(solution, one.loops[0], left)
            assert abs(sum(sizes)) <= HOLDS * max(map(abs, sizes))
        actual = next(branch for branch in one.branches if branch.is_actual)
        left = {line.left.name: line.left.value for line in actual.lines}
        for symbol in one.found:
            turns = (left[symbol.name] - symbol.value) / (2 * np.pi) if symbol.unit == "rad" else 0.0
            assert abs(turns - round(turns)) < HOLDS
            if symbol.unit == "m":
                assert left[symbol.name] == pytest.approx(symbol.value, rel=HOLDS)


def closes(solution, loop: VectorLoop, found) -> list[complex]:
    """Return the vectors of a loop as complex numbers, with the unknowns of a branch."""
    vectors = []
    for x in loop.vectors:
        angle = 0.0 if x.body == "ground" else found.get(f"θ_{x.body}", solution.geometry.angles[x.body])
        size = found.get(f"s_{solution.symbols.pins[x.slide]}", x.size) if x.slide else x.size
        vectors.append(x.sign * size * np.exp(1j * (angle + x.turn)))
    return vectors


@pytest.mark.parametrize("name", TRIADS)
def test_steps_of_newtons_method_lead_from_an_estimate_to_the_position(solutions, name):
    one = solutions[name].loops[0]
    first, *_, last = one.steps
    assert not one.branches and len(one.steps) in range(4, 8)
    angles = [x for x, symbol in zip(first.unknowns, one.found, strict=True) if symbol.unit == "rad"]
    np.testing.assert_allclose(np.degrees(angles) % 10, 0, atol=1e-9)  # as read off a sketch
    assert all(after.residual < before.residual for before, after in zip(one.steps[:-2], one.steps[1:-1], strict=True))
    np.testing.assert_allclose(last.unknowns, [symbol.value for symbol in one.found], rtol=HOLDS)
    residual = [abs(sum(closes(solutions[name], loop, _named(one, first.unknowns)))) for loop in one.loops]
    assert max(residual) / np.sqrt(2) <= first.residual * (1 + HOLDS) <= max(residual) * (1 + 2 * HOLDS)
    assert "residual (mm)" in str(solutions[name]) and "read off a sketch" in solutions[name].html()


def _named(one, values):
    return {symbol.name: value for symbol, value in zip(one.found, values, strict=True)}


@pytest.mark.parametrize("name", EXERCISES | TRIADS)
def test_systems_have_the_rates_of_the_kinematics_as_solution(solutions, name):
    for one in solutions[name].loops:
        for system in (one.velocity, one.acceleration):
            A = np.array([[line.left.value for line in row] for row in system.matrix])
            b = np.array([line.left.value for line in system.right])
            x = np.array([symbol.value for symbol in system.unknowns])
            np.testing.assert_allclose(A @ x, b, rtol=0, atol=HOLDS * max(np.abs(A * x).max(), np.abs(b).max()))


def test_polygons_have_the_relative_velocities_of_rigid_links(solutions):
    solution = solutions["six-bar"]
    omega = {name: float(x[0, 1]) for name, x in solution.motion.links.items()}
    places, of_link = solution.geometry.places, {"v_BA": "coupler", "v_BD": "rocker", "v_GD": "rod"}
    sides = {side.name: side for side in solution.polygons[0]}
    for name, link in of_link.items():
        arm = places[name[2]] - places[name[3]]
        np.testing.assert_allclose(
            sides[name].end - sides[name].start, omega[link] * np.array([-arm[1], arm[0]]), rtol=1e-9, atol=1e-12
        )
        np.testing.assert_allclose(sides[name].end, sides[f"v_{name[2]}"].end, rtol=0, atol=0)


def test_links_are_in_equilibrium_under_their_weights():
    pins = {"O": (0, 0), "C": (100, 0), "A": udk.polar("O", 40, 60), "B": udk.circles(("A", "C"), (120, 80), "left")}
    links = {name: {"pins": list(ends), "mass": 2} for name, ends in BARS.items()}
    mech = udk.Drawing(pins, links, ["O", "C"], motors=[TURNS], units=MM).mechanism()
    solution = udk.worked_solution(mech, "40 deg")
    assert list(solution.balances) == ["crank", "coupler", "rocker"]
    assert all(line.residual < 1e-9 for lines in solution.balances.values() for line in lines)
    sums = [line.right for lines in solution.balances.values() for line in lines[1:2]]
    weights = [one.parts[0][1].value for one in sums if isinstance(one, SumOfTerms)]
    assert len(weights) == 3
    np.testing.assert_allclose(weights, -2 * 9.81)
    assert "M_motor1" in solution.balances["crank"][2].text(solution.style, numbers=False)


def test_pages_have_the_equations_in_mathml_and_need_no_other_file(solutions, tmp_path):
    solutions["Whitworth"].save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("<math") > 40
    assert page.count("<svg") == 3
    assert not re.search(r"https?://(?!www\.w3\.org)|<script|<link", page)


def test_other_elements_and_places_out_of_reach_are_refused():
    with pytest.raises(udk.SceneError, match="a worked solution has pins, slides and slots"):
        udk.worked_solution(geared(), "10 deg")
    still = udk.Drawing(pins={"O": (0, 0), "A": (40, 0)}, links={"bar": {"pins": ["O", "A"], "mass": 1}}, ground=["O"])
    with pytest.raises(udk.SceneError, match="worked solution needs a motor: add one"):
        udk.worked_solution(still.mechanism(), "10 deg")
    with pytest.raises(udk.SceneError, match="worked solution needs a drawing"):
        udk.worked_solution(udk.loads(udk.dumps(four_bar("left").with_parameters({"body.crank.mass": 2.0}))), 0.5)
    toggling = four_bar("left").with_parameters({"pin.B.length[0]": 0.025})
    with pytest.raises(udk.SceneError, match="at: 180 deg cannot be reached"):
        udk.worked_solution(toggling, "180 deg")


def geared():
    pins, links = {"O": (0, 0), "P": (50, 0)}, {"sun": "O", "planet": "P"}
    gears = [{"links": ["sun", "planet"], "radii": [30, 20]}]
    return drawn(pins, links, "OP", TURNS, gears=gears)


def test_numbers_of_students_assemble_turn_and_differ(tmp_path):
    mech = four_bar("left")
    vary = [read_variation(mech, text) for text in ("length(crank) 35..45 mm", "length(coupler) 90..130 mm", "at 20..70 deg")]
    assert [one.name for one in vary] == ["pin.A.length", "pin.B.length[0]", "at"]
    students = ["Ada", "=Émile", "Grace"]
    found = list(exercises(mech, vary, students, "40 deg", seed=1))
    for one in found:
        again = udk.worked_solution(mech.with_parameters({"pin.A.length": one.numbers["length(crank)"] * 1e-3,
            "pin.B.length[0]": one.numbers["length(coupler)"] * 1e-3}), f"{one.numbers['at']} deg")  # fmt: skip
        np.testing.assert_allclose([*one.answers().values()][:6], [*_answers(again)][:6], rtol=1e-9)
        assert one.solution.residual < 1e-9
    places = [tuple(one.answers().values()) for one in found]
    assert len({round(x[0], 6) for x in places}) == 3
    first = write_exercises("", found, vary, tmp_path / "one")
    write_exercises("", list(exercises(mech, vary, students, "40 deg", seed=1)), vary, tmp_path / "two")
    assert len(first) == 7
    assert all(file.read_bytes() == (tmp_path / "two" / file.name).read_bytes() for file in first)
    assert "'=Émile" in (tmp_path / "one" / "teacher.csv").read_text(encoding="utf-8")


def _answers(solution):
    from udkjax.study.worked.exercises import Exercise

    return Exercise("", {}, solution).answers().values()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("length(crank)", "must be a number and its range"),
        ("length(crank) 45..35 mm", "must increase"),
        ("length(crank) 35..1e999 mm", "between finite numbers"),
        ("length(crank) 3.5.1..45 mm", "3.5.1"),
        ("length(krank) 35..45 mm", 'did you mean "crank"'),
        ("length(crank) 35..45 kg", "does not fit"),
        ("pin.Q.length 1..2", "no number named"),
    ],
)
def test_mistakes_in_ranges_are_explained(text, message):
    with pytest.raises(udk.SceneError, match=re.escape(message)):
        read_variation(four_bar("left"), text)


def _texts(svg: str) -> list[tuple[str, float, float, float]]:
    """Return the texts of a figure with their middles and usual widths, some of which have an index."""
    found = []
    for x, y, words in re.findall(r'<text x="([\d.-]+)" y="([\d.-]+)"[^>]*>(.*?)</text>', svg):
        plain = re.sub("<[^>]*>", "", words)
        found.append((plain, float(x), float(y) - 4.5, 0.58 * 13.0 * len(plain)))
    return found


@pytest.mark.parametrize("name", [*EXERCISES, *TRIADS])
def test_texts_of_figures_cover_neither_each_other_nor_leave_the_figure(solutions, name, tmp_path):
    solutions[name].save(tmp_path / "page.html")
    for svg in re.findall("<svg.*?</svg>", (tmp_path / "page.html").read_text(), re.DOTALL):
        view = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)
        assert view is not None
        width, height = map(float, view.groups())
        texts = _texts(svg)
        for k, (words, x, y, wide) in enumerate(texts):
            assert wide / 2 - 1 < x < width - wide / 2 + 1 and 6 < y < height - 6, words
            for other, x2, y2, wide2 in texts[:k]:
                assert abs(x - x2) > 0.45 * (wide + wide2) or abs(y - y2) > 10.0, (words, other)
