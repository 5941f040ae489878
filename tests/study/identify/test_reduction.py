"""Least squares of few rows: residuals in blocks, the triangular factor of their Jacobian, and fits that agree."""

import subprocess
import sys

import numpy as np
import pytest

import udkjax as udk
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum, swing
from udkjax.study.identify.problem import fit_problem
from udkjax.study.identify.problem.fit_problem import FitProblem
from udkjax.study.identify.problem.parameters import unknowns_of
from udkjax.study.identify.problem.residuals import reduce_rows
from udkjax.study.identify.records.records import Record
from udkjax.study.identify.search.least_squares import Fit
from udkjax.study.identify.search.search import count_agreeing

TOL = 1e-7, 1e-7


@pytest.mark.parametrize(("rows", "columns"), [(3, 5), (40, 3), (20_000, 4), (5000, 60)])
def test_reduced_rows_have_the_same_products(rows, columns):
    rng = np.random.default_rng(rows)
    J = rng.standard_normal((rows, columns)) * 10.0 ** np.linspace(0, -9, columns)  # J^T J would lose half of the digits
    J[:, -1] = J[:, 0] + J[:, -1] if columns > 3 else 0.0
    r = rng.standard_normal(rows)
    few, factor = reduce_rows(r, J)
    assert factor.shape == (min(rows, columns + 1), columns)
    np.testing.assert_allclose(few @ few, r @ r, rtol=1e-12)
    size = np.linalg.norm(J, axis=0)
    np.testing.assert_allclose(factor.T @ few, J.T @ r, atol=1e-12 * np.linalg.norm(r) * size.max())
    assert np.all(np.abs(factor.T @ factor - J.T @ J) <= 1e-12 * np.outer(size, size))


def use_windows(monkeypatch):
    """Let each piece be a window of 8 times."""
    for name, value in {"LEAST_WINDOW": 8, "WINDOW_BYTES": 1, "BLOCK_BYTES": 1}.items():
        monkeypatch.setattr(fit_problem, name, value)


def two_records() -> list[Record]:
    """One begins before its first sample; the other is shorter, and its state is unknown."""
    angle = swing(pendulum()) + 0.01 * np.random.default_rng(0).standard_normal(len(TS))
    late = Record(TS[3:], {ANGLE: angle[3:]}, t0=0.0)
    return [late, Record(TS[:20], {ANGLE: angle[:20]}, initial_state=udk.Start(estimate="velocity"))]


@pytest.mark.parametrize("horizon", [None, 1.5])
def test_windows_have_the_rows_of_the_whole(monkeypatch, horizon):
    first, records, tol = pendulum(0.4, 0.15), two_records(), (1e-11, 1e-11)
    z = np.array([[0.1, -0.2, 0.05]])
    expected = FitProblem(first, unknowns_of(first, NAMES), records).evaluate(z, tol, horizon)
    use_windows(monkeypatch)
    problem = FitProblem(first, unknowns_of(first, NAMES), records)
    blocks = list(problem.row_blocks(z, tol, horizon))
    assert len(problem.runs.ts) == 2 * 8 and problem.runs.ts.shape[1] == 9
    assert len(blocks) == (16 if horizon is None else len(problem.runs.ts) - np.sum(problem.runs.ts[:, 1] > horizon))
    found = problem.evaluate(z, tol, horizon)
    np.testing.assert_allclose(found.r, expected.r, atol=1e-6)
    np.testing.assert_allclose(found.J, expected.J, atol=1e-6 * np.abs(expected.J).max())


@pytest.mark.slow
def test_an_estimate_is_the_same_from_windows(monkeypatch):
    records = two_records()
    records[0].values[ANGLE][[5, 30]] += 1.0
    whole = udk.identify(pendulum(0.4, 0.15), records, NAMES, loss="huber", progress=False)
    use_windows(monkeypatch)
    parts = udk.identify(pendulum(0.4, 0.15), records, NAMES, loss="huber", progress=False)
    assert len(parts.problem.runs.ts) == 16
    assert [(one.record, one.row) for one in parts.outliers] == [(one.record, one.row) for one in whole.outliers]
    np.testing.assert_allclose(parts.values, whole.values, rtol=1e-6)
    np.testing.assert_allclose(parts.uncertainty.standard_errors, whole.uncertainty.standard_errors, rtol=1e-4)
    for key, white in whole.whiteness.items():
        np.testing.assert_allclose(parts.whiteness[key], white, rtol=1e-4)


