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
    assert advice in line


def test_single_precision_is_said():
    with jax.enable_x64(False):
        assert any("float64 is off" in line for line in doctor._advice())
