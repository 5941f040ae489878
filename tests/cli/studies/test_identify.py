import csv
import inspect
import json
import re
import runpy
import shlex
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
import pytest
import xarray

import udkjax as udk
from tests.command_line import udkjax
from udkjax.cli.studies.identify import Estimated, Loss
from udkjax.cli.studies.identify import identify as command

EXAMPLES = Path(__file__).parents[3] / "examples"
PENDULUM = EXAMPLES / "compound_pendulum.toml"
TRUTH, NOISE = 0.5, 0.3  # inertia of the rod, kg m2; of the measurements, degrees
MASS, INERTIA, CHANNEL = "body.rod.mass", "body.rod.inertia", "body.rod.angle"
PICTURES = {"fit.png", "residuals.png", "convergence.png", "correlation.png"}
FILES = {"identified.toml", "estimate.json", "estimate.csv", "fit.nc", *PICTURES}


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Two runs of a pendulum whose inertia differs from the scene's; a common factor of mass and inertia has no effect."""
    ts = np.linspace(0.0, 1.5, 31)
    q = np.asarray(udk.simulate(udk.load(PENDULUM).with_parameters({INERTIA: TRUTH}), ts).q)[:, 0, 2]
    rng = np.random.default_rng(5)
    runs = [np.degrees(q) + NOISE * rng.normal(size=q.shape) for _ in range(2)]
    lines = [f"{1e3 * t:.0f},{angle:.4f},{name},x" for name, run in zip("ab", runs, strict=True) for t, angle in zip(ts, run)]
    file = tmp_path_factory.mktemp("data") / "swings.csv"
    file.write_text("\n".join([f"time [ms],{CHANNEL} [deg],record,remark", *lines]))
    return file


def test_what_the_data_cannot_tell_is_said_and_all_is_written(tmp_path, capsys, data):
    out = tmp_path / "found"
    assert udkjax("identify", PENDULUM, data, "--parameters", MASS, INERTIA, "--ignore", "remark", "--out", out, "--quiet") == 1
    shown = capsys.readouterr()
    assert shown.err == "udkjax: the measurements do not determine every parameter\n"
    for part in ("2 parameters from 62 numbers in 2 records", "unknown", "body.rod.mass and body.rod.inertia by a common factor"):
        assert part in shown.out
    assert {file.name for file in out.iterdir()} == FILES
    found = json.loads((out / "estimate.json").read_text())
    assert found["converged"] and not found["success"]
    assert found["parameters"][MASS]["standard_error"] is None
    assert (out / "fit.png").read_bytes().startswith(b"\x89PNG")


def test_it_draws_from_the_posterior_and_continues(tmp_path, capsys, data):
    pytest.importorskip("arviz")
    out, folder = tmp_path / "found", tmp_path / "posterior"
    arguments = ["identify", PENDULUM, data, "--parameters", INERTIA, "--ignore", "remark", "--starts", "0", "--tol", "1e-8"]
    texts = []
    for _ in range(2):
        assert udkjax(*arguments, "--out", out, "--posterior", folder, "--quiet") == 0
        texts.append(capsys.readouterr().out.partition("posterior: ")[2])
    assert "8 chains of 1000 draws" in texts[0] and "the chains agree" in texts[0] and texts[0] == texts[1]
    found = json.loads((folder / "summary.json").read_text())["posterior"]
    estimate = json.loads((out / "estimate.json").read_text())["parameters"][INERTIA]
    row = found["parameters"][INERTIA]
    assert found["converged"] and row["units"] == "kg m2" and row["rhat"] < 1.01
    assert abs(row["mean"] - estimate["value"]) < 0.3 * estimate["standard_error"]
    with xarray.open_dataset(folder / "draws.nc", group="posterior", engine="h5netcdf") as draws:
        assert {file.name for file in folder.glob("*.png")} == {"corner.png", "predictions.png"}
        assert draws[INERTIA].shape == (8, 1000) and draws[INERTIA].attrs["units"] == "kg m2"


