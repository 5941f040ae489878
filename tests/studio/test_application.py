"""The five routes: list, open, save, compile, diagnose."""

import math

import numpy as np
import pytest

import udkjax as udk
from udkjax.studio.findings import pins_in_line
from udkjax.studio.limits import RefusedError
from udkjax.studio.shown_runs import duration_of
from udkjax.studio.tasks import DRAWN_TEMPLATES, LIBRARY_TEMPLATES, template_text
from udkjax.studio.worker import Worker, WorkerPool

SIX_BAR = """format = 2
name = "six-bar" # of the studio's test
units = {length = "mm"}
ground = ["O2", "O4", "O6"]
motor = [{pin = "O2", speed = "60 rpm"}]

[pins]
O2 = [0, 0]
A = [30, 40]
B = [160, 110]
C = [110, 160]
O4 = [180, 0]
D = [250, 150]
O6 = [250, 20]
"""
BOOM = """format = 2
units = {length = "mm"}
ground = ["O", "C"]
link = [{name = "boom", pins = ["O", "A", "T"], mass = 50, width = 80}]
LIFT
[pins]
O = [0, 0]
C = [300, -200]
A = [500, 150]
T = [1500, 450]
"""
for _name, _pins, _width in (
    ("crank", "O2 A", 15),
    ("coupler", "A B C", 0),
    ("rocker", "O4 B", 15),
    ("floating", "C D", 15),
    ("output", "O6 D", 15),
):
    SIX_BAR += f'\n[[link]]\nname = "{_name}"\npins = {_pins.split()}\ndensity = 7850\nthickness = 5\n'.replace("'", '"')
    SIX_BAR += f"width = {_width}\n" if _width else ""
ARMS = """format = 2
ground = ["O", "C"]
motor = [{pin = "O", speed = 1}]
[pins]
O = [0, 0]
A = [0, 1]
B = [1.5, 1.5]
C = [2, 0]
[[link]]
name = "crank"
pins = ["O", "A"]
mass = 1
[[link]]
name = "coupler"
pins = ["A", "B"]
mass = 1
[[link]]
name = "rocker"
pins = ["B", "C"]
mass = 1
"""


def test_files_and_templates_are_listed(client):
    (client.folder / "a.toml").write_text(SIX_BAR)
    found = client.ask("list").json()
    assert found["files"] == ["a.toml"]
    assert [t["name"] for t in found["templates"]] == [*DRAWN_TEMPLATES, *LIBRARY_TEMPLATES]


def test_a_file_is_opened_changed_and_saved(client):
    (client.folder / "a.toml").write_text(SIX_BAR)
    opened = client.ask("open", path="a.toml").json()
    assert opened["text"] == SIX_BAR and opened["problems"] == [] and not opened["drawn"]
    document = opened["document"]
    document["pins"]["D"] = [255, 150]
    compiled = client.ask("compile", text=opened["text"], document=document).json()
    assert compiled["text"] == SIX_BAR.replace("D = [250, 150]", "D = [255, 150]")
    assert compiled["problems"] == []
    saved = client.ask("save", path="a.toml", text=compiled["text"], revision=opened["revision"])
    assert saved.status_code == 200
    assert (client.folder / "a.toml").read_text() == compiled["text"]
    again = client.ask("save", path="a.toml", text=SIX_BAR, revision=opened["revision"])
    assert again.status_code == 409 and again.json()["revision"] == saved.json()["revision"]


def test_a_scene_has_the_frames_of_its_bodies(client):
    scene = client.ask("compile", text=SIX_BAR).json()["scene"]
    mechanism = udk.loads(SIX_BAR)
    assert scene["bodies"] == list(mechanism.bodies)
    frames = [[*np.asarray(b.position), float(b.angle)] for b in mechanism.bodies.values()]
    np.testing.assert_array_equal(scene["frames"], frames)
    assert scene["duration"] == 2.0  # two turns at 60 rpm


