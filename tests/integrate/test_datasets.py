"""Runs as datasets, and as files that other programs can read."""

import json

import jax
import numpy as np
import xarray
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.scenes import TS, Until, with_force


def test_a_dataset(pendulum, motion):
    data = motion.to_xarray(pendulum)
    assert data["q"].dims == data["v"].dims == ("time", "body", "coordinate")
    assert_allclose(data["q"].sel(body="rod", coordinate="angle"), motion.q[:, 0, 2])
    assert list(data["coordinate"].values) == ["x", "y", "angle"]
    assert data["time"].attrs["units"] == "s" and data["q"].attrs["units"] == "m, m, rad"
    assert data.attrs["result"] == "successful" and data.attrs["end_time"] == 1.0
    assert data.attrs["stats_steps"] == int(motion.stats["steps"])
    assert data.attrs["setting_rtol"] == 1e-8
    assert data.attrs["setting_solver"] == "Dopri8" and data.attrs["setting_method"] == "Auto"
    assert data.attrs["setting_stabilization"] == "Projection"
    assert data.attrs["version_jax"] == jax.__version__
    assert json.loads(data.attrs["parameters"])["body.rod.mass"] == 2.0
    again = udk.loads(data.attrs["scene"])
    assert_allclose(udk.simulate(again, TS).q, motion.q, atol=1e-12)
    assert "scene" not in motion.to_xarray().attrs


def test_a_dataset_of_a_failure_and_of_own_classes(pendulum):
    mech = with_force(pendulum, Until("rod", 0.45))
    data = udk.simulate(mech, TS, throw=False).to_xarray(mech)
    assert data.attrs["result"] == "not_finite" and "0.4" in data.attrs["cause"]
    assert data.attrs["scene"].startswith("# ")


def test_a_file_that_anyone_can_read(pendulum, motion, tmp_path):
    motion.to_xarray(pendulum).to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    with xarray.open_dataset(tmp_path / "run.nc", engine="h5netcdf") as data:
        found = float(data.q.sel(body="rod", coordinate="x")[-1]), data.attrs["result"], data.attrs["stats_steps"]
    assert found == (float(motion.q[-1, 0, 0]), "successful", int(motion.stats["steps"]))


def test_a_system_of_ones_own_has_a_dataset():
    ball = udk.ConstrainedSystem(mass=lambda q: np.eye(2), force=lambda t, q, v: -q)
    data = udk.simulate(ball, [0.0, 1.0], udk.State(np.array([1.0, 0.0]), np.zeros(2))).to_xarray(ball)  # pyright: ignore[reportArgumentType]
    assert data.q.dims == ("time", "coordinate") and dict(data.sizes) == {"time": 2, "coordinate": 2}
    assert_allclose(data.q[-1, 0], np.cos(1.0), rtol=0, atol=1e-7)