@pytest.mark.slow
def test_a_posterior_that_cannot_be_drawn_is_refused_by_name(tmp_path, capsys, data):
    """Parameters that nothing determines, bounds that exclude the optimum, and a folder with another posterior."""
    pytest.importorskip("arviz")

    def draw(*options) -> tuple[int, str]:
        arguments = ["identify", PENDULUM, data, "--ignore", "remark", "--starts", "0", "--tol", "1e-8", "--quiet"]
        status = udkjax(*arguments, "--out", tmp_path / "found", "--posterior", tmp_path / "posterior", *options)
        return status, capsys.readouterr().err

    status, shown = draw("--parameters", MASS, INERTIA)
    assert status == 2 and "Traceback" not in shown
    assert f"neither the records nor a prior determine {MASS} and {INERTIA}: give one of them a prior or bounds" in shown
    assert (tmp_path / "found" / "estimate.json").exists()  # the fit is kept
    status, shown = draw("--parameters", INERTIA, "--bounds", f"{INERTIA}=0.3,0.45")
    assert "Traceback" not in shown
    with xarray.open_dataset(tmp_path / "posterior" / "draws.nc", group="posterior", engine="h5netcdf") as draws:
        assert 0.3 < draws[INERTIA].min() < draws[INERTIA].max() < 0.45 < TRUTH
    status, shown = draw("--parameters", INERTIA)
    assert status == 1 and "contains another posterior" in shown and "Traceback" not in shown


@pytest.mark.slow
def test_what_is_known_before_makes_it_known(tmp_path, capsys, data):
    out = tmp_path / "found"
    options = ["--prior", f"{MASS}=2.0,0.002", "--bounds", f"{INERTIA} = 0.2,0.9", "--noise", CHANNEL + f"={np.radians(NOISE)}"]
    arguments = ["identify", PENDULUM, data, "--parameters", MASS, "--parameters", INERTIA, "--ignore", "remark", *options]
    assert udkjax(*arguments, "--profile", INERTIA, "--out", out, "--json", "--quiet") == 0
    printed, shown = capsys.readouterr()
    assert "the records determine every parameter" in shown and f"{INERTIA} is between" in shown
    assert {file.name for file in out.iterdir()} == {*FILES, "profiles.png"}
    found = json.loads((out / "estimate.json").read_text())
    assert {Path(file).name for file in json.loads(printed)["files"]} == {*FILES, "profiles.png"}
    assert json.loads(printed) == found | {"files": json.loads(printed)["files"]}
    inertia = found["parameters"][INERTIA]
    assert found["success"] and inertia["units"] == "kg m2"
    assert abs(inertia["value"] - TRUTH) < 4 * inertia["standard_error"] < 0.05 * TRUTH
    interval = inertia["value"] + 1.96 * inertia["standard_error"] * np.array([-1, 1])
    np.testing.assert_allclose(found["intervals"][INERTIA], interval, atol=0.1 * inertia["standard_error"])
    assert found["settings"] | {"parameters": [MASS, INERTIA], "prior": [f"{MASS}=2.0,0.002"], "seed": 0} == found["settings"]
    assert found["scene"] == PENDULUM.read_text() and found["data"][0]["file"] == str(data)
    assert len(found["data"][0]["sha256"]) == 64 and found["versions"]["jax"] == jax.__version__
    placed = udk.load(out / "identified.toml")
    assert float(placed.bodies["rod"].inertia) == inertia["value"]
    with (out / "estimate.csv").open() as file:
        (mass, row) = csv.DictReader(file)
    assert float(row["value"]) == inertia["value"] and row["parameter"] == INERTIA and float(mass["first_guess"]) == 2.0
    with xarray.open_dataset(out / "fit.nc", engine="h5netcdf") as fit:
        assert fit.measured.dims == ("record", "sample", "channel") and list(fit.record.values) == ["a", "b"]
        np.testing.assert_allclose(fit.time[1], np.linspace(0.0, 1.5, 31), atol=1e-12)
        np.testing.assert_allclose(fit.measured - fit.predicted, fit.residual, atol=1e-12)
        np.testing.assert_allclose(fit.noise, np.radians(NOISE))
        np.testing.assert_allclose(float(fit.residual.std()), np.radians(NOISE), rtol=0.3)
        np.testing.assert_allclose(fit.rise[0, [0, -1]], fit.interval.attrs["limit"], rtol=0.01)
        assert fit.attrs["success"] == 1 and fit.channel_units.values == ["rad"]