def test_a_recorded_motion_is_that_of_the_engine(client):
    motion = client.ask("compile", text=SIX_BAR, engine="recorded").json()["motion"]
    run = udk.simulate(udk.loads(SIX_BAR), np.array(motion["times"]), rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(np.reshape(motion["q"], run.q.shape), np.asarray(run.q))


def test_mistakes_come_with_the_drawing(client):
    answer = client.ask("compile", text=SIX_BAR.replace('"C", "D"', '"C"').replace("width = 15", ""), document=None).json()
    assert answer["document"]["name"] == "six-bar" and answer["scene"] is None
    assert any("width" in problem for problem in answer["problems"])
    broken = client.ask("compile", text="format = ").json()
    assert broken["document"] is None and "TOML" in broken["problems"][0]


def test_places_that_are_not_finite_are_named(client):
    answer = client.ask("compile", text=SIX_BAR.replace("D = [250, 150]", "D = [nan, inf]"))
    assert answer.status_code == 200
    assert answer.json()["scene"] is None and "D" in answer.json()["problems"][0]
    assert answer.json()["document"]["pins"]["D"] == ["nan", "inf"]


def test_a_hundred_thousand_pins_are_refused_at_once(client):
    text = "format = 2\n[pins]\n" + "".join(f"p{k}=[{k},0]\n" for k in range(100_000))
    for route in ("compile", "diagnose"):
        answer = client.ask(route, text=text)
        assert answer.status_code == 413 and "characters" in answer.json()["problem"]
    document = {"format": 2, "pins": {f"p{k}": [k, 0] for k in range(2_000)}}
    assert client.ask("compile", text="", document=document).status_code == 413


def test_files_of_format_1_are_converted(client):
    (client.folder / "old.toml").write_text(udk.dumps(udk.library.parallelogram()))
    opened = client.ask("open", path="old.toml").json()
    assert opened["drawn"] and opened["document"]["format"] == 2


def test_the_paper_linkage_is_diagnosed(client):
    text = client.ask("open", template="parallelogram").json()["text"]
    found = client.ask("diagnose", text=text).json()
    assert (found["degrees_of_freedom"], found["redundant"]) == (1, 1)
    assert found["sets"][0]["constraints"] == ["A1", "A2", "A3", "B1", "B2", "B3"]
    assert {fix["constraint"] for fix in found["sets"][0]["fixes"]} == {"A1", "A2", "A3", "B1", "B2", "B3"}
    assert set(found["not_unique"]) == {"A1", "A2", "A3", "B1", "B2", "B3"}
    assert found["motion"] == "Gravity and loads move the mechanism; add a motor to drive it"


def test_a_triangle_is_said_not_to_move(client):
    text = (
        ARMS.replace('motor = [{pin = "O", speed = 1}]', "")
        .replace('["B", "C"]', '["B", "C"]')
        .replace('ground = ["O", "C"]', 'ground = ["O", "C", "A"]')
    )
    found = client.ask("diagnose", text=text).json()
    assert found["degrees_of_freedom"] == 0 and "cannot move" in found["motion"]


@pytest.mark.slow
def test_the_limits_of_a_motor_and_the_pins_in_line_there_are_found(client):
    text = ARMS.replace("A = [0, 1]", "A = [0, 2]")
    (found,) = client.ask("diagnose", text=text, about="travel").json()["travel"]
    # Crank and ground have length 2, coupler and rocker sqrt(2.5): these two are in line when A and C are sqrt(10) apart.
    expected = math.acos((4 + 4 - 10) / 8)
    (end,) = [end for end in found["ends"] if end["value"] > 0]
    assert found["motor"] == "motor1"
    assert math.isclose(end["value"], expected, abs_tol=1e-12)
    assert end["in_line"] == [["A", "B", "C"]]


@pytest.mark.slow
def test_curves_of_forces_and_powers_agree_with_the_work_done(client):
    found = client.ask("diagnose", text=SIX_BAR, about="dynamics").json()
    names = {curve["name"] for curve in found["curves"]}
    assert {"motor1: driving torque", "motor1: power", "kinetic energy", "violation", "B: force on rocker"} <= names
    curves = {curve["name"]: np.array(curve["values"]) for curve in found["curves"]}
    work = np.concatenate(
        [[0], np.cumsum(np.diff(found["times"]) * (curves["motor1: power"][1:] + curves["motor1: power"][:-1]) / 2)]
    )
    change = curves["work of drivers and loads"]
    assert np.abs(work - change).max() < 1e-3 * np.abs(change).max()  # the error of the trapezoidal rule at 401 instants


def test_an_arm_is_held_by_a_torque(client):
    """An arm of 2 kg and 1 m, turned by a motor from the vertical, is held at rest by the torque m g sin(angle) / 2."""
    arm = 'format = 2\nground = ["O"]\n[pins]\nO = [0, 0]\nA = [0, 1]\n[[link]]\nname = "arm"\npins = ["O", "A"]\nmass = 2\n'
    found = client.ask("diagnose", text=arm + '[[motor]]\npin = "O"\nspeed = 3\n', about="holding").json()
    curves, times = {curve["name"]: curve["values"] for curve in found["curves"]}, np.array(found["times"])
    np.testing.assert_allclose(curves["motor1: holding torque"], -9.81 * np.sin(3 * times), atol=1e-9)
    np.testing.assert_allclose(curves["O: force on arm"], 2 * 9.81, rtol=1e-12)
    (problem,) = client.ask("diagnose", text=arm, about="holding").json()["problems"]
    assert "motors do not hold the whole mechanism" in problem


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["html", "svg", "csv", "py", "gif", "dxf", "png"])
def test_exports_are_written_into_the_folder(client, suffix):
    answer = client.ask("save", path=f"out.{suffix}", text=SIX_BAR, revision=None, export=True)
    assert answer.status_code == 200, answer.text
    data = (client.folder / f"out.{suffix}").read_bytes()
    assert len(data) == answer.json()["bytes"] > 500


