"""`udkjax report`, and whether everything that it runs can be installed with the package."""

import ast
import json
import tomllib
from pathlib import Path

import pytest
import xarray

from experiments.paper import page
from experiments.paper.record import save
from tests.command_line import udkjax

ROOT = Path(page.__file__).parents[2]


@pytest.mark.slow
def test_a_report_is_drawn_from_its_data_alone(tmp_path, monkeypatch, capsys, study_data):
    monkeypatch.setattr(page, "figure", lambda data, name: f"<p>{name}</p>")  # tests/show draws them

    save(study_data, tmp_path / "study.nc")
    assert udkjax("report", "--from", tmp_path / "study.nc", "--out", tmp_path / "pages") == 0
    assert "report.html" in capsys.readouterr().out
    assert [file.name for file in (tmp_path / "pages").iterdir()] == ["report.html"]  # no data is made anew
    text = (tmp_path / "pages" / "report.html").read_text()
    assert text.startswith("<!DOCTYPE html>") and "<p>figure_2</p>" in text


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (["--start", "10"], "--start 10"),
        (["--start", "-90"], "at -90 they hang"),
        (["--seed", "-1"], "--seed -1"),
        (["--out", "report.pdf"], "neither a page"),
        (["--out", "nowhere/report.html"], "no folder nowhere"),
        (["--out", "nowhere/report"], "no folder nowhere"),
        (["--from", "nowhere.nc"], "cannot read nowhere.nc"),
    ],
)
def test_wrong_input_of_a_report_is_refused_before_anything_is_run(tmp_path, monkeypatch, capsys, arguments, cause):
    monkeypatch.chdir(tmp_path)
    assert udkjax("report", *arguments) == 2
    assert cause in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_file_of_something_else_is_no_report(tmp_path, capsys):
    xarray.Dataset({"q": ("time", [1.0])}).to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    assert udkjax("report", "--from", tmp_path / "run.nc", "--out", tmp_path / "page.html") == 2
    assert "not the data of a report" in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


def test_the_verdicts_are_written_as_json(tmp_path, monkeypatch, capsys, study_data):
    monkeypatch.setattr(page, "figure", lambda data, name: "")
    save(study_data, tmp_path / "study.nc")
    assert udkjax("report", "--from", tmp_path / "study.nc", "--out", tmp_path / "page.html", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["files"] == [str(tmp_path / "page.html")]
    assert [run["verdict"] for run in found["runs"]] == list(study_data.verdict.values)


def test_its_modules_are_installed_and_name_each_other_relatively():
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert build["sources"] == {"experiments/paper": "udkjax/paper"}
    for file in Path(page.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                assert node.level < 2
                names = [node.module or ""] if not node.level else []
            assert not [name for name in names if name.split(".")[0] == "experiments"], file
