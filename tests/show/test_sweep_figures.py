"""Pictures of made-up sweeps."""

from typing import Any

import numpy as np
import pytest
import xarray
from matplotlib.colors import LogNorm

from udkjax.integrate import Result
from udkjax.show.sweep_figures import pictures, save_sweep_pictures

TOLS, MASSES = 10.0 ** np.arange(-10, -6), np.array([1.0, 2.0, 4.0])
COORDS = {"rtol": TOLS, "method": ["SVD", "Varga"], "mass": MASSES, "start": [-0.8, 0.2]}


def made(*dims):
    """A sweep over these dimensions, with tolerance times mass as violation; the last but one member failed."""
    data = xarray.Dataset(coords={dim: COORDS[dim] for dim in dims})
    value = np.ones(tuple(len(COORDS[dim]) for dim in dims))
    for k, dim in enumerate(dims):
        if dim in ("rtol", "mass"):
            value = value * COORDS[dim].reshape(-1, *[1] * (len(dims) - k - 1))
    code = np.zeros(value.shape, int)
    code.flat[-2] = Result.drift
    data["result"] = dims, code
    data["violation"] = dims, np.where(code == 0, value, np.nan), {"units": "m"}
    data["q_end"] = (*dims, "body"), np.zeros((*value.shape, 2))
    data["rtol" if "rtol" in dims else dims[0]].attrs["units"] = "1"
    if "mass" in dims:
        data["mass"].attrs["units"] = "kg"
    return data


def panels(figure) -> list[Any]:
    return [
        axes for axes in figure.axes if axes.get_subplotspec() is not None and axes.axison and axes.get_label() != "<colorbar>"
    ]


def test_two_axes_are_a_map():
    figures = pictures(made("rtol", "mass"))
    assert list(figures) == ["result", "violation"]  # one number per member, unlike q_end
    (axes,) = panels(figures["violation"])
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_yscale()) == ("mass (kg)", "rtol", "log")
    (mesh,) = axes.collections
    expected = TOLS[:, None] * MASSES
    expected[-1, -2] = np.nan
    np.testing.assert_array_equal(np.ma.filled(mesh.get_array(), np.nan), expected)
    assert isinstance(mesh.norm, LogNorm) and figures["violation"].get_suptitle() == "violation (m); grey: missing values"
    corners = mesh.get_coordinates()
    np.testing.assert_allclose(corners[0, :, 0], [0.5, 1.5, 3.0, 5.0])
    np.testing.assert_allclose(corners[:, 0, 1], 10.0 ** np.arange(-10.5, -6))


def test_failures_have_a_colour_for_each_code():
    figure = pictures(made("rtol", "mass"))["result"]
    (mesh,) = panels(figure)[0].collections
    colours = mesh.cmap(mesh.norm(mesh.get_array()))
    assert len({tuple(c) for c in colours.reshape(-1, 4)}) == 2
    np.testing.assert_array_equal(colours[-1, -2], mesh.cmap(int(Result.drift)))
    labels = [text.get_text() for text in figure.axes[-1].get_yticklabels()]
    assert labels == [*(r.name.replace("_", " ") for r in Result), "not computed"]
    other = made("rtol", "mass")
    other["result"][0, 0] = -1
    (mesh,) = panels(pictures(other)["result"])[0].collections
    assert mesh.get_array()[0, 0] == len(Result)


def test_other_axes_have_panels():
    data = made("start", "rtol", "method", "mass")
    figure = pictures(data)["violation"]
    assert [axes.get_title() for axes in panels(figure)] == [
        f"{start}, {method}" for start in ("start -0.8", "start 0.2") for method in ("SVD", "Varga")
    ]
    (mesh,) = panels(figure)[2].collections
    np.testing.assert_array_equal(mesh.get_array(), data["violation"].isel(start=1, method=0).values)
    figure = pictures(data, most_panels=3)["violation"]
    assert len(panels(figure)) == 3 and "the first 3 of 4 panels" in figure.get_suptitle()


def test_choices_are_listed_from_top_to_bottom():
    (axes,) = panels(pictures(made("method", "rtol"))["violation"])
    assert [text.get_text() for text in axes.get_yticklabels()] == ["SVD", "Varga"]
    assert axes.get_ylim() == (1.5, -0.5)


@pytest.mark.parametrize("dim", ["rtol", "method"])
def test_one_axis_is_a_line_with_crosses_where_members_failed(dim):
    (axes,) = panels(pictures(made(dim))["violation"])
    line, crosses = axes.lines
    values = TOLS if dim == "rtol" else np.ones(2)
    np.testing.assert_allclose(line.get_ydata(), np.where(np.arange(len(values)) == len(values) - 2, np.nan, values))
    np.testing.assert_allclose(np.asarray(crosses.get_xdata()), [TOLS[-2] if dim == "rtol" else 0])
    assert axes.get_xscale() == ("log" if dim == "rtol" else "linear") and axes.get_ylabel() == "violation (m)"
    (axes,) = panels(pictures(made(dim))["result"])
    assert [text.get_text() for text in axes.get_yticklabels()] == ["successful", "drift"]


def test_members_of_a_design_are_points():
    rng = np.random.default_rng(0)
    data = xarray.Dataset(
        coords={"mass": ("member", rng.uniform(1, 2, 50), {"units": "kg"}), "rtol": ("member", 10 ** rng.uniform(-9, -3, 50))}
    )
    data["result"] = "member", np.where(np.arange(50) == 7, int(Result.drift), 0)
    data["steps"] = "member", np.arange(50), {"units": "1"}
    figures = pictures(data)
    (axes,) = panels(figures["steps"])
    (points,) = axes.collections
    np.testing.assert_allclose(points.get_offsets(), np.stack([data["mass"], data["rtol"]], axis=1))
    np.testing.assert_array_equal(points.get_array(), np.arange(50))
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_yscale()) == ("mass (kg)", "rtol", "log")


def test_members_of_a_design_with_choices_have_a_panel_for_each():
    data = xarray.Dataset(coords={"mass": ("member", MASSES), "method": ["SVD", "Varga"]})
    data["result"] = ("member", "method"), np.zeros((3, 2), int)
    data["violation"] = ("member", "method"), np.arange(6.0).reshape(3, 2)
    one, two = panels(pictures(data)["violation"])
    assert (one.get_title(), two.get_title()) == ("SVD", "Varga")
    np.testing.assert_array_equal(two.collections[0].get_offsets(), np.stack([MASSES, [1, 3, 5]], axis=1))


def test_pictures_are_written(tmp_path):
    assert list(save_sweep_pictures(made("rtol", "mass"), tmp_path)) == ["result.png", "violation.png"]
    assert (tmp_path / "result.png").read_bytes().startswith(b"\x89PNG")