def test_an_exported_script_holds_the_drawing():
    from udkjax.studio.exports import script

    hostile = SIX_BAR.replace("six-bar", "a \\\"\\\"\\\" b ''' {x} %s")
    code = script(udk.loads(hostile), hostile)
    names = {}
    exec(compile(code.split("mech = ")[0], "script", "exec"), names)
    assert names["SCENE"] == hostile


def test_unknown_templates_are_refused(client):
    for name in ("nothing", "../four_bar", None, 3, {"a": 1}):
        assert client.ask("open", template=name).status_code == 404


@pytest.mark.slow
def test_a_task_that_takes_too_long_is_stopped_and_the_next_is_served(tmp_path):
    worker = Worker(tmp_path)
    try:
        with pytest.raises(RefusedError, match="longer than"):
            worker.call("list_templates", {}, 0.001)  # less than the imports take
        assert worker.call("list_templates", {}, 60.0)["templates"]
        with pytest.raises(RefusedError, match="no template"):
            worker.call("open_template", {"name": "nothing"}, 60.0)
        outline = '[[link]]\nname = "arm"\nmass = 1\npins = ["A"]\noutline = "arm.dxf"'
        text = f'format = 2\nground = ["A"]\n[pins]\nA = [0, 0]\n{outline}\n'
        (tmp_path / "arm.dxf").write_text("")  # found in the folder of the studio, and no outline
        assert "No such file" not in worker.call("compile_drawing", {"text": text}, 60.0)["problems"][0]
    finally:
        worker.close()


def test_fixes_are_changes_of_the_drawing(client):
    text = client.ask("open", template="parallelogram").json()["text"]
    fixes = client.ask("diagnose", text=text).json()["sets"][0]["fixes"]
    for fix in fixes:
        (slot,) = fix["document"]["slot"]
        assert slot.get("on", "the ground") in fix["change"]
        np.testing.assert_allclose(slot["direction"], [np.sqrt(0.5), -np.sqrt(0.5)], atol=1e-12)  # along the crank, as drawn


@pytest.mark.slow
def test_the_engine_takes_places_of_pins_and_the_one_for_pulling_has_no_motors(client):
    answer = client.ask("compile", text=SIX_BAR, engine="wasm").json()
    names = [parameter["name"] for parameter in answer["engine"]["parameters"]]
    assert names == [f"pin.{pin}[{k}]" for pin in answer["pins"] for k in (0, 1)]
    assert set(answer["engine"]["modules"]) == {"run", "close", "evaluate"}
    assert set(answer["hand"]["modules"]) == {"close", "evaluate"}  # it closes positions, and runs no motion
    assert len(answer["hand"]["rows"]) == len(answer["engine"]["rows"]) - 1
    motor = {"name": "motor1", "effort": "motor1: driving torque", "unit": "N m", "pair": [-1, 0], "offset": 0.0}
    assert answer["scene"]["drivers"] == [motor]


@pytest.mark.slow
def test_pins_of_any_form_have_an_engine_that_takes_their_places(client):
    text = SIX_BAR.replace("A = [30, 40]", 'A = {from = "O2", length = 50, angle = 53}')
    answer = client.ask("compile", text=text, engine="wasm").json()
    assert answer["problems"] == [] and answer["why"] == "" and answer["document"]["pins"]["A"]["length"] == 50
    names = [parameter["name"] for parameter in answer["engine"]["parameters"]]
    assert names == [f"pin.{pin}[{k}]" for pin in answer["pins"] for k in (0, 1)]


