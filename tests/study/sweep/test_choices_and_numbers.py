"""Choices together with numbers that only some of them have, and labels by which xarray selects."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk

TS = np.linspace(0.0, 0.5, 6)


def height(mechanism, solution):
    return jnp.max(solution.q[:, 0, 1])


@pytest.fixture(scope="module")
def data():
    stabilization = {
        "stabilization": [None, udk.Projection(), udk.Baumgarte(), udk.Baumgarte()],
        "alpha": [np.nan, np.nan, 2, 500],
    }
    axes = {"how": udk.Zipped(stabilization), "method": [udk.SVD(1e-4), udk.Varga(1e-4)]}
    linkage = udk.library.parallelogram()
    return udk.sweep(linkage, axes, TS, ["final", "seconds", height], units={"height": "m"}, progress=False)


@pytest.mark.slow
def test_xarray_selects_methods_by_their_labels(data):
    assert data.sel(pseudoinverse="SVD").q_end.dims == data.sel({"method": "SVD"}).q_end.dims == ("how", "body", "coordinate")
    assert data.method.values.tolist() == ["SVD", "Varga"] and data.sizes["pseudoinverse"] == 2


@pytest.mark.slow
def test_numbers_apply_to_the_choices_that_have_them(data):
    assert np.all(data.result == 0) and np.isnan(data.alpha.values[:2]).all()
    assert data.stabilization.values.tolist() == ["none", "Projection", "Baumgarte(beta=5)", "Baumgarte(beta=5) #2"]
    linkage = udk.library.parallelogram()
    for k, stabilization in enumerate((None, udk.Projection(), udk.Baumgarte(2.0), udk.Baumgarte(500.0))):
        alone = udk.simulate(linkage, TS, method=udk.SVD(1e-4), stabilization=stabilization)
        assert_allclose(data.q_end[k, 0], alone.q[-1], rtol=0, atol=1e-9)


def test_numbers_of_some_choices_may_be_an_axis(linkage):
    axes = {"stabilization": [None, udk.Baumgarte()], "alpha": [2.0, 500.0]}
    steps = udk.sweep(linkage, axes, TS, "counts", progress=False).steps.values
    assert steps[0, 0] == steps[0, 1] and steps[1, 0] < steps[1, 1]


def test_the_time_of_each_member_can_be_stored(data):
    assert data.seconds.units == "s" and np.all(data.seconds > 0)
    for half in (data.isel(how=0), data.isel(how=1)):
        assert np.ptp((half.seconds / half.steps).values) < 1.0


def test_own_measures_have_units(data):
    assert data.height.units == "m"
    with pytest.raises(udk.SweepError, match='no measure of your own stores "hieght"; did you mean "height"'):
        udk.sweep(udk.library.parallelogram(), {"rtol": [1e-5]}, TS, height, units={"hieght": "m"}, progress=False)


@pytest.mark.slow
def test_constant_steps_show_the_order_of_a_method():
    """A pendulum as a mechanism, and a point on a circle as a system: errors fall with the square of the step."""
    pendulum, ts = udk.library.simple_pendulum(), np.linspace(0.0, 1.0, 3)
    point = udk.ConstrainedSystem(
        lambda q: jnp.eye(2), lambda t, q, v: jnp.array([0.0, -9.81]), lambda t, q: q @ q - 1.0, q0=[1.0, 0.0]
    )
    how = {"solver": diffrax.Heun(), "stepsize_controller": diffrax.ConstantStepSize()}
    for model in (pendulum, point):
        exact = udk.simulate(model, ts, rtol=1e-11, atol=1e-11).q[-1]
        data = udk.sweep(model, {"dt0": [0.005, 0.0025, 0.00125]}, ts, progress=False, **how)
        assert data.dt0.units == "s" and data.steps.values.tolist() == [200, 400, 800]
        errors = np.abs(data.q_end.values - np.asarray(exact)).reshape(3, -1).max(1)
        assert_allclose(errors[:-1] / errors[1:], 4.0, rtol=0.1)
        controllers = [None, diffrax.ConstantStepSize()]
        both = udk.sweep(model, {"stepsize_controller": controllers}, ts, progress=False, dt0=0.01, solver=diffrax.Heun())
        assert both.stepsize_controller.values.tolist() == ["default", "ConstantStepSize"]
        assert both.sel(stepsize_controller="ConstantStepSize").steps == 100


@pytest.mark.parametrize("out", [False, True])
@pytest.mark.parametrize("part", ["measure", "axis", "reference"])
def test_functions_that_cannot_be_traced_are_refused_in_words(linkage, tmp_path, part, out):
    of = (lambda m, x: m.with_parameters({"body.link1.mass": float(x)})) if part == "axis" else "body.link1.mass"
    measure = {"measure": lambda m, s: float(s.q[-1, 0, 2])} if part == "measure" else {}
    if part == "reference":
        measure = {"measure": "error", "reference": lambda m, ts: np.zeros((6, 4, 3)) * float(ts[0] + m.bodies["link1"].mass)}
    place = {"measure": 'measure "lambda"', "axis": 'axis "x"', "reference": "reference"}[part]
    folder = {"out": tmp_path / "s"} if out else {}
    with pytest.raises(udk.SweepError, match=rf"{place}: write it in jax\.numpy"):
        udk.sweep(linkage, {"x": udk.Axis([1.0], of)}, TS, progress=False, **measure, **folder)
    assert not (tmp_path / "s").exists()
