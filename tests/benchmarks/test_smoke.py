"""The benchmarks run, and their baselines solve the same problems as udkjax."""

import json
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.choices import fast

benchmarks = pytest.importorskip("benchmarks", reason="not in a source tree")

from benchmarks import identification, measurements, mechanisms, table  # noqa: E402
from benchmarks.__main__ import main  # noqa: E402
from benchmarks.common import Compiled, Work, alternate, at_equal_error, frontier, ratio  # noqa: E402
from benchmarks.scripts import by_cholesky, by_pinv  # noqa: E402


def names(rows):
    return [row["name"] for row in rows]


SMALL = {  # what must be true of the figures of a small run; most hold their programs against each other inside
    "methods": lambda rows: names(rows)[0] == "Auto" and "jit of a mechanism" in names(rows),
    "right_hand_side": lambda rows: (
        names(rows)[0] == "script, jnp.linalg.pinv" and "udkjax Elimination" in names(rows) and all(row["us"] > 0 for row in rows)
    ),
    "uniqueness": lambda rows: names(rows)[-1] == "udkjax, vmap" and all(row["us"] > 0 for row in rows),
    "trajectory": lambda rows: (
        {*names(rows)} >= {"udkjax", "script, 1e-04"}
        and all(row["error"] < (1e-7 if row["name"] == "udkjax" else 1e-3) and row["seconds"] > 0 for row in rows if "tol" in row)
    ),
    "batch": lambda rows: (
        all(row["error"] < 1e-3 and row["per_second"] > 0 for row in rows if "tol" in row)
        and names(rows)[-1] == "two cores"
        and rows[-1]["speedup"] > 0
    ),
    "export": lambda rows: (
        names(rows)[0] == "C, compound_pendulum" and rows[0]["step_difference"] < 1e-12 and names(rows)[-1] == "receding horizon"
    ),
    "sweep": lambda rows: (  # killed and resumed
        [rows[0][name] for name in ("kept_when_killed", "resumed_members", "members")] == [1, 64, 128] and 0 < rows[0]["gib"] < 4
    ),
    "gradients": lambda rows: "udkjax" in names(row for row in rows if row["mode"] == "forward"),
    "integrators": lambda rows: (
        {row["solver"] for row in rows} == {"VODE", "DOP853", "Adams", "LSODA", "Radau", "BDF"}
        and all(0 < row["error"] < 200 * row["tol"] and row["calls"] > 100 for row in rows)
        and all(row["ratio"] < 1.5 for row in rows if row["solver"] in ("Adams", "BDF"))
    ),
    "stiff": lambda rows: (
        names(rows)[:2] == ["damper, 1e-01", "damper, 1e+04"]
        and all(row["successful"] and row["error"] < 1e-5 for row in rows if row["name"].startswith("damper"))
        and rows[1]["implicit"] > 0 == rows[0]["implicit"]
    ),
    "friction": lambda rows: (
        [row["law"] for row in rows] == ["none", "speed 0.1 m/s", "sticks"]
        and 1 < rows[1]["times_operations"] < 4
        and all(row["times_run"] > 0 for row in rows)
    ),
    "events": lambda rows: names(rows) == ["a limit"] and rows[0]["us_each"] > 0 and 0 < rows[0]["share of machine code"] < 1,
    "systems": lambda rows: names(rows)[0] == "spatial pendulum" and all(row["apart"] < 1e-2 for row in rows),
    "mechanisms": lambda rows: (
        all(row.get("per_second", row.get("ms", 0.0)) > 0 for row in rows)
        and {*names(rows)} >= {"SciPy's fsolve", "udkjax: kinematics() in a batch"}
    ),
}


@pytest.mark.parametrize("name", fast(["uniqueness"], SMALL))
def test_a_benchmark_runs_in_small(name):
    rows = import_module(f"benchmarks.{name}").main(smoke=True)
    assert SMALL[name](rows), rows