def test_options_reach_the_identification(tmp_path, monkeypatch, data):
    asked: dict[str, Any] = {}

    def interrupted(mech, records, parameters, **settings):
        asked.update(settings, records=records, parameters=parameters)
        raise KeyboardInterrupt

    monkeypatch.setattr(udk, "identify", interrupted)
    tied, length = "body.coupler.mass = body.rocker.mass", "length( crank )"
    file = tmp_path / "run.csv"
    file.write_text("t,joint.A.angle,joint.D.omega\n0,1,0\n1,2,0")
    arguments = ["identify", EXAMPLES / "four_bar.toml", file, "--parameters", tied, length, "--out", tmp_path / "found"]
    arguments += ["--prior", "body.rocker.mass=2,0.5", "--guess", "length(crank)=0.9", "--bounds", "length(crank)=0.5,2"]
    arguments += ["--noise", "0.1", "--noise", "joint.D.omega=0.5", "--estimate-start", "both", "--loss", "huber", "--quiet"]
    assert udkjax(*arguments, "--starts", 3, "--tol", 1e-9, "--seed", 7) == 130
    one, two = asked["parameters"]
    assert (one.of, one.prior, one.bounds, one.guess) == (tied, (2.0, 0.5), None, None)
    assert (two.of, two.prior, two.bounds, two.guess) == (length, None, (0.5, 2.0), 0.9)
    (record,) = asked["records"]
    assert record.start.estimate == "both" and record.name == "run"
    np.testing.assert_array_equal([record.noise[name] for name in record.values], [[0.1, 0.1], [0.5, 0.5]])
    assert {k: asked[k] for k in ("loss", "n_starts", "tol", "seed", "progress")} == {
        "loss": "huber",
        "n_starts": 3,
        "tol": 1e-9,
        "seed": 7,
        "progress": False,
    }
    assert not (tmp_path / "found").exists()


def test_choices_and_defaults_are_those_of_the_library():
    from udkjax.study.identify import identify
    from udkjax.study.identify.records import records
    from udkjax.study.identify.search import optimizer

    mine, theirs = (inspect.signature(function).parameters for function in (command, identify))
    for name in ("loss", "n_starts", "tol", "seed"):
        assert mine[name].default == theirs[name].default
    assert get_args(Estimated) == get_args(records.Estimated)
    for name in get_args(Loss):
        optimizer.named_loss(name, 1)


GOOD = {"--parameters": [MASS, INERTIA], "--out": ["found"], "--ignore": ["remark"]}


