"""`udkjax animate`."""

import json

import numpy as np
import pytest
import xarray

import udkjax as udk
from tests.command_line import udkjax
from udkjax.show.player.animation import FailedRunWarning

SCENE = "examples/four_bar.toml"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return a file of a run, with an additional variable over time."""
    path = tmp_path_factory.mktemp("runs") / "four_bar.nc"
    mech = udk.load(SCENE)
    sol = udk.simulate(mech, np.linspace(0, 1, 21))
    data = sol.to_xarray(mech)
    data["torque"] = "time", np.sin(data["time"].values), {"units": "N m"}
    data.to_netcdf(path, engine="h5netcdf")
    return path


def test_a_run_becomes_a_page(run, tmp_path, capsys):
    out = tmp_path / "run.html"
    assert udkjax("animate", run, "--out", out, "--measures", "torque", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["bytes"] == out.stat().st_size < 60_000 and (printed["start"], printed["end"]) == (0, 1)
    text = out.read_text()
    assert '"name":"torque","unit":"N m"' in text and "<title>four-bar</title>" in text


def test_a_run_and_a_scene_side_by_side(run, tmp_path):
    out = tmp_path / "pose.svg"
    assert udkjax("animate", run, SCENE, "--t1", 0.5, "--labels", "file", "scene", "--out", out, "--t", 0.25) == 0
    left, right = out.read_text().split("<g ")[1:]
    places = lambda text: [float(word.split('"')[1]) for word in text.split() if word.startswith(("cx", "cy"))]  # noqa: E731
    np.testing.assert_allclose(places(left), places(right), atol=0.03)  # px


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("{run}", "--out", "x.bmp"), "--out x.bmp must end with one of .html"),
        (("{run}", "--out", "no/where.html"), "there is no folder no"),
        (("{run}", "{run}", "--out", "x.html"), "different labels, not four_bar, four_bar"),
        (("{run}", "--labels", "a", "b", "--out", "x.html"), "2 --labels for 1 files"),
        (("none.nc", "--out", "x.html"), "cannot read none.nc"),
        (("{sweep}", "--out", "x.html"), "has no q and no time"),
        (("{run}", "--measures", "heat", "--out", "{out}.html"), "measure 'heat' is unknown"),
        (("{run}", "--traces", "Z", "--out", "{out}.html"), "trace 'Z'"),
        ((SCENE, "--t1", "0", "--out", "x.html"), "and at most --t1 0"),
    ],
)
def test_wrong_input_is_refused(run, tmp_path, capsys, arguments, words):
    sweep = tmp_path / "sweep.nc"
    xarray.Dataset({"v": ("member", np.zeros(2))}).to_netcdf(sweep, engine="h5netcdf")
    places = {"run": run, "sweep": sweep, "out": tmp_path / "out"}
    assert udkjax("animate", *(word.format(**places) for word in arguments)) == 2
    assert words in capsys.readouterr().err


def test_a_scene_of_classes_of_ones_own_is_refused(run, tmp_path, capsys):
    path = tmp_path / "own.nc"
    with xarray.open_dataset(run) as data:
        data.assign_attrs(scene="# joint of a class of your own").to_netcdf(path, engine="h5netcdf")
    assert udkjax("animate", path, "--out", tmp_path / "run.html") == 2
    assert "use `udkjax.animate` in Python" in capsys.readouterr().err


def test_a_run_that_failed_is_shown_and_how_it_ended_is_said(tmp_path, capsys):
    """For a file and for a scene, on the page and in the terminal; in Python by a warning."""
    mech = udk.load(SCENE)
    failed = udk.simulate(mech, np.linspace(0.0, 1.0, 21), max_steps=3, throw=False)
    failed.to_xarray(mech).to_netcdf(tmp_path / "failed.nc", engine="h5netcdf")
    assert udkjax("animate", tmp_path / "failed.nc", "--out", tmp_path / "run.html", "--json") == 1
    shown = capsys.readouterr()
    assert "the run failed: step limit at t = " in shown.err and "UserWarning" not in shown.err
    assert "step limit" in json.loads(shown.out)["failures"][""]
    assert "step limit at t" in (tmp_path / "run.html").read_text()
    with pytest.warns(FailedRunWarning, match="the run failed: step limit"):
        udk.animate(mech, failed)


@pytest.mark.slow
def test_a_live_page_has_the_engine_and_the_sliders_that_are_named(run, tmp_path):
    out = tmp_path / "live.html"
    assert udkjax("animate", SCENE, "--t1", 1, "--out", out, "--live", "pin.B", "link.crank.mass") == 0
    text = out.read_text()
    assert [name in text for name in ('"name":"pin.B[0]"', '"name":"link.crank.mass"', '"name":"pin.C[0]"')] == [
        True,
        True,
        False,
    ]
    assert udkjax("animate", run, "--live", "--out", out) == 0  # a run from a file, and all of its numbers
    assert '"name":"pin.C[0]"' in out.read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((SCENE, "--live", "pin.Q", "--out", "page.html"), 'no parameter "pin.Q"'),
        ((SCENE, "--live", "--out", "page.gif"), "--live makes a page that simulates"),
    ],
)
def test_what_cannot_be_live_is_refused(words, said, tmp_path, capsys):
    *given, out = words
    assert udkjax("animate", *given, tmp_path / out) != 0
    assert said in capsys.readouterr().err