@pytest.mark.slow
def test_identification():
    """The true values are found, also with differences, and every claim has its row."""
    figures = identification.main(smoke=True)
    first, noisy, *timed = figures
    assert first["name"] == "linkage" and first["reached"] == 1.0 and first["error"] < 1e-8
    assert noisy["protocol"] == "1 % noise" and 1e-5 < noisy["error"] < 0.1 and 0 <= noisy["covered"] <= 1
    compared = {row["name"]: row for row in timed if row["protocol"] == "four-bar, warm"}
    assert set(compared) == set(identification.WAYS)
    assert compared["udkjax"]["error"] < 1e-8 and compared["least_squares"]["error"] < 1e-3
    assert [row["parameters"] for row in timed if row["protocol"] == "sprung chain, warm"] == [3]
    judged = {row["claim"]: row["figure"] for row in table.judge({"identification": figures})}
    assert judged["identified from within 50 %, linkage: share right to 1e-8"] == 1.0


@pytest.mark.slow
def test_measurements_tell_what_is_to_be_found():
    """The measurements determine each parameter of the smallest case, by central differences."""
    m = measurements.linkage(end=2.0)
    predicted, truth = m.predictor(), m.unknowns.guess
    values = np.asarray(predicted(truth, 1e-10)[0])
    steps = 1e-3 * np.eye(len(truth))
    slopes = [(predicted(truth * np.exp(e), 1e-10)[0] - predicted(truth * np.exp(-e), 1e-10)[0]) / 2e-3 for e in steps]
    weighted = np.stack([np.ravel(slope / values.std(0)) for slope in slopes], 1) / np.sqrt(values.size)
    assert np.linalg.svd(weighted, compute_uv=False)[-1] > 2e-3


def test_first_guesses_of_every_measurement_are_around_the_truth():
    assert tuple(identification.CASES) == table.IDENTIFIED
    for case in identification.CASES:
        m = identification.made(case, {})
        starts = m.starts(50, 0.5) / m.unknowns.guess
        assert 3 <= starts.shape[1] <= 8 and 0.5 <= starts.min() < 0.55 and 1.45 < starts.max() <= 1.5
        assert len(m.ts) == round(m.end * m.rate) + 1


@pytest.mark.slow
def test_the_command_writes_figures_table_and_page(tmp_path):
    """Figures of an earlier run in the folder are included, and not computed again."""
    earlier = [{"name": "udkjax", "start": -45.0, "outputs": "end only", "target": 1e-6, "per_second": 123.0}]
    (tmp_path / "batch.json").write_text(json.dumps({"machine": {}, "figures": earlier}))
    main(["startup", "--smoke", "--out", str(tmp_path)])
    written = json.loads((tmp_path / "startup.json").read_text())
    assert written["machine"]["jax"].startswith(jax.__version__)
    seconds = {row["name"]: row["seconds"] for row in written["figures"]}
    assert 0 < seconds["python"] < seconds["import jax"]
    table = {row["claim"]: row for row in json.loads((tmp_path / "table.json").read_text())["figures"]}
    assert table["start: import udkjax and simulate, s"]["figure"] == seconds["import udkjax and simulate"]
    assert table["batch, 10 s, hanging, error 1e-06: trajectories per second and core"]["holds"] is False
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "Not measured here: right_hand_side, methods, integrators, trajectory" in page


def test_work_at_equal_error():
    """Interpolated between two measured points, on a straight line in logarithms; not extrapolated."""
    work = Work([(1e-4, 100), (1e-8, 400)])
    assert work.at(1e-6) == pytest.approx(200)
    assert np.isnan(work.at(1e-9))


def test_what_is_worse_in_both_is_left_out():
    assert frontier([(1e-6, 3.0), (1e-4, 5.0), (1e-8, 8.0), (float("nan"), 1.0), (1e-4, 2.0)]) == [
        (1e-8, 8.0),
        (1e-6, 3.0),
        (1e-4, 2.0),
    ]


def test_each_round_at_equal_error():
    errors = {("a", 1): 1e-4, ("a", 2): 1e-8, ("b", 1): 1e-3, ("b", 2): 1e-5}
    times = {("a", 1): [1.0, 2.0], ("a", 2): [4.0, 8.0], ("b", 1): [1.0, 1.0], ("b", 2): [2.0, 2.0]}
    costs = at_equal_error(times, errors, 1e-6)
    assert costs["a"] == pytest.approx([2.0, 4.0])
    assert np.isnan(costs["b"]).all()


@pytest.mark.slow
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


def test_the_scripts_of_mechanisms_agree():
    values = mechanisms.START + np.linspace(0.0, 1.0, 5)
    np.testing.assert_allclose(mechanisms.by_fsolve(values), mechanisms.rocker(values), atol=1e-12)
