"""The last lines of a run say what was skipped, and what would bring it."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.skipped import skipped_for


def skip(reason, node="tests/a.py::test_it"):
    return SimpleNamespace(nodeid=node, longrepr=("conftest.py", 1, f"Skipped: {reason}"))


def test_reasons_are_counted_and_say_what_would_help():
    needed = "a browser is needed: playwright (sh install.sh --test --browser)"
    reports = [skip("singular"), *[skip(needed)] * 3, skip("could not import 'nbformat': No module named 'nbformat'")]
    reports += [skip("could not import 'fmpy': No module named 'fmpy'")]
    reports.append(skip("could not import 'wasmtime': No module named 'wasmtime'", "tests/native/wasm/test_engine.py"))
    assert skipped_for(reports) == [
        f"3 tests skipped: {needed}",
        "1 test skipped: singular",
        "1 test skipped: nbformat is not installed: sh install.sh --test --notebook",
        "1 test skipped: fmpy is not installed: sh install.sh --test --fmi",
        "1 file skipped: wasmtime is not installed: sh install.sh --test",
    ]
    assert skipped_for([]) == []


@pytest.mark.parametrize("processes", ["0", "1"])
def test_they_are_the_last_lines(tmp_path, processes):
    (tmp_path / "test_it.py").write_text("import pytest\n\ndef test_a():\n    pytest.skip('no browser')\n\ntest_b = test_a\n")
    source = (Path(__file__).parent / "conftest.py").read_text()
    hook = source[source.index("@pytest.hookimpl") : source.index('@pytest.fixture(scope="module", autouse=True)')]
    (tmp_path / "conftest.py").write_text(f"import pytest\nfrom tests.skipped import skipped_for\n\n\n{hook}")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:jaxtyping",
        "-n",
        processes,
        "-c",
        "/dev/null",
    ]
    root = Path(__file__).parents[1]
    run = subprocess.run([*command, f"--rootdir={tmp_path}", tmp_path], cwd=root, capture_output=True, text=True)
    *_, line, last = run.stdout.splitlines()
    assert line == "2 tests skipped: no browser" and last.startswith("2 skipped"), run.stdout + run.stderr
