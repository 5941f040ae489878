"""`udkjax design`: goals in files, written files, and messages about mistakes."""

import json
from pathlib import Path

import numpy as np
import pytest

import udkjax as udk
from tests.command_line import udkjax

GOALS = Path(__file__).parents[3] / "examples" / "goals"
GOAL = """
mechanism = "four_bar.toml"
units = {length = "mm", angle = "deg"}
transmission = 10
[goal]
kind = "path"
point = "P"
targets = [[20, 10], [5, 17], [0, 7]]
[bounds]
"pin.O" = [[-80, -80], [80, 80]]
[[length]]
pins = ["O", "A"]
least = 2
most = 60
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "four_bar.toml").write_text((GOALS / "four_bar.toml").read_text())
    return tmp_path


@pytest.mark.slow
def test_designs_are_found_shown_and_written(folder, capsys):
    goal = folder / "goal.toml"
    goal.write_text(GOAL)
    assert udkjax("design", goal, "--starts", 30, "--results", 1, "--out", folder / "out", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    (one,) = found["designs"]
    report = one["report"]
    assert report["deviation"] == "at most 0 mm off on a path of 27.7333 mm"
    assert (
        report["pin P"] == "20, 10 mm"
        and report["type"].startswith(("crank-rocker", "double crank"))  # which one is found first depends on the last digits
        and "deg at B" in report["transmission angle"]
    )
    assert report["lengths of crank"].startswith("O-A ") and report["lengths of crank"].endswith(" mm")
    assert one["loss"] < 1e-20 and one["turns"] and one["transmission"] >= np.sin(np.deg2rad(10)) - 1e-6
    mech = udk.load(folder / "out" / "design1.toml")
    np.testing.assert_allclose(mech.parameters()["pin.P"], [0.02, 0.01], atol=1e-9)
    np.testing.assert_allclose(mech.parameters()["pin.A"], one["parameters"]["pin.A"], rtol=1e-9, atol=1e-12)
    assert 0.002 * (1 - 1e-6) <= np.linalg.norm(np.subtract(one["parameters"]["pin.A"], one["parameters"]["pin.O"])) <= 0.06
    page = (folder / "out" / "design1.html").read_text()
    assert len(page) > 10_000 and page.count('"kind":"target"') == 3 and '"live":{' in page and '"motor.motor' in page


@pytest.mark.slow
def test_a_design_far_from_its_goal_has_an_exit_code_of_its_own_and_targets_come_from_a_table(folder, capsys):
    """A crank of at most 8 mm cannot lead a point along such a zigzag."""
    (folder / "path.csv").write_text("x,y,remark\n0,0,start\n40,60,\n80,-60,\n120,60,\n160,0,end\n")
    goal = folder / "goal.toml"
    goal.write_text(GOAL.replace("[[20, 10], [5, 17], [0, 7]]", '"path.csv"').replace("most = 60", "most = 8"))
    assert udkjax("design", goal, "--starts", 30, "--results", 1) == 3
    printed = capsys.readouterr()
    assert "not a fit: at most " in printed.out and "mm off on a path of 397." in printed.err
    (folder / "path.csv").write_text("x,y\n0,0\n40\n80,1\n")
    assert udkjax("design", goal) == 2
    assert "goal.targets: line 3 of path.csv must begin with 2 numbers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('kind = "path"', 'kind = "pat"', "goal.kind must be one of"),
        ('point = "P"', 'pont = "P"', 'goal.pont: unknown key; did you mean "point"?'),
        ('point = "P"', "", "goal.point: missing"),
        ('point = "P"', 'point = "P"\nbody = 1', "goal.body: unknown key; known are point, targets, values"),
        ("transmission = 10", "transmision = 10", "did you mean"),
        ('pins = ["O", "A"]', 'pins = ["O"]', "must name two pins"),
        ('"pin.O" =', '"pin.Q" =', "is not free"),
        ("[5, 17]", "[5]", "targets"),
        ('"four_bar.toml"', '"five_bar.toml"', "cannot read"),
        ("[goal]", "[goal", "not valid TOML"),
    ],
)
def test_mistakes_in_a_goal_are_named(folder, capsys, old, new, says):
    goal = folder / "goal.toml"
    goal.write_text(GOAL.replace(old, new))
    assert udkjax("design", goal) == 2
    assert says in capsys.readouterr().err


POSES = """
mechanism = "four_bar.toml"
complete = true
units = {length = "cm", angle = "deg"}
[goal]
kind = "poses"
body = "coupler"
pin = "P"
targets = [[1, 1, 0], [2, 0.5, 0], [3, 1.5, 40], [2, 2, 86], [1.5, 1.9, 109]]
"""


def test_all_four_bars_are_found_shown_and_written(folder, capsys):
    goal = folder / "goal.toml"
    goal.write_text(POSES)
    assert udkjax("design", goal, "--results", 1, "--out", folder / "out", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["solutions"]["dyads"] == 4 and found["classes"] in (2, 4) and found["unproven"] == 0
    (one,) = found["designs"]
    mech = udk.load(folder / "out" / "design1.toml")
    np.testing.assert_allclose(mech.parameters()["pin.P"], [0.01, 0.01], atol=1e-12)
    np.testing.assert_allclose(mech.parameters()["pin.A"], one["pins"]["A"], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("complete = true", "complete = 1", "must be true or false"),
        ("complete = true", "complete = true\nfree = ['pin.A']", "leave it out"),
        (", [1.5, 1.9, 109]", "", "five poses; there are 4"),
        ('pin = "P"', "", "name the pin"),
        ('kind = "poses"', 'kind = "function"', "unknown key"),
    ],
)
def test_mistakes_of_complete_goals_are_told(folder, capsys, old, new, says):
    (folder / "goal.toml").write_text(POSES.replace(old, new))
    assert udkjax("design", folder / "goal.toml") == 2
    assert says in capsys.readouterr().err


def test_a_curve_is_drawn_by_mechanisms_shown_and_written(tmp_path, capsys):
    file = tmp_path / "arc.csv"
    file.write_text("x,y\n" + "\n".join(f"{30 * np.cos(t)},{20 * np.sin(t)}" for t in np.linspace(0.0, 3.0, 30)))
    options = ("--bars", 4, "--seconds", 0, "--results", 1, "--out", tmp_path / "out", "--json")
    assert udkjax("design", "--curve", file, *options) == 0
    best = json.loads(capsys.readouterr().out)["designs"][0]
    assert best["error"] < 0.1 and best["bars"] == 4 and best["turns"] and best["size"] < 0.2
    drawing = udk.load(tmp_path / "out" / "design1.toml").drawing
    assert drawing is not None and dict(drawing.units) == {"length": "mm"}
    np.testing.assert_allclose(drawing.pins["O"], best["pins"]["O"], atol=1e-12)
    assert "<html" in (tmp_path / "out" / "design1.html").read_text()[:200]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give either"),
        (("--curve", "curve.csv", "--unit", "parsec"), "--unit parsec"),
        (("--curve", "absent.csv"), "cannot read absent.csv"),
        (("--curve", "curve.csv", "--bars", 3), "--bars must be at least 4"),
        (("--curve", "curve.csv", "--seconds", "nan"), "--seconds nan: must be finite"),
        (("--curve", "curve.csv", "--out", "curve.csv"), "cannot write --out curve.csv"),
        (("--curve", "curve.csv", "--size", 1), "--size must be more than"),
        (("--curve", "point.csv"), "coincide"),
        (("--curve", "wrong.svg"), "not an SVG file"),
    ],
)
def test_curves_and_options_with_mistakes(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "curve.csv").write_text("0,0\n9,0\n9,9\n")
    (tmp_path / "point.csv").write_text("1,1\n1,1\n1,1\n")
    (tmp_path / "wrong.svg").write_text("no picture")
    assert udkjax("design", *arguments) == 2
    assert message in capsys.readouterr().err