def test_fits_agree_whatever_the_value_of_an_unknown_at_its_bound():
    """Where a damping is best at zero, z tends to minus infinity, and each fit stops elsewhere on the way."""
    first, angle = pendulum(damping=0.2), np.sin(TS)
    angle = angle + 0.1 * np.random.default_rng(0).standard_normal(len(TS))
    problem = FitProblem(first, unknowns_of(first, NAMES), [Record(TS, {ANGLE: angle})])
    bound = np.array([False, True])

    def fit(z, stuck, cost=1.0):
        return Fit(np.array(z), cost, True, [], stuck)

    best = fit([0.1, -15.0], bound)
    assert count_agreeing(problem, [best, fit([0.1 + 1e-7, -11.0], bound, 1.0 + 1e-9)], TOL) == 2
    assert count_agreeing(problem, [best, fit([0.3, -11.0], bound, 1.1)], TOL) == 1  # another minimum
    assert count_agreeing(problem, [fit([0.1, -5.0], ~bound & bound), fit([0.1, -3.0], None, 1.1)], TOL) == 1
    assert count_agreeing(problem, [fit([0.1, -15.0], bound, np.inf)], TOL) == 0


PEAK = """
import sys
import numpy as np, udkjax as udk
from tests.fresh_process import peak_memory
from udkjax.study.identify.problem import fit_problem
from udkjax.study.identify.search.optimizer import Minimizer

fit_problem.BLOCK_BYTES = fit_problem.WINDOW_BYTES = 2**23
scene, ts = udk.library.four_bar(), np.linspace(0.0, 2.0, int(sys.argv[1]))
springs = {f"s{k}": udk.Spring(["ground", b], points=[[k, 1.0], [0.1, 0.0]], stiffness=5.0, damping=0.5, length=0.5)
           for k, b in enumerate(scene.bodies)}
mech = udk.Mechanism(scene.bodies, scene.joints, forces=springs)
values = {f"body.{b}.angle": np.sin(ts) for b in scene.bodies}
names = [f"force.{s}.{number}" for s in springs for number in ("stiffness", "damping", "length")]
problem = fit_problem.build_problem(mech, [udk.Record(ts, values, noise=0.1)] * 2, names, {}, tol=1e-7)
Minimizer().minimize(problem, np.zeros(problem.K), (1e-7, 1e-7), None, 1)
print(peak_memory())
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no `resource`")
def test_memory_holds_residuals_but_no_jacobian():
    """States with derivatives by 9 parameters are 1.4 kB a sample, and J is 216 B; a few vectors of residuals remain."""
    few, many = 10_000, 110_000
    peaks = [
        int(subprocess.run([sys.executable, "-c", PEAK, str(count)], check=True, capture_output=True, text=True).stdout)
        for count in (few, many)
    ]
    per_sample = (peaks[1] - peaks[0]) / (2 * (many - few))  # of two records
    assert per_sample < 500.0


SIZE = """
import numpy as np, udkjax as udk
from tests.fresh_process import peak_memory

links, ts, rng = 25, np.linspace(0.0, 0.5, 100), np.random.default_rng(0)
bodies, joints, springs, before = {}, {}, {}, "ground"
for k in range(links):
    bodies[f"b{k}"] = udk.Body(1.0 + 0.1 * (k % 3), 0.1, [k + 0.5, 0.0])
    joints[f"j{k}"] = udk.Revolute([before, f"b{k}"], [[0.5 if k else 0.0, 0.0], [-0.5, 0.0]])
    springs[f"t{k}"] = udk.TorsionSpring([before, f"b{k}"], stiffness=40.0 + 4000.0 * (1 - k / 26) ** 2, damping=5.0)
    before = f"b{k}"
right = udk.Mechanism(bodies, joints, forces=springs)
records = []
for _ in range(10):
    angles = 0.1 * rng.standard_normal(links)
    steps = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    start = udk.State(np.column_stack([np.cumsum(steps, axis=0) - 0.5 * steps, angles]), np.zeros((links, 3)))
    measured = np.asarray(udk.simulate(right, ts, start).q)[:, :, 2] + 1e-3 * rng.standard_normal((len(ts), links))
    records.append(udk.Record(ts, {f"body.{b}.angle": measured[:, k] for k, b in enumerate(bodies)}, initial_state=start))
values = {n: float(x) for n, x in right.parameters().items() if n.startswith("force.") and n.endswith(("stiffness", "damping"))}
first = right.with_parameters({name: 1.1 * x for name, x in values.items()})
found = udk.identify(first, records, list(values), progress=False)
assert found.success and len(values) == 50
errors = (found.values - list(values.values())) / found.uncertainty.standard_errors
print(np.sqrt(np.mean(errors**2)), np.abs(errors).max())
print(peak_memory())
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no `resource`")
def test_fifty_parameters_of_twenty_five_links_from_ten_records():
    """They are right to within their standard errors, in 0.75 GB, most of it for compilation, and half a minute of a core."""
    lines = subprocess.run([sys.executable, "-c", SIZE], check=True, capture_output=True, text=True).stdout.splitlines()
    mean, largest = map(float, lines[0].split())
    assert 0.7 < mean < 1.3 and largest < 4.0
    assert int(lines[1]) < 1.2e9
