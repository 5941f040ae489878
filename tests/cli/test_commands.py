import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import get_args

import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import udkjax as udk
from tests.calls import calls_of
from tests.command_line import udkjax
from tests.fresh_process import python
from udkjax.cli import COMMANDS
from udkjax.cli.datasets import save
from udkjax.extras import MissingExtraError
from udkjax.integrate import Result
from udkjax.study.report import plain
from udkjax.study.sweep.executors import ClusterError

EXAMPLES = Path(__file__).parents[2] / "examples"
PARALLELOGRAM = EXAMPLES / "parallelogram.toml"


def test_help_is_printed_without_importing_jax_and_offers_json():
    """One process prints the help of every command."""
    code = (
        "import sys; from udkjax.cli import COMMANDS, main\n"
        "for command in [[], *([name] for name in COMMANDS)]:\n"
        "    try:\n        main([*command, '--help'])\n    except SystemExit as end:\n        assert not end.code\n"
        "    print('HEAVY', *sorted({'jax', 'numpy', 'diffrax', 'xarray', 'matplotlib'} & set(sys.modules)), 'END', sep=',')\n"
    )
    every, *shown = python(code).split("HEAVY,END")[:-1]
    assert "usage: udkjax" in every and len(shown) == len(COMMANDS)
    for name, text in zip(COMMANDS, shown, strict=True):
        assert f"usage: udkjax {name}" in text and "--json" in text, name


def test_simulate_writes_a_file_that_can_be_trusted_and_a_picture(tmp_path, capsys):
    out = tmp_path / "run.nc"
    assert udkjax("simulate", PARALLELOGRAM, "--t1", 2, "--dt", 0.05, "--rtol", 1e-9, "--atol", 1e-9, "--out", out) == 0
    shown = capsys.readouterr().out
    for word in ("five-bar parallelogram", "successful", "violation", "energy", "exact solution", "compile", "run.nc", "run.png"):
        assert word in shown
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    with xarray.open_dataset(out, engine="h5netcdf") as data:
        assert dict(data.sizes) == {"time": 41, "body": 4, "coordinate": 3}
        assert list(data.coordinate.values) == ["x", "y", "angle"]
        assert data.q.dims == data.v.dims == ("time", "body", "coordinate")
        np.testing.assert_allclose(data.time, np.linspace(0, 2, 41))
        assert data.attrs["scene"] == PARALLELOGRAM.read_text()
        assert data.attrs["result"] == "successful"
        assert {"version_udkjax", "version_jax", "setting_method", "stats_steps"} <= set(data.attrs)
        assert [float(value) for name, value in data.attrs.items() if name.endswith("_rtol")] == [1e-9]
        angle = data.q.sel(body="link1", coordinate="angle")
        np.testing.assert_allclose(data.q.sel(body="link2", coordinate="x"), 1 + np.cos(angle) / 2, atol=1e-8)


