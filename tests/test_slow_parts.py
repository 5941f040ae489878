"""The parts of `.ci/slow` contain every slow test once, and a part that has passed is not run again."""

import re
import subprocess
import sys
import tomllib
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / ".ci" / "slow"
pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="the script is no part of a source distribution")


@pytest.fixture
def slow(monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    spec = spec_from_loader("slow", SourceFileLoader("slow", str(SCRIPT)))
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def project(slow, tmp_path, monkeypatch):
    """A repository with a part of two tests, and another test that is skipped."""
    (tmp_path / "tests" / "a").mkdir(parents=True)
    (tmp_path / "tests" / "a" / "test_it.py").write_text(
        "from pathlib import Path\nimport pytest\npytestmark = pytest.mark.slow\n\ndef test_it():\n    pass\n\n"
        "def test_what_may_fail():\n    assert not Path('a.fails').exists()\n"
    )
    (tmp_path / "tests" / "test_other.py").write_text(
        "import pytest\n\n@pytest.mark.slow\ndef test_other():\n    pytest.skip('no browser')\n\ndef test_fast():\n    pass\n"
    )
    settings = "markers = slow\naddopts = -m 'not slow' --import-mode=importlib -p no:cacheprovider -p xdist\n"
    (tmp_path / "pytest.ini").write_text(f"[pytest]\n{settings}")
    (tmp_path / ".gitignore").write_text("*.fails\n*.stops\n.pytest_cache/\n__pycache__/\n")
    for words in (["init", "-q"], ["add", "."], ["-c", "user.name=x", "-c", "user.email=x@x", "commit", "-qm", "All"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    none = {"ONLY_SLOW": {}, "LOWEST_TESTS": (), "PYTHON_TESTS": (), "LANES_TESTS": (), "TYPED": ()}
    for name, value in {"ROOT": tmp_path, "PARTS": {"a": ("tests/a",)}, **none}.items():
        monkeypatch.setattr(slow, name, value)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # they import JAX
    return tmp_path


def test_few_tests_have_no_faster_counterpart(slow):
    """The number may only fall: a faster test of what one of them shows takes it from the list, and lowers the number."""
    assert sum(len(tests) for tests in slow.ONLY_SLOW.values()) <= 51


def test_results_of_parts_are_those_of_pytest(slow, project):
    parts = slow.collect(sys.executable)
    assert {name: len(tests) for name, tests in parts.items()} == {"a": 2, "rest": 1}
    (project / "a.fails").touch()
    one, rest = (slow.run_part(sys.executable, tests, []) for tests in parts.values())
    assert (one["result"], one["passed"], one["failed"], one["skipped"]) == ("failed", 1, 1, 0)
    assert (rest["result"], rest["skipped"], rest["words"]) == ("skipped", 1, "no browser")


def test_a_part_that_has_passed_for_a_commit_is_not_run_again(slow, project, monkeypatch):
    ran = []

    def run_part(python, tests, more):
        if (project / f"{tests[0]}.stops").exists():
            raise KeyboardInterrupt
        ran.append(tests[0])
        failed = (project / f"{tests[0]}.fails").exists()
        return {"result": "failed" if failed else "passed", **dict.fromkeys(slow.COUNTED, 0), "words": "", "when": "now"}

    def call(*words):
        ran.clear()
        monkeypatch.setattr(sys, "argv", ["slow", "--venv", sys.prefix, *words])
        return slow.main(), ran

    monkeypatch.setattr(slow, "run_part", run_part)
    monkeypatch.setattr(slow, "collect", lambda python: {"a": ["a"], "b": ["b"], "c": ["c"]})
    (project / "a.fails").touch()
    assert call() == (1, ["a", "b", "c"])
    assert call("b") == (0, ["b"])
    (project / "a.fails").unlink()
    assert call("--list") == (1, [])
    assert call() == (0, ["a"])
    assert call("--list") == (0, [])
    (project / "pytest.ini").write_text("[pytest]\n")  # not committed: that is something else
    (project / "b.stops").touch()
    with pytest.raises(KeyboardInterrupt):
        call()
    (project / "b.stops").unlink()
    assert call() == (0, ["b", "c"])


def test_each_slow_test_is_in_one_part_and_what_is_named_exists(slow):
    paths = [path for own in slow.PARTS.values() for path in own]
    assert len(paths) == len(set(paths)) and all((ROOT / path).exists() for path in paths)
    for file, own in slow.ONLY_SLOW.items():
        text = (ROOT / file).read_text()
        assert all(f"def {name.rpartition('::')[2]}(" in text for name in own if name) and "pytest.mark.slow" in text
    assert slow.part_of("tests/native/language/test_ir.py") == "native"
    assert slow.part_of("tests/native/wasm/test_engine.py") == "webassembly"
    assert slow.part_of("tests/cli/test_commands.py") == "rest"


def test_the_lowest_versions_are_those_of_the_project(slow):
    versions = slow.lowest_versions()
    assert "numpy==2.2" in versions and any(x.startswith("xarray==") for x in versions)
    assert all(x.count("==") == 1 and not set("<>,;") & set(x) for x in versions)
    assert all((ROOT / path).exists() for path in slow.LOWEST_TESTS)


def test_types_are_those_that_pyright_finds(slow, tmp_path):
    (tmp_path / "pyright").write_text(
        """#!/bin/sh
echo '{"generalDiagnostics": [{"file": "a.py", "severity": "error", "message": "no", "range": {"start": {"line": 1}}}],
       "summary": {"filesAnalyzed": 3}}'
exit 1
"""
    )
    (tmp_path / "pyright").chmod(0o755)
    entry = slow.run_types(tmp_path / "python", ["tests"])
    assert (entry["result"], entry["passed"], entry["failed"]) == ("failed", 2, 1)
    assert slow.run_types(tmp_path / "other" / "python", ["tests"])["result"] == "skipped"
    configured = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pyright"]["include"]
    assert set(slow.TYPED) == set(configured) and all((ROOT / path).exists() for path in slow.PYTHON_TESTS)
    assert all((ROOT / path).exists() for path in slow.LANES_TESTS)


def test_lanes_are_set_for_their_part_alone_and_skipped_where_the_processor_lacks_them(slow, monkeypatch):
    ran = []
    monkeypatch.setattr(slow, "run_part", lambda python, tests, more, marked, own: ran.append((tests, marked, own)))
    slow.run_named("lanes-1", Path(sys.executable), ["tests"], [])
    assert ran == [(["tests"], "not slow", {"UDKJAX_LANES": "1"})]
    monkeypatch.setattr(slow, "environment", lambda name, *choices: Path(sys.executable))
    slow.run_named("oldest", Path("other"), ["tests"], [])
    assert ran.pop() == ran[0]  # on the oldest Python, with one lane
    monkeypatch.setattr(slow, "environment", lambda name, *choices: None)
    assert slow.run_named("oldest", Path(sys.executable), ["tests"], [])["result"] == "skipped"
    entry = slow.run_lanes(Path(sys.executable), 3, ["tests"], [])
    assert entry["result"] == "skipped" and "UDKJAX_LANES must be 1, 2, 4 or 8" in entry["words"] and len(ran) == 1


def test_pages_are_run_where_their_packages_are(slow, monkeypatch):
    ran = []
    monkeypatch.setattr(slow, "environment", lambda name, *choices: Path(name, *choices))
    monkeypatch.setattr(slow, "run_part", lambda *given: ran.append(given))
    slow.run_named("pages", Path("python"), [], [])
    assert ran == [(Path("browser", "--browser"), list(slow.PARTS["pages"]), [], "slow or not slow")]
    in_a_browser = {
        f"{file.relative_to(ROOT)}"
        for folder in ("studio", "show/player")
        for file in (ROOT / "tests" / folder).glob("test_*.py")
        if re.search(r"def test_\w+\((.*, )?(browser|opened|studio|notebook)\b", file.read_text())
    }
    assert in_a_browser <= set(slow.PARTS["pages"])
