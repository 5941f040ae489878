"""The commands that ask what a mechanism does: each against what the functions return, as JSON and as a file."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import xarray

from tests.command_line import udkjax
from udkjax.cli.datasets import save

EXAMPLES = Path(__file__).parents[1] / "examples"


def results(capsys, *arguments):
    assert udkjax(*arguments, "--json") == 0
    return json.loads(capsys.readouterr().out)


def test_kinematics(tmp_path, capsys):
    out = tmp_path / "k.nc"
    scene = EXAMPLES / "slider_crank.toml"
    found = results(capsys, "kinematics", scene, "--driver", "motor", "--from", 0.0, "--to", 6.0, "--count", 7, "--out", out)
    assert found["status"] == ["closed"] * 7
    assert found["travel"] == [None, None]
    s, x = np.array(found["values"]), np.array(found["q"])[:, 2, 0]
    np.testing.assert_allclose(x, 0.5 * np.cos(s) + np.sqrt(1.5**2 - 0.25 * np.sin(s) ** 2), atol=1e-12)
    with xarray.open_dataset(out, engine="h5netcdf") as data:
        np.testing.assert_allclose(data.q.sel(body="slider", coordinate="x"), x)
        assert data.attrs["scene"] == scene.read_text()


def test_kinematics_refuses_what_cannot_be_driven(capsys):
    assert udkjax("kinematics", EXAMPLES / "slider_crank.toml", "--driver", "motr") == 2
    assert 'did you mean "motor"' in capsys.readouterr().err


def test_kinematics_refuses_at_once_what_a_driver_holds(capsys):
    assert udkjax("kinematics", EXAMPLES / "slider_crank.toml", "--driver", "body.slider.x") == 2
    assert 'body.slider.x is held by driver "motor"' in capsys.readouterr().err


def test_inverse(tmp_path, capsys):
    out = tmp_path / "i.nc"
    found = results(capsys, "inverse", EXAMPLES / "slider_crank.toml", "--t1", 0.3, "--dt", 0.1, "--out", out)
    torque, power = np.array(found["efforts"]["motor"]), np.array(found["powers"]["motor"])
    with xarray.open_dataset(out, engine="h5netcdf") as data:
        np.testing.assert_allclose(data.effort.sel(driver="motor"), torque)
        save(data, tmp_path / "i.csv")
    heading, *lines = (tmp_path / "i.csv").read_text().splitlines()
    assert heading == "time,effort.motor [N m or N],power.motor [W]"
    np.testing.assert_array_equal([float(line.split(",")[1]) for line in lines], torque)
    rate = power[0] / torque[0]
    np.testing.assert_allclose(power, rate * torque)
    peak = found["peaks"]["motor"]
    assert abs(peak["effort"]) == pytest.approx(np.max(np.abs(torque)))
    assert udkjax("inverse", EXAMPLES / "parallelogram.toml", "--t1", 0.3) == 2


def test_a_scene_that_finds_no_rest_says_so(tmp_path, capsys):
    scene = tmp_path / "fall.toml"
    scene.write_text('format = 1\n[[body]]\nname = "stone"\nmass = 1.0\ninertia = 0.1\n')
    assert udkjax("statics", scene) == 1
    assert "no position of rest was found" in capsys.readouterr().err


def test_statics_and_modes_of_a_scene_without_a_degree_of_freedom(capsys):
    for command in ("statics", "modes"):
        assert udkjax(command, EXAMPLES / "slider_crank.toml") == 0
        assert "no degree of freedom is left" in capsys.readouterr().out


def test_statics_and_modes_of_the_papers_linkage(tmp_path, capsys):
    rest = results(capsys, "statics", EXAMPLES / "parallelogram.toml", "--stable", "--out", tmp_path / "s.nc")["equilibria"]
    assert rest[0]["stable"]
    np.testing.assert_allclose(rest[0]["omega2"], [3.5 * 9.81 / 3.05], rtol=1e-9)
    found = results(capsys, "modes", EXAMPLES / "parallelogram.toml", "--out", tmp_path / "m.nc")
    np.testing.assert_allclose(found["frequencies"], [np.sqrt(3.5 * 9.81 / 3.05)], rtol=1e-9)
    with xarray.open_dataset(tmp_path / "m.nc", engine="h5netcdf") as data:
        assert data["shape"].dims == ("mode", "body", "coordinate")
        np.testing.assert_allclose(data["shape"], found["shapes"])
        save(data, tmp_path / "m.csv")  # a position has no mode: each row repeats it
    (row,) = csv.DictReader((tmp_path / "m.csv").open())
    assert float(row["omega2 [1/s2]"]) == found["omega2"][0]
    assert float(row["body.link2.x [m]"]) == found["q"][found["bodies"].index("link2")][0]