def test_a_scene_is_a_file_or_a_mechanism_of_the_library(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert udkjax("convert", "parallelogram", "found.toml") == 0
    assert Path("found.toml").read_text() == udk.dumps(udk.library.parallelogram())
    assert udkjax("check", "paralelogram") == udkjax("animate", "paralelogram", "--out", "page.html") == 2
    assert capsys.readouterr().err.count("no such file; scenes of udkjax.library are andrews_squeezer, ") == 2
    Path("parallelogram").write_text(udk.dumps(udk.library.simple_pendulum()))
    assert udkjax("check", "parallelogram") == 0 and "pendulum" in capsys.readouterr().out


@pytest.mark.slow
def test_what_a_run_prints_is_measured(tmp_path, capsys):
    """Loose tolerances without stabilization: the printed error and drift must be large, unlike with the defaults."""
    arguments = ("simulate", PARALLELOGRAM, "--t1", 3, "--out", tmp_path / "run.nc")
    errors = {}
    for tol in (1e-3, 1e-10):
        assert udkjax(*arguments, "--rtol", tol, "--atol", tol) == 0
        (line,) = [line for line in capsys.readouterr().out.splitlines() if "exact solution" in line]
        errors[tol] = float(line.split("error of at most")[1].split()[0])
    assert errors[1e-10] < 1e-8
    assert errors[1e-3] > 1e3 * errors[1e-10]


@pytest.mark.parametrize(
    "choice",
    [
        ["--method", "svd", "--rank-tol", 1e-4],
        ["--stabilization", "baumgarte", "--alpha", 2],
        ["--solver", "tsit5"],
        ["--solver", "adams", "--dt0", 1e-3],
        ["--formulation", "augmented"],
    ],
)
@pytest.mark.slow
def test_choices_reach_the_simulation(tmp_path, choice):
    out = tmp_path / "run.nc"
    assert udkjax("simulate", EXAMPLES / "simple_pendulum.toml", "--t1", 1, "--out", out, *choice) == 0
    with xarray.open_dataset(out, engine="h5netcdf") as data:
        settings = " ".join(str(value) for name, value in data.attrs.items() if name.startswith("setting_")).lower()
    assert choice[1] in settings


def test_the_choices_of_the_command_line_are_those_of_files():
    from udkjax.study.choices import CHOICES, choice

    simulate = import_module("udkjax.cli.motion.simulate")
    for setting, table in CHOICES.items():
        assert list(table) == list(get_args(getattr(simulate, setting.capitalize())))
        for name in table:
            choice(setting, name)


def test_all_mistakes_of_a_scene_are_named_and_nothing_is_written(tmp_path, capsys):
    scene = tmp_path / "bad.toml"
    scene.write_text(PARALLELOGRAM.read_text().replace('"link1"]', '"lnik1"]').replace("mass = 2.0", "mass = -2.0"))
    assert udkjax("simulate", scene, "--t1", 1, "--out", tmp_path / "run.nc") == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    for part in ("bad.toml", 'no body named "lnik1"', 'did you mean "link1"', "mass", "> 0"):
        assert part in shown.err
    assert "Traceback" not in shown.err
    assert list(tmp_path.iterdir()) == [scene]
    assert udkjax("check", scene) == 2


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (["nowhere.toml", "--t1", "1"], "nowhere.toml"),
        ([PARALLELOGRAM, "--t1", "-1"], "--t1 -1"),
        ([PARALLELOGRAM, "--t1", "1", "--dt", "0"], "--dt 0"),
        ([PARALLELOGRAM, "--t1", "1", "--dt", "2"], "--dt 2"),
        ([PARALLELOGRAM, "--t1", "1", "--dt", "1e-12"], "--dt 1e-12 makes 1e+12 output times"),
        ([PARALLELOGRAM, "--t1", "1", "--rtol", "-1"], "rtol must be zero or positive and finite, not -1"),
        ([PARALLELOGRAM, "--t1", "1", "--atol", "nan"], "--atol nan: must be finite"),
        ([PARALLELOGRAM, "--t1", "1", "--rtol", "1e-30", "--atol", "0"], "are below rounding"),
        ([PARALLELOGRAM, "--t1", "1", "--rank-tol", "-1"], "method.rank_tol must be"),
        ([PARALLELOGRAM, "--t1", "1", "--max-steps", "0"], "--max-steps must be at least 1, not 0"),
        (
            [PARALLELOGRAM, "--t1", "1", "--formulation", "partitioning", "--stabilization", "baumgarte"],
            "keeps the constraints itself",
        ),
        ([PARALLELOGRAM, "--t1", "1", "--dt0", "0"], "--dt0 0 must be positive"),
        ([PARALLELOGRAM, "--t1", "1", "--plot", "run.nc"], "same file"),
        ([PARALLELOGRAM, "--t1", "1", "--plot", "nowhere/run.png"], "no folder nowhere"),
        ([PARALLELOGRAM, "--t1", "1", "--plot", "run.gif"], "--plot run.gif must end with one of .png, .svg, .pdf, .jpg"),
    ],
)
def test_wrong_input_is_refused_by_name(tmp_path, monkeypatch, capsys, arguments, cause):
    monkeypatch.chdir(tmp_path)
    assert udkjax("simulate", *arguments, "--out", "run.nc") == 2
    assert cause in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", PARALLELOGRAM, "--t1", "1"],
        ["kinematics", PARALLELOGRAM, "--driver", "body.link1.angle"],
        ["inverse", PARALLELOGRAM, "--t1", "1"],
        ["statics", PARALLELOGRAM],
        ["modes", PARALLELOGRAM],
    ],
)
def test_a_file_of_no_known_kind_is_refused_before_anything_runs(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    with calls_of(udk.load) as loaded:
        for name in ("run.xls", "run"):
            assert udkjax(*command, "--out", name) == 2
            assert f"--out {name} must end with one of .nc, .h5, .csv, .npz" in capsys.readouterr().err
    assert loaded == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "command", [["sweep", PARALLELOGRAM, "grid.toml"], ["identify", PARALLELOGRAM, "a.csv", "--parameters", "x"]]
)
def test_a_folder_is_not_called_as_a_file_is(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    assert udkjax(*command, "--out", "out.csv") == 2
    assert "--out out.csv: a folder with several files is written" in capsys.readouterr().err


def test_a_run_is_written_in_the_kind_that_its_name_says(tmp_path, capsys):
    """All formats contain the same numbers; identification can read the table."""
    from udkjax.study.identify.records.record_reader import records_of

    scene = EXAMPLES / "simple_pendulum.toml"
    assert udkjax("simulate", scene, "--t1", 0.2, "--out", tmp_path / "run.csv") == 0
    mech = udk.load(scene)
    run = udk.simulate(mech, np.arange(5) * 0.05)
    ts, q, v, (body,) = np.asarray(run.ts), np.asarray(run.q), np.asarray(run.v), mech.body_names
    for kind in ("h5", "npz"):
        save(run.to_xarray(mech), tmp_path / f"run.{kind}")
    with xarray.open_dataset(tmp_path / "run.h5", engine="h5netcdf") as data:
        np.testing.assert_array_equal(data.q, q)
    with np.load(tmp_path / "run.npz") as data:
        np.testing.assert_array_equal(data["q"], q)
        assert json.loads(str(data["attributes"]))["result"] == "successful"
    heading, *lines = (tmp_path / "run.csv").read_text().splitlines()
    names = [f"body.{body}.{name}" for name in ("x [m]", "y [m]", "angle [rad]", "vx [m/s]", "vy [m/s]", "omega [rad/s]")]
    assert heading.split(",") == ["time [s]", *names]
    table = np.array([[float(x) for x in line.split(",")] for line in lines])
    np.testing.assert_array_equal(table, np.column_stack([ts, q[:, 0], v[:, 0]]))
    (record,) = records_of(mech, tmp_path / "run.csv", noise=1e-3)
    assert len(record.values) == 6


def test_a_run_that_fails_says_why_and_keeps_what_it_got(tmp_path, capsys):
    out = tmp_path / "run.nc"
    assert udkjax("simulate", PARALLELOGRAM, "--t1", 20, "--out", out, "--max-steps", 20) == 1
    shown = capsys.readouterr()
    assert "step limit" in shown.err and "max_steps" in shown.err
    with xarray.open_dataset(out, engine="h5netcdf") as data:
        assert data.attrs["result"] == "step_limit"
        assert np.isfinite(data.q[0]).all()
    assert out.with_suffix(".png").exists()


def test_check_names_the_redundant_row(capsys):
    assert udkjax("check", PARALLELOGRAM) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for part in ("coordinates 12", "rank 11", "degrees of freedom 1", "12 in 6 joints and 0 drivers"):
        assert part in shown
    joints = ("A1", "A2", "A3", "B1", "B2", "B3")
    assert any(f"redundant constraints {joint} ({axis})" in shown for joint in joints for axis in "xy")


def test_check_of_a_scene_that_cannot_close_fails(tmp_path, capsys):
    scene = tmp_path / "open.toml"
    scene.write_text(PARALLELOGRAM.read_text().replace("[[2.0, 0.0], [-0.5, 0.0]]", "[[9.0, 0.0], [-0.5, 0.0]]"))
    assert udkjax("check", scene) == 1
    assert "does not close" in capsys.readouterr().out


def test_doctor_names_versions_and_devices(capsys):
    assert udkjax("doctor") == 0
    shown = capsys.readouterr().out
    for word in ("udkjax", "jax", "jaxlib", "equinox", "diffrax", "numpy", "python", "devices", "float64", "cores"):
        assert word in shown


def test_json_is_alone_on_stdout_and_words_go_to_stderr(tmp_path, capsys):
    out = tmp_path / "run.nc"
    assert udkjax("simulate", PARALLELOGRAM, "--t1", 0.5, "--out", out, "--json") == 0
    shown = capsys.readouterr()
    found = json.loads(shown.out)
    assert found["result"] == "successful" and found["end_time"] == 0.5
    assert found["files"] == [str(out), str(out.with_suffix(".png"))]
    assert 0 < found["error"] < 1e-7 and found["right_hand_sides"] > 0
    assert "wrote" in shown.err

    assert udkjax("check", PARALLELOGRAM, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["coordinates"], found["rank"], found["degrees_of_freedom"], found["closed"]) == (12, 11, 1, True)
    assert len(found["redundant"]) == 1 and found["mass"] > 0

    assert udkjax("doctor", "--json") == 0
    assert json.loads(capsys.readouterr().out)["engine"] == "native"


def test_what_json_cannot_hold_is_written_as_what_it_can():
    given = {
        "arrays": [np.arange(3), jnp.ones((2, 1))],
        "numbers": (np.float32(0.5), float("nan"), np.inf, 3, True, None),
        "names": {"result": Result.step_limit, "file": Path("a"), 7: np.array("text")},
    }
    assert plain(given) == {
        "arrays": [[0, 1, 2], [[1.0], [1.0]]],
        "numbers": [0.5, None, None, 3, True, None],
        "names": {"result": "step_limit", "file": "a", "7": "text"},
    }


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MissingExtraError("optax is not installed: pip install 'udkjax[identify]'"), 2, "pip install 'udkjax[identify]'"),
        (KeyboardInterrupt(), 130, "udkjax: stopped"),
        (BrokenPipeError(), 1, ""),
        (PermissionError(13, "Permission denied", "/elsewhere/x"), 1, "Permission denied: '/elsewhere/x'"),
        (udk.SceneError(["body.a.mass: must be > 0"]), 2, "udkjax: body.a.mass: must be > 0"),
        (ClusterError("no worker is left"), 1, "udkjax: no worker is left"),
    ],
)
def test_what_is_raised_in_a_command_becomes_its_exit_code(capsys, monkeypatch, error, code, words):
    def raised(*_):
        raise error

    monkeypatch.setattr("udkjax.show.doctor.facts", raised)
    monkeypatch.setattr(sys.stderr, "close", lambda: None)
    assert udkjax("doctor") == code
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("error", [ZeroDivisionError(), ValueError("of NumPy")])
def test_a_defect_keeps_its_traceback(monkeypatch, error):
    def raised():
        raise error

    monkeypatch.setattr("udkjax.show.doctor.facts", raised)
    with pytest.raises(type(error)):
        udkjax("doctor")


def test_the_package_runs_as_the_command():
    said = subprocess.run([sys.executable, "-m", "udkjax", "--version"], capture_output=True, text=True, check=True, timeout=120)
    assert said.stdout == f"udkjax {udk.__version__}\n"


def test_the_version_is_said_without_importing_anything(capsys):
    assert udkjax("--version") == 0
    assert capsys.readouterr().out == f"udkjax {udk.__version__}\n"
