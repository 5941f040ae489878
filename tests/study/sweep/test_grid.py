"""Sweeps in files: read into arguments, and refused by the path of the entry."""

from pathlib import Path

import numpy as np
import pytest
import xarray
from scipy import stats

import udkjax as udk
from udkjax.study.quantities import InitialAngle, Length, Scaled
from udkjax.study.sweep.axes import Axis, LatinHypercube, Sobol, Zipped
from udkjax.study.sweep.grid import GridError, load_grid, loads_grid

EXAMPLE = Path(__file__).parents[3] / "examples" / "grids" / "parallelogram.toml"


def axes(text, top="t1 = 1.0"):
    return loads_grid(f"{top}\n[axes]\n{text}")["axes"]


def test_a_file_is_the_arguments_of_a_sweep():
    given = load_grid(EXAMPLE)
    np.testing.assert_array_equal(given["ts"], [0.0, 10.0])
    assert given["measure"] == ("final", "violation", "counts")
    assert list(given["axes"]) == ["body.coupler.mass", "tol", "start", "stabilization"]
    mass, tolerance, start, stabilization = given["axes"].values()
    np.testing.assert_array_equal(mass.values, np.linspace(0.5, 4.5, 9))
    np.testing.assert_allclose(tolerance.values, 10.0 ** np.arange(-10, -2))
    assert mass.of is None and tolerance.of == ("rtol", "atol") and start.of == InitialAngle(("link1", "link2", "link3"))
    assert isinstance(stabilization.values[0], udk.Projection) and isinstance(stabilization.values[1], udk.Baumgarte)
    assert isinstance(given["method"], udk.Auto) and type(given["solver"]).__name__ == "Dopri8"
    assert given["drift_tol"] == 1e-3 and "design" not in given


def test_axes_in_all_their_forms():
    found = axes(
        """
        "joint.A1.points" = [[[0.0, 0.0], [0.5, 0.0]]]
        rods = { values = [1, 2], of = { length = ["link1"], as_rod = true }, units = "m" }
        load = { values = [1.0], of = { "body.a.mass" = 1.0, "body.a.inertia" = 0.1 } }
        both = { zipped = { rtol = [1e-3, 1e-4], method = ["svd", { type = "varga", rank_tol = 1e-5 }] } }
        """
    )
    assert found["joint.A1.points"].values.shape == (1, 2, 2)
    assert found["rods"].of == Length(("link1",), True) and found["rods"].units == "m"
    assert found["load"].of == Scaled({"body.a.mass": 1.0, "body.a.inertia": 0.1})
    assert isinstance(found["both"], Zipped) and isinstance(found["both"].axes["rtol"], Axis)
    assert [type(m) for m in found["both"].axes["method"].values] == [udk.SVD, udk.Varga]


def test_scaled_parameters_follow_one_value():
    mech = udk.library.compound_pendulum()
    (body,) = mech.body_names
    changed = Scaled({f"body.{body}.mass": 2.0, f"body.{body}.inertia": 0.5})(mech, 3.0).parameters()
    assert float(changed[f"body.{body}.mass"]) == 6.0 and float(changed[f"body.{body}.inertia"]) == 1.5


def test_a_design_draws_from_ranges_and_distributions():
    given = loads_grid(
        """
        t1 = 1.0
        design = { type = "sobol", members = 8, seed = 3 }
        axes.a = { from = 1.0, to = 2.0 }
        axes.b = { from = 1e-9, to = 1e-3, scale = "log", of = "rtol" }
        axes.c = { distribution = "norm", loc = 1.0, scale = 0.1 }
        """
    )
    assert given["design"] == Sobol(8, 3)
    assert given["axes"]["a"].values == (1.0, 2.0)
    np.testing.assert_allclose(given["axes"]["b"].values.ppf([0, 0.5, 1]), [1e-9, 1e-6, 1e-3])
    assert given["axes"]["c"].values.ppf(0.3) == stats.norm(1.0, 0.1).ppf(0.3)
    assert isinstance(loads_grid("t1=1.0\naxes.a=[0, 1]\ndesign={type='latin-hypercube', members=4}")["design"], LatinHypercube)


