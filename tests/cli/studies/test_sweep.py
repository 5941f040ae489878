import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import xarray

import udkjax as udk
from tests.command_line import udkjax

EXAMPLES = Path(__file__).parents[3] / "examples"
PENDULUM = EXAMPLES / "compound_pendulum.toml"
THE_EXAMPLE = ("sweep", EXAMPLES / "parallelogram.toml", EXAMPLES / "grids" / "parallelogram.toml")
GRID = """
t1 = 0.5
measures = ["final", "violation"]
[axes]
"body.rod.inertia" = [0.1, 0.2, 0.4]
tol = { from = 1e-8, to = 1e-4, num = 3, scale = "log", of = ["rtol", "atol"] }
[settings]
method = "elimination"
max_steps = 5
"""


@pytest.fixture
def grid(tmp_path):
    file = tmp_path / "grid.toml"
    file.write_text(GRID)
    return file


def test_a_sweep_is_run_and_refused_where_it_is_another(tmp_path, grid, capsys):
    out = tmp_path / "sweep"
    assert udkjax("sweep", PENDULUM, grid, "--out", out, "--quiet") == 0
    first = capsys.readouterr()
    assert first.err == ""
    with xarray.open_dataset(out / "sweep.nc", engine="h5netcdf") as data:
        assert dict(data.sizes) == {"body.rod.inertia": 3, "tol": 3, "body": 1, "coordinate": 3}
        np.testing.assert_allclose(data["tol"], [1e-8, 1e-6, 1e-4])
        failed = int((data.result == 1).sum())
        assert 0 < failed < 9 and np.isnan(data.q_end.values[data.result.values == 1]).all()
        assert data.attrs["scene"] == PENDULUM.read_text() and data.attrs["setting_max_steps"] == 5
    assert f"{9 - failed} successful, {failed} step limit" in first.out and "wrote sweep.nc" in first.out
    pictures = {file.name for file in out.glob("*.png")}
    assert {"result.png", "end_time.png"} <= pictures and "q_end.png" not in pictures
    assert json.loads((out / "sweep.json").read_text())["settings"]["max_steps"] == 5

    assert udkjax("sweep", PENDULUM, grid, "--out", out, "--quiet", "--json") == 0  # continues from the files
    found = json.loads(capsys.readouterr().out)
    assert found["results"] == {"successful": 9 - failed, "step_limit": failed} and found["members"] == 9
    assert found["ranges"]["end_time"]["largest"] == 0.5 and "sweep.nc" in found["files"]

    grid.write_text(GRID.replace("max_steps = 5", "max_steps = 6"))
    assert udkjax("sweep", PENDULUM, grid, "--out", out) == 1
    assert "settings.max_steps: was 5, is now 6" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "arguments", "problem"),
    [
        ("", [], "give --out FOLDER"),
        ("", ["--out", "nowhere/sweep"], "there is no folder nowhere"),
        ("", ["--out", "sweep", "--memory", "0"], "--memory 0: must be positive"),
        ("", ["--out", "sweep", "--engine", "devices", "--scheduler", "tcp://x:1"], "--scheduler needs --engine dask"),
        (
            "rod.inertia",
            ["--out", "sweep"],
            '"body.rod.inertai" is neither a parameter of the mechanism nor a setting; did you mean "body.rod.inertia"?',
        ),
        ("max_steps", ["--out", "sweep"], 'settings.max_stpes: unknown key; did you mean "max_steps"?'),
        ("violation", ["--out", "sweep"], 'measure "voilation" does not exist; did you mean "violation"?'),
    ],
)
def test_wrong_input_is_refused_before_anything_is_run(tmp_path, monkeypatch, capsys, grid, change, arguments, problem):
    monkeypatch.chdir(tmp_path)
    wrong = {"rod.inertia": "rod.inertai", "max_steps": "max_stpes", "violation": "voilation"}
    grid.write_text(GRID.replace(change, wrong[change]) if change else GRID)
    assert udkjax("sweep", PENDULUM, grid, *arguments) == 2
    shown = capsys.readouterr().err
    assert problem in shown and "Traceback" not in shown
    assert os.listdir() == [grid.name]
    assert udkjax("sweep", PENDULUM, "nowhere.toml", "--dry-run") == 2
    assert "cannot read nowhere.toml" in capsys.readouterr().err


def test_an_interrupt_says_how_to_go_on(tmp_path, monkeypatch, capsys, grid):
    def interrupted(*_, **choices):
        assert choices["engine"] == "devices" and choices["memory"] == 2**20 and choices["progress"] is None
        raise KeyboardInterrupt

    monkeypatch.setattr(udk, "sweep", interrupted)
    arguments = ("--out", tmp_path / "sweep", "--engine", "devices", "--memory", 1)
    assert udkjax("sweep", PENDULUM, grid, *arguments) == 130
    assert "run the same command to continue" in capsys.readouterr().err


@pytest.mark.slow
def test_what_the_example_takes(tmp_path, capsys):
    assert udkjax(*THE_EXAMPLE, "--dry-run") == 0
    shown = " ".join(capsys.readouterr().out.split())
    for part in ("members 288: 9 body.coupler.mass x 8 tol x 2 start x 2 stabilization", "2 programs", "q_end"):
        assert part in shown
    (chunks,) = re.findall(r"chunks (\d+)", shown)
    assert 2 <= int(chunks) <= 32  # one of each program at least; more where more compute at a time
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_example_on_workers_of_dask(tmp_path, capsys):
    pytest.importorskip("distributed", reason="dask is not installed: pip install '.[dask]'")
    assert udkjax(*THE_EXAMPLE, "--out", tmp_path / "sweep", "--engine", "dask") == 0
    assert "288 successful" in capsys.readouterr().out
    with xarray.open_dataset(tmp_path / "sweep" / "sweep.nc", engine="h5netcdf") as data:
        assert float(data.violation.sel(stabilization="Projection").max()) < 1e-12
        assert float(data.violation.max()) < 1e-3
