from pathlib import Path

import jax
import pytest

from udkjax.show import doctor


def test_a_good_environment_gets_no_advice(monkeypatch):
    monkeypatch.setattr(doctor.sys, "version_info", (3, 12, 0))
    monkeypatch.setattr(doctor.jax, "__version_info__", (0, 12, 0))
    assert list(doctor._advice()) == []
    assert "nothing to complain about" in doctor.doctor()


@pytest.mark.parametrize(
    ("python", "version", "advice"), [((3, 11, 7), (0, 10, 2), "install Python 3.12"), ((3, 12, 1), (0, 11, 2), "--upgrade jax")]
)
def test_what_makes_runs_slow_is_said_with_the_cure(monkeypatch, python, version, advice):
    monkeypatch.setattr(doctor.sys, "version_info", python)
    monkeypatch.setattr(doctor.jax, "__version_info__", version)
    (line,) = doctor._advice()
    assert advice in line and doctor.OLDER_JAX in line
    assert doctor.OLDER_JAX in " ".join((Path(__file__).parents[2] / "README.md").read_text().split())


def test_single_precision_is_said():
    with jax.enable_x64(False):
        assert any("float64 is off" in line for line in doctor._advice())


def test_where_compiled_programs_are_is_said(tmp_path):
    (tmp_path / "jit_f-0-cache").write_bytes(bytes(3 * 2**20))
    before = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    try:
        for folder, said in ((str(tmp_path), f"1 kept in {tmp_path}, 3 MiB"), (None, "not kept")):
            jax.config.update("jax_compilation_cache_dir", folder)
            assert said in doctor.doctor()
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