def test_output_times():
    times = lambda top: loads_grid(f"{top}\naxes.a = [1.0]")["ts"]  # noqa: E731
    np.testing.assert_array_equal(times("t0 = 1\nt1 = 2"), [1.0, 2.0])
    np.testing.assert_allclose(times("t1 = 0.3\ndt = 0.1"), [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(times("ts = [0, 0.5, 2]"), [0.0, 0.5, 2.0])


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("t1 = 1.0", "axes: missing"),
        ("t1 = 1.0\naxes = 3", "axes: must be a table, not 3"),
        ("axes.a = [1]", "t1: missing; write t1 = 10.0 (s)"),
        ("t1 = -1.0\naxes.a = [1]", "t1: must be later than t0 = 0, not -1"),
        ("t1 = true\naxes.a = [1]", "t1: must be a finite number, not true"),
        ("t1 = 1.0\ndt = 2.0\naxes.a = [1]", "dt: must be positive and at most t1 - t0 = 1, not 2"),
        ("t1 = 1.0\nts = [0, 1]\naxes.a = [1]", "t1: ts is also given"),
        ("ts = [1, 1]\naxes.a = [1]", "ts: must be at least two increasing times"),
        ("t1 = 1.0\nmeasure = 'final'\naxes.a = [1]", 'measure: unknown key; did you mean "measures"?'),
        ("t1 = 1.0\nmeasures = [1]\naxes.a = [1]", "measures: must be a list of names, not [1]"),
        ("t1 = 1.0\naxes.a = []", "axes.a: must be a list of values"),
        ('t1 = 1.0\naxes."body.a.mass" = [1, "x"]', 'axes."body.a.mass": must be a list of finite numbers'),
        ("t1 = 1.0\naxes.a = [[1, 2], [3]]", "axes.a: must be a list of finite numbers"),
        ("t1 = 1.0\naxes.a = {from = 1, to = 2}", "axes.a.num: missing"),
        ("t1 = 1.0\naxes.a = {from = 1, to = 2, num = 3, nun = 3}", 'axes.a.nun: unknown key; did you mean "num"?'),
        ("t1 = 1.0\naxes.a = {from = 1, to = 2, num = 0}", "axes.a.num: must be a whole number, at least 1, not 0"),
        ("t1 = 1.0\naxes.a = {from = 0, to = 2, num = 3, scale = 'log'}", "axes.a: from and to must be positive"),
        ("t1 = 1.0\naxes.a = {from = 1, to = 2, num = 3, scale = 'lin'}", 'axes.a.scale: must be one of "linear", "log"'),
        ("t1 = 1.0\naxes.a = {from = 1, to = 2, num = 3, scale = ['log']}", 'axes.a.scale: must be one of "linear", "log"'),
        ("t1 = 1.0\naxes.method = ['auto', 'sdv']", 'axes.method[1]: unknown method "sdv"; did you mean "svd"?'),
        ("t1 = 1.0\naxes.a = {zipped = {rtol = [1], method = ['x']}}", 'axes.a.zipped.method[0]: unknown method "x"'),
        ("t1 = 1.0\naxes.a = {values = [1], units = 3}", "axes.a.units: must be a string, not 3"),
        ("t1 = 1.0\naxes.a = {values = [1], of = 3}", "axes.a.of: must be a name, a list of names or a table, not 3"),
        ("t1 = 1.0\naxes.a = {values = [1], of = {length = 3}}", "axes.a.of.length: must be a list of names, not 3"),
        ("t1 = 1.0\naxes.a = {distribution = 'norm'}", "axes.a.distribution: needs a [design]"),
        ("t1 = 1.0\naxes.a = [1]\nsettings.rtoll = 1e-8", 'settings.rtoll: unknown key; did you mean "rtol"?'),
        ("t1 = 1.0\naxes.a = [1]\nsettings.max_steps = 1.5", "settings.max_steps: must be a whole number, at least 1"),
        ("t1 = 1.0\naxes.a = [1]\nsettings.solver = 'rk4'", 'settings.solver: unknown solver "rk4"'),
        ("t1 = 1.0\naxes.a = [0, 1]\ndesign = {type = 'sobel', members = 4}", 'not "sobel"; did you mean "sobol"?'),
        ("t1 = 1.0\naxes.a = [0, 1]\ndesign = {type = 'sobol'}", "design.members: missing"),
        ("t1 = 1.0\naxes.a = {distribution = 'nrom'}\ndesign = {type = 'sobol', members = 4}", 'did you mean "norm"?'),
        ("t1 = 1.0\naxes.a = {distribution = 'norm', mu = 1}\ndesign = {type = 'sobol', members = 4}", "axes.a: "),
        ("t1 = 1.0\naxes.a = [1]\nreference = 3", "reference: must be the name of a file written by udkjax simulate, not 3"),
        ("t1 = ", "not valid TOML"),
    ],
)
def test_a_mistake_is_named_by_its_place(text, problem):
    with pytest.raises(GridError) as caught:
        loads_grid(text, "grid.toml")
    assert len(caught.value.problems) == 1 and problem in str(caught.value) and str(caught.value).startswith("grid.toml: ")


def test_a_reference_is_the_file_of_a_simulation(tmp_path):
    q = np.arange(12.0).reshape(2, 2, 3)
    xarray.Dataset({"q": (("time", "body", "coordinate"), q)}).to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    grid = tmp_path / "grid.toml"
    grid.write_text("t1 = 1.0\naxes.rtol = [1e-8]\nmeasures = 'error'\nreference = 'run.nc'")
    np.testing.assert_array_equal(load_grid(grid)["reference"], q)
    grid.write_text("t1 = 1.0\naxes.rtol = [1e-8]\nmeasures = 'error'\nreference = 'runs.nc'")
    with pytest.raises(GridError, match=r"reference: .*runs\.nc has no coordinates q"):
        load_grid(grid)


def test_all_mistakes_are_named_at_once(tmp_path):
    with pytest.raises(GridError, match=r"3 mistakes in the grid:\n  axes\.b: .*\n  t1: missing.*\n  settings\.x: "):
        loads_grid("axes.a = [1]\naxes.b = 'x'\nsettings.x = 1")
    (tmp_path / "grid.toml").write_bytes(b"\xff")
    with pytest.raises(GridError, match="UTF-8"):
        load_grid(tmp_path / "grid.toml")