@pytest.mark.parametrize(
    ("option", "values", "problem"),
    [
        ("--out", ["nowhere/found"], "there is no folder nowhere"),
        ("--out", ["swings.csv"], "--out swings.csv is not a folder"),
        ("--parameters", ["body.rod.mas"], 'no parameter "body.rod.mas"; did you mean "body.rod.mass"?'),
        ("--parameters", [], "--parameters: name at least one"),
        ("--ignore", ["nothing"], '"remark"'),
        ("--bounds", [f"{MASS}=3,1"], "the lower bound must be below the upper one"),
        ("--bounds", [f"{MASS}=3,4"], "the first guess 2 must be between the bounds"),
        ("--bounds", [f"{MASS}=1,2,3"], f'--bounds "{MASS}=1,2,3": must be NAME=LOW,HIGH'),
        ("--prior", ["1,2"], '--prior "1,2": must be NAME=MEAN,DEVIATION'),
        ("--prior", ["body.rod.mas=1,2"], '"body.rod.mas" is not among --parameters; did you mean "body.rod.mass"?'),
        ("--guess", [f"{MASS}=1", f"{MASS}=2"], f'--guess "{MASS}=2": is given twice'),
        ("--guess", [f"{MASS}=heavy"], "must be NAME=VALUE"),
        ("--profile", ["body.rod.mas"], '"body.rod.mas": is not among --parameters; did you mean "body.rod.mass"?'),
        ("--noise", ["-1"], '--noise "-1": must be NUMBER or CHANNEL=NUMBER, in SI units, and positive'),
        ("--noise", ["body.rod.omega=1"], '"body.rod.omega" is not measured in any record'),
        ("--n-starts", ["-1"], "--n-starts -1: must not be negative"),
        ("--tol", ["0"], "--tol 0: must be between 0 and 1"),
        ("--seed", ["-1"], "--seed -1: must not be negative"),
    ],
)
def test_wrong_input_is_refused_before_anything_is_run(tmp_path, monkeypatch, capsys, data, option, values, problem):
    monkeypatch.chdir(tmp_path)
    Path("swings.csv").write_text(data.read_text())
    given = GOOD | {option: values}
    options = [word for name, words in given.items() for word in ([f"{name}={words[0]}"] if len(words) == 1 else [name, *words])]
    options = [word for word in options if word != "--parameters"] if not values else options
    assert udkjax("identify", PENDULUM, "swings.csv", *options) == 2
    shown = capsys.readouterr()
    assert problem in shown.err and "Traceback" not in shown.err and shown.out == ""
    assert [file.name for file in Path().iterdir()] == ["swings.csv"]


def test_all_mistakes_are_named_at_once(tmp_path, capsys, data):
    arguments = [
        "--parameters",
        "body.rod.mas",
        INERTIA,
        "--noise",
        "loud",
        "--tol",
        2,
        "--prior",
        "x=1,2",
        "--out",
        tmp_path / "o",
    ]
    assert udkjax("identify", PENDULUM, data, "nowhere.csv", *arguments) == 2
    shown = capsys.readouterr().err
    for part in ("6 mistakes", '"body.rod.mas"', '"loud"', "--tol 2", '"x=1,2"', '"remark"', "nowhere.csv"):
        assert part in shown
    assert udkjax("identify", PENDULUM, "--parameters", MASS, "--out", tmp_path / "o") == 2
    assert "give a file of measurements" in capsys.readouterr().err
    assert udkjax("identify", "nowhere.toml", data, "--parameters", MASS, "--out", tmp_path / "o") == 2
    assert "cannot read nowhere.toml" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_example_of_the_guide_finds_what_its_data_was_made_with(tmp_path, monkeypatch, capsys):
    made = runpy.run_path(str(EXAMPLES / "data" / "four_bar.py"))
    text = (EXAMPLES / "data" / "four_bar.csv").read_text()
    made["main"](tmp_path)
    assert (tmp_path / "four_bar.csv").read_text() == text

    monkeypatch.chdir(EXAMPLES.parent)
    guide = Path("docs/how-to/identify.md").read_text(encoding="utf-8")
    (code,) = [code for code in re.findall(r"```python\n(.*?)```", guide, re.DOTALL) if "udk.identify" in code]
    (command,) = re.findall(r"udkjax (identify .*?)\n```", guide, re.DOTALL)
    names: dict[str, Any] = {"udk": udk}
    exec(code, names)
    estimate = names["estimate"]
    truth = {**made["TRUTH"], "length(coupler)": made["LENGTH"]}
    errors = estimate.standard_errors
    assert estimate.success and truth.keys() == errors.keys()
    for name, value in estimate.parameters.items():
        assert abs(value - truth[name]) < 3 * errors[name] < 0.03 * truth[name]
    capsys.readouterr()  # what the guide says of it is held against it in test_docs.py

    arguments = shlex.split(command.replace("\\\n", " "))
    assert udkjax(*arguments[:-1], tmp_path / "identified", "--quiet") == 0
    found = json.loads((tmp_path / "identified" / "estimate.json").read_text())
    for name, value in estimate.parameters.items():
        assert found["parameters"][name]["value"] == pytest.approx(value, rel=1e-6)
