"""The benchmarks run, and their baselines compute what they are compared with."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

benchmarks = pytest.importorskip("benchmarks", reason="not in a source tree")

from benchmarks import integrators, right_hand_side, simulate  # noqa: E402
from benchmarks.common import Compiled, alternate, ratio  # noqa: E402
from benchmarks.scripts import by_cholesky, by_pinv  # noqa: E402


def test_right_hand_side(tmp_path, capsys):
    right_hand_side.main(smoke=True, out=tmp_path / "figures.json")
    written = json.loads((tmp_path / "figures.json").read_text())
    assert written["machine"]["jax"].startswith(jax.__version__)
    names = [row["name"] for row in written["figures"]]
    assert "udkjax Elimination" in names and names[0] == "script, jnp.linalg.pinv"
    assert all(row["us"] > 0 for row in written["figures"])
    assert "udkjax Elimination" in capsys.readouterr().out


@pytest.mark.slow
def test_simulate(capsys):
    figures = simulate.main(smoke=True)
    ours = [row for row in figures if row["name"].startswith("udkjax")]
    assert ours and all(row["error"] < 1e-7 for row in ours)
    assert all(row["error"] < 1e-3 for row in figures)


def test_integrators():
    figures = integrators.main(smoke=True)
    assert {row["solver"] for row in figures} == {"VODE", "DOP853", "Adams", "LSODA", "Radau", "BDF"}
    assert all(0 < row["error"] < 200 * row["tol"] and row["calls"] > 100 for row in figures)
    assert all(row["ratio"] < 1.5 for row in figures if row["solver"] in ("Adams", "BDF"))


def test_work_at_equal_error():
    """Between two points that were measured, on a straight line in logarithms; not beyond them."""
    work = integrators.Work([(1e-4, 100), (1e-8, 400)])
    assert work.at(1e-6) == pytest.approx(200)
    assert np.isnan(work.at(1e-9))


def test_baselines_agree_with_the_closed_form():
    """3.05 theta'' = -3.5 g cos(theta), at rest."""
    angle = -0.7
    e, n = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    q = np.concatenate([*[[x + e[0] / 2, e[1] / 2, angle] for x in (0, 1, 2)], [1 + e[0], e[1], 0.0]])
    turn = -3.5 * 9.81 * np.cos(angle) / 3.05
    a = np.concatenate([*[[*(turn * n / 2), turn]] * 3, [*(turn * n), 0.0]])
    y = jnp.concatenate([jnp.asarray(q), jnp.zeros(12)])
    np.testing.assert_allclose(by_pinv(y)[12:], a, atol=1e-11)
    np.testing.assert_allclose(by_cholesky(y)[12:], a, atol=1e-2)


def test_a_second_compilation_is_refused():
    f = Compiled(lambda x: x + 1.0, jnp.ones(2))
    f(jnp.zeros(2))
    with pytest.raises(AssertionError, match="second time"):
        f(jnp.zeros(3))


def test_candidates_take_turns():
    f = Compiled(lambda x: x + 1.0, jnp.ones(2))
    times = alternate({"a": f, "b": f}, (jnp.ones(2),), 3)
    assert [len(t) for t in times.values()] == [3, 3]
    assert ratio([2.0, 4.0, 60.0], [1.0, 2.0, 3.0]) == 2.0
