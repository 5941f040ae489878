"""Numbers of options, options without an effect, and the names of options in messages."""

import inspect
import re
from typing import get_args, get_type_hints

import pytest

from tests.command_line import udkjax
from udkjax.cli import COMMANDS, command
from udkjax.cli.motion.animate import animate
from udkjax.cli.motion.gaps import gaps
from udkjax.cli.options import OPTION_WORDS, in_option_words, option_names

CRANK = """format = 2
units = {length = "mm", angle = "deg"}
ground = ["O", "C"]
motor = [{pin = "O", speed = "60 rpm"}]
link = [
  {name = "crank", pins = ["O", "A"], mass = 0.1},
  {name = "coupler", pins = ["A", "B"], mass = 0.3},
  {name = "rocker", pins = ["C", "B"], mass = 0.2},
]
[pins]
O = [0, 0]
C = [100, 0]
A = {from = "O", length = 40, angle = 60}
B = {from = ["A", "C"], length = [120, 80], side = "left"}
"""
FLOAT_OPTIONS = [
    (name, option)
    for name in COMMANDS
    for parameter, option in option_names(command(name)).items()
    if float in (hint := get_type_hints(command(name))[parameter], *get_args(hint))
]


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """Return the name of a drawing of a four-bar, in the current folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "crank.toml").write_text(CRANK)
    return "crank.toml"


def required_words(name: str) -> list[str]:
    """Return words for everything that a command requires."""
    function, words = command(name), []
    hints, names = get_type_hints(function), option_names(function)
    for parameter in inspect.signature(function).parameters.values():
        if parameter.default is parameter.empty:
            word = "1" if hints[parameter.name] is float else "x.html"
            words += [names[parameter.name], word] if parameter.name in names else [word]
    return words


def test_there_are_options_with_numbers():
    assert {("simulate", "--rank-tol"), ("animate", "--fps"), ("tolerances", "--cheapest")} <= set(FLOAT_OPTIONS)


@pytest.mark.parametrize(("name", "option"), FLOAT_OPTIONS)
@pytest.mark.parametrize("number", ["nan", "inf", "1e400"])
def test_a_number_that_is_not_finite_is_refused_by_the_name_of_its_option(scene, capsys, name, option, number):
    words = required_words(name)
    if option in words:
        words[words.index(option) + 1] = number
    else:
        words += [option, number]
    assert udkjax(name, *words) == 2
    assert f"{option} {float(number):g}: must be finite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["kinematics", "{scene}", "--at"], "--at"),
        (["kinematics", "{scene}", "--from", "0", "--to"], "--to"),
        (["gaps", "{scene}", "--to", "0", "--from"], "--from"),
        (["gaps", "{scene}", "--width"], "--width"),
        (["solve", "{scene}", "--at"], "--at"),
        (["exercise", "{scene}", "--vary", "pin.A.length 35..45", "--out", "x", "--count", "1", "--at"], "--at"),
        (["tolerances", "{scene}", "--tol", "pin.A.length=1", "--measure", "max(pin.B.x)", "--to", "9", "--from"], "--from"),
    ],
)
@pytest.mark.parametrize("number", ["nan", "inf", "1e400 deg"])
def test_a_text_with_a_number_that_is_not_finite_is_refused_by_the_name_of_its_option(scene, capsys, words, option, number):
    assert udkjax(*(word.format(scene=scene) for word in words), number) == 2
    assert re.search(rf"{option}:? .*(must be|does not fit)", capsys.readouterr().err)


@pytest.mark.parametrize(
    "words",
    [
        ["animate", "x.toml", "--out", "x.gif", "--fps", "0"],
        ["animate", "x.toml", "--out", "x.gif", "--speed", "-1"],
        ["animate", "x.toml", "--out", "x.png", "--width", "0"],
        ["kinematics", "x.toml", "--count", "0"],
        ["statics", "x.toml", "--starts", "0"],
        ["statics", "x.toml", "--starts", "2", "--seed", "-1"],
        ["tolerances", "x.toml", "--tol", "a=1", "--measure", "b", "--from", "0", "--to", "1", "--count", "0"],
        ["tolerances", "x.toml", "--tol", "a=1", "--measure", "b", "--samples", "-1"],
        ["tolerances", "x.toml", "--tol", "a=1", "--measure", "b", "--seed", "-1"],
        ["tolerances", "x.toml", "--tol", "a=1", "--measure", "b", "--limit", "b=1", "--cheapest", "2"],
        ["tolerances", "x.toml", "--tol", "a=1", "--measure", "b", "--cheapest", "0.9"],
        ["design", "x.toml", "--results", "0"],
        ["design", "--curve", "x.csv", "--seconds", "-1"],
        ["design", "--curve", "x.csv", "--size", "0"],
        ["exercise", "x.toml", "--vary", "a 1..2", "--out", "x", "--count", "0"],
        ["exercise", "x.toml", "--vary", "a 1..2", "--out", "x", "--count", "2", "--seed", "-1"],
        ["sweep", "x.toml", "y.toml", "--out", "x", "--memory", "0"],
        ["report", "--seed", "-1"],
    ],
    ids=lambda words: f"{words[0]} {words[-2]}",
)
def test_counts_and_sizes_beyond_their_limits_are_refused_by_name(scene, capsys, words):
    assert udkjax(*words) == 2
    assert re.match(rf"udkjax: {words[-2]} {words[-1]}: (must (not )?be|a yield needs limits)", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("words", "option", "other"),
    [
        (["simulate", "x.toml", "--t1", "1", "--out", "x.nc", "--alpha", "9"], "--alpha", "--stabilization baumgarte"),
        (["simulate", "x.toml", "--t1", "1", "--out", "x.nc", "--beta=5"], "--beta", "--stabilization baumgarte"),
        (
            ["simulate", "x.toml", "--t1", "1", "--out", "x.nc", "--formulation", "augmented", "--stabilization", "none"]
            + ["--method", "svd"],
            "--method",
            "--formulation augmented",
        ),
        (["animate", "x.toml", "--out", "x.html", "--t", "1"], "--t", "--out x.html"),
        (["animate", "x.toml", "--out", "x.html", "--fps", "9"], "--fps", "--out x.html"),
        (["animate", "x.toml", "--out", "x.gif", "--autoplay"], "--autoplay", "--out x.gif"),
        (["animate", "x.toml", "--out", "x.dxf", "--theme", "dark"], "--theme", "--out x.dxf"),
        (["animate", "x.nc", "--out", "x.html", "--t1", "2"], "--t1", "for scenes"),
        (["diagnose", "x.toml", "--dt", "0.1"], "--dt", "--t1"),
        (["statics", "x.toml", "--seed", "2"], "--seed", "--starts"),
        (["tolerances", "x.toml", "--tol", "a=1", "--measure", "b", "--count", "9"], "--count", "--from and --to"),
        (["export", "x.toml", "--fmu", "x.fmu", "--what", "run"], "--what", "--fmu"),
        (["export", "x.toml", "--c", "x", "--inputs", "a"], "--inputs", "--fmu"),
        (["design", "x.toml", "--no-geared"], "--geared", "--curve"),
        (["design", "--curve", "x.csv", "--starts", "9"], "--starts", "--curve"),
        (["report", "--from", "x.nc", "--quick"], "--quick", "--from"),
        (["exercise", "x.toml", "--vary", "at 1..9", "--at", "5", "--count", "1", "--out", "x"], "--at", "--vary"),
    ],
    ids=lambda x: x if isinstance(x, str) else x[0],
)
def test_an_option_without_effect_is_refused_with_the_one_that_makes_it_so(scene, capsys, words, option, other):
    assert udkjax(*words) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"udkjax: {option} has no effect ") and other in said


@pytest.mark.parametrize("time", ["7", "-1", "0.9"])
def test_a_time_outside_of_the_run_is_refused_with_its_range(scene, capsys, time):
    assert udkjax("animate", scene, "--t1", "0.5", "--out", "x.svg", "--t", time) == 2
    assert f"--t must be a time of the motion, from 0 to 0.5 s, not {time} s" in capsys.readouterr().err


def test_a_file_in_place_of_a_folder_is_refused_by_the_name_of_the_option(scene, capsys):
    for words in (
        ["export", scene, "--c"],
        ["identify", scene, "x.csv", "--parameters", "a", "--out", "x", "--posterior"],
        ["sweep", scene, "x.toml", "--out"],
        ["exercise", scene, "--vary", "a 1..2", "--count", "1", "--out"],
    ):
        assert udkjax(*words, scene) == 2
        assert f"{words[-1]} {scene} is not a folder" in capsys.readouterr().err


def test_links_without_width_are_given_one_by_the_drawing_or_by_an_option_of_the_command(scene, capsys):
    assert udkjax("gaps", scene) == 2
    said = capsys.readouterr().err
    assert '"crank": has no width; give it a width in the drawing, or --width for all links\n' in said
    assert udkjax("animate", scene, "--t1", "0.1", "--gaps", "--out", "x.svg") == 2
    said += capsys.readouterr().err
    assert '"crank": has no width; give it a width in the drawing\n' in said and "=" not in said
    assert udkjax("gaps", scene, "--width", "-3 mm") == 2
    assert "--width -3 mm: must be" in capsys.readouterr().err


@pytest.mark.parametrize(
    "cure", ['; give width= to the link, or shapes={"a": 0.02}', "; give its width or corners, shapes={'a': 0.02}"]
)
def test_no_cure_of_a_command_speaks_python(cure):
    assert any(re.search(pattern, cure) for pattern in OPTION_WORDS)
    for function in (gaps, animate):
        assert "=" not in in_option_words(f'link "a": has none{cure}', function)


def test_messages_name_options_in_place_of_arguments():
    assert in_option_words("t must be finite", animate) == "--t must be finite"
    assert in_option_words("first: must be finite", gaps) == "--from: must be finite"
    for message in ("the run failed", "there is no t", "files must be given"):
        assert in_option_words(message, animate) == message