def test_a_cylinder_is_in_the_page_s_engine_but_not_in_the_one_for_pulling(client):
    text = BOOM.replace("LIFT", 'motor = [{between = ["C", "A"], speed = "20 mm/s"}]')
    answer = client.ask("compile", text=text, engine="wasm").json()
    assert answer["why"] == "" and len(answer["hand"]["rows"]) == len(answer["engine"]["rows"]) - 1
    assert answer["scene"]["drivers"] == [{"name": "motor1", "effort": "motor1: driving force", "unit": "N"}]
    (travel,) = client.ask("diagnose", text=text, about="travel").json()["travel"]
    reach = [math.hypot(500, 150) + sign * math.hypot(300, 200) for sign in (-1, 1)]  # mm: C is in line with O and A
    np.testing.assert_allclose([1e3 * end["value"] for end in travel["ends"]], reach, rtol=1e-6)
    assert travel["words"] == "the distance C-A"


def test_a_mechanism_at_rest_has_a_finite_duration(client):
    scene = client.ask("compile", text=SIX_BAR.replace("60 rpm", "0 rpm")).json()["scene"]
    assert 0 < scene["duration"] < 100
    nothing_moves_it = ARMS.replace('motor = [{pin = "O", speed = 1}]', "gravity = [0, 0]")
    assert client.ask("compile", text=nothing_moves_it).json()["scene"]["duration"] == 1.0


def test_a_run_of_a_slide_lasts_until_it_has_crossed_the_mechanism():
    """A block at 2 mm/s moves in a run by about the length of the link that it pulls; a few swings would be too short."""
    links = {"block": udk.Link(["P"], mass=1.0, width=0.01), "arm": udk.Link(["P", "Q"], mass=1.0)}
    slides, motors = {"guide": {"link": "block", "direction": [0, 1]}}, {"push": {"slide": "guide", "speed": -0.002}}
    mech = udk.Drawing({"P": (0, 0), "Q": (0.2, 0)}, links, slides=slides, motors=motors).mechanism()
    assert 0.05 < 0.002 * duration_of(mech) < 0.4


def test_all_pins_of_a_line_are_named_once():
    pins = {"A": (0, 0), "B": (1, 0), "C": (2, 0), "D": (3, 0)}
    links = {f"{a}{b}": udk.Link([a, b], mass=1) for a, b in ("AB", "BC", "CD")}
    chain = udk.Drawing(pins=pins, links=links, ground=["A", "D"]).mechanism()
    (line,) = pins_in_line(chain, np.asarray(chain.q0))
    assert sorted(line) == list(pins)


@pytest.mark.parametrize("document", [[1], "x", 3, True])
def test_a_document_that_is_not_an_object_is_refused(client, document):
    answer = client.ask("compile", text="", document=document)
    assert answer.status_code == 400 and "document: must be an object" in answer.text


def test_unknown_subjects_are_refused(client):
    text = client.ask("open", template="four_bar").json()["text"]
    for about in ({"a": 1}, ["structure"], "__class__", 3):
        assert client.ask("diagnose", text=text, about=about).status_code == 400


def test_deeply_nested_tables_are_a_mistake(client):
    answer = client.ask("compile", text=f"[{'.'.join(['a'] * 2000)}]\nx = 1").json()
    assert answer["problems"] == ["line 1: a key with more than 100 parts between dots; three are enough"]


def test_an_infinite_length_is_reported(client):
    """With a mass of almost zero the radius of gyration is infinite, and JSON has no infinity."""
    text = client.ask("open", template="parallelogram").json()["text"].replace("mass = 1.0", "mass = 1e-320")
    answer = client.ask("compile", text=text)
    assert answer.status_code == 200 and "characteristic length is infinite" in answer.json()["problems"][0]


def test_a_name_is_not_a_formula_in_a_table(client):
    """A spreadsheet computes a cell that begins with an equals sign, unless an apostrophe precedes it."""
    name = "=HYPERLINK(0)"
    text = f'format = 2\nground = ["A"]\n[pins]\nA = [0, 0]\nB = [1, 0]\n[[link]]\nname = "{name}"\npins = ["A", "B"]\nmass = 1\n'
    assert client.ask("save", text=text, path="x.csv", export=True).status_code == 200
    header = (client.folder / "x.csv").read_text().splitlines()[0].split(",")
    assert header[1] == f"'{name} x (m)" and not any(cell.startswith(("=", "+", "-", "@")) for cell in header)


