"""`udkjax diagnose` and `udkjax explain`."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import udkjax

PARALLELOGRAM = Path(__file__).parents[3] / "examples" / "parallelogram.toml"


def test_diagnose_prints_what_depends_on_what(capsys):
    assert udkjax("diagnose", PARALLELOGRAM) == 0
    shown = capsys.readouterr().out
    for words in (
        "Gruebler's count",
        "A1, A2, A3, B1, B2, B3: 1 redundant constraint",
        "slot along 0 degrees",
        "next rank change on the path",
    ):
        assert words in shown


def test_diagnose_follows_a_run_and_writes_json(capsys):
    assert udkjax("diagnose", PARALLELOGRAM, "--t1", 0.5, "--dt", 0.05, "--no-fixes", "--json") == 0
    captured = capsys.readouterr()
    data = json.loads(captured.out)
    assert data["rank"] == 11 and data["gruebler"] == 0 and data["degrees_of_freedom"] == 1
    assert len(data["timeline"]["ts"]) == 11 and data["timeline"]["changes"] == [] and data["redundancies"][0]["fixes"] == []
    assert "five-bar parallelogram" in captured.err


def test_explain_derives_one_state(capsys):
    assert udkjax("explain", PARALLELOGRAM) == 0
    assert "Gauss's principle" in capsys.readouterr().out
    assert udkjax("explain", PARALLELOGRAM, "--t", 1, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(data["q"][2], -2.35345602704048, atol=1e-7)  # of the reference, a second after the release
    np.testing.assert_allclose(data["a"][2], 7.93833920395464, atol=1e-6)


@pytest.mark.parametrize("options", [["explain", "--t", -1], ["diagnose", "--t1", 1, "--dt", 0], ["diagnose", "--t1", -1]])
def test_times_that_make_no_sense_are_refused(options, capsys):
    command, *rest = options
    assert udkjax(command, PARALLELOGRAM, *rest) == 2
    assert "--t" in capsys.readouterr().err