def test_motors_that_contradict_each_other_are_named(client):
    text = ARMS.replace('{pin = "O", speed = 1}', '{pin = "O", speed = 1}, {pin = "C", speed = -3}')
    found = client.ask("diagnose", text=text).json()
    assert found["conflict"] == 'motors "motor1" and "motor2" contradict each other: delete one, or change its speed.'
    assert client.ask("diagnose", text=ARMS).json()["conflict"] == ""


def test_the_end_of_a_run_is_refused_unless_it_is_a_state(client):
    for end in ({}, {"t": 0, "end": 1, "q": [0] * 8, "v": [0] * 9}, {"t": 0, "end": 1, "q": ["x"] * 9, "v": [0] * 9}):
        assert client.ask("diagnose", text=ARMS, about="end", end=end).status_code == 400


@pytest.mark.parametrize("name", DRAWN_TEMPLATES)
def test_a_drawn_template_moves_in_millimetres(client, name):
    opened = client.ask("open", template=name).json()
    mechanism = udk.loads(opened["text"])
    assert opened["document"]["units"]["length"] == "mm" and opened["problems"] == []
    assert mechanism.drivers or name == "door_closer"
    np.testing.assert_allclose(udk.assemble(mechanism).q, mechanism.q0, atol=1e-4)  # closed as drawn


def test_a_task_is_given_to_a_free_worker():
    class Stub:
        def __init__(self, is_busy):
            self.is_busy = is_busy

        def call(self, *_):
            return {"is_busy": self.is_busy, "worker": self}

    pool = WorkerPool(2)
    pool.workers = [Stub(True), Stub(False)]  # pyright: ignore[reportAttributeAccessIssue]
    assert pool.call("compile_drawing", {}, 1.0)["worker"] is pool.workers[1]
    pool.workers[1] = Stub(True)  # pyright: ignore[reportArgumentType, reportCallIssue]
    assert pool.call("compile_drawing", {}, 1.0)["worker"] is pool.workers[0]


def test_klann_s_foot_steps_along_a_line():
    """Its foot is on the ground, within a tenth of its step, for nearly half of a turn."""
    leg = udk.loads(template_text("klann_leg"))
    foot = np.asarray(udk.motion_at(leg, list(range(361))).pins["G"])[:, 0]
    step, lift = np.ptp(foot, axis=0)
    assert 0.06 < step < 0.07 and 0.3 < lift / step < 0.6
    low = foot[foot[:, 1] < foot[:, 1].min() + 0.05 * step]
    assert len(low) > 0.45 * len(foot) and np.ptp(low[:, 0]) > 0.95 * step


def test_gaps_are_those_of_the_function_with_outlines_as_drawn(client):
    mech, shown = udk.loads(SIX_BAR), client.ask("diagnose", text=SIX_BAR, about="gaps").json()
    found = udk.gaps(mech)
    assert [(row["words"], row["gap"], row["at"]) for row in shown["gaps"]] == found.rows()
    assert [row["touches"] for row in shown["gaps"]] == [gap.distance <= 0 for gap in found.pairs]
    assert shown["remarks"] == found.remarks() and shown["counted"] == "the angle of O2-A from the x axis"
    least = udk.kinematics(mech, "motor1", [found.least.value])
    assert np.array(shown["gaps"][0]["q"]).reshape(-1, 3) == pytest.approx(np.asarray(least.q)[0], abs=1e-9)
    of = {mech.body_names[part["body"]]: part for part in shown["parts"]}
    ends = sorted(map(tuple, of["crank"]["points"]))
    assert np.array(ends) == pytest.approx(np.array([[0.0, 0.0], [0.03, 0.04]]), abs=1e-12) and of["crank"]["radius"] == 0.0075
    assert [
        sorted({mech.body_names[shown["parts"][k]["body"]] for k in numbers}) for pair in shown["pairs"] for numbers in pair
    ] == [[name] for gap in found.pairs for name in gap.pair]
    bare = SIX_BAR.replace("density = 7850\nthickness = 5\nwidth = 15", "mass = 1", 1)
    assert "no width" in client.ask("diagnose", text=bare, about="gaps").json()["problems"][0]
