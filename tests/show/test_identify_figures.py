"""Pictures of made-up identifications."""

from typing import Any

import numpy as np
import pytest
import xarray

from udkjax.show import identify_figures
from udkjax.show.fit_figures import fit, residuals
from udkjax.show.identify_figures import pictures, save_fit_pictures

N, NOISE = 60, 0.02
KINDS = ("angle", "omega")
TIED = "length(a) = length(b) = length(c)"


def made(records=("push", "pull"), channels=2, parameters=("body.a.mass", "body.b.mass", TIED), seed=0):
    """Sines with noise; the last channel is not measured in the last record, and the second record is shorter."""
    rng = np.random.default_rng(seed)
    shape = len(records), N, channels
    time = np.linspace(0.0, 3.0, N) + np.arange(len(records))[:, None]
    predicted = np.sin(time[..., None] * np.arange(1, channels + 1))
    residual = NOISE * rng.normal(size=shape)
    if len(records) > 1:
        predicted[-1, :, -1] = predicted[1, N // 2 :] = np.nan
    residual = np.where(np.isnan(predicted), np.nan, residual)
    noise = np.where(np.isnan(predicted), np.nan, NOISE)
    P = len(parameters)
    correlation = 0.3 + 0.7 * np.eye(P)
    error = np.full(P, 0.01)
    if P > 1:
        correlation[0, 1:] = correlation[1:, 0] = np.nan
        error[0] = np.inf
    along = "record", "sample", "channel"
    return xarray.Dataset(
        {
            "measured": (along, predicted + residual),
            "predicted": (along, predicted),
            "residual": (along, residual),
            "noise": (along, noise),
            "correlated": (("record", "channel"), rng.uniform(0.1, 1.0, (len(records), channels))),
            "first_guess": ("parameter", np.ones(P)),
            "value": ("parameter", np.full(P, 2.0)),
            "standard_error": ("parameter", error),
            "correlation": (("parameter", "other_parameter"), correlation),
            "cost": ("trial", [5.0, 1.0, 0.5, 60.0, 30.0]),
            "change": ("trial", [1.0, 0.1, 0.0, 0.2, 1e-9]),
        },
        {
            "record": list(records),
            "time": (("record", "sample"), time),
            "channel": [f"body.link{k}.{KINDS[k % 2]}" for k in range(channels)],
            "channel_units": ("channel", [("rad", "rad/s")[k % 2] for k in range(channels)]),
            "parameter": list(parameters),
        },
        {"title": "made up"},
    )


def shown(figure) -> list[Any]:
    return [axes for axes in figure.axes if axes.axison and axes.get_label() != "<colorbar>"]


def test_records_are_side_by_side_and_a_missing_channel_leaves_an_empty_panel():
    data = made()
    figure = pictures(data)["fit"]
    panels = shown(figure)
    assert [axes.get_title(loc="left") for axes in panels] == [
        "body.link0.angle, push",
        "body.link0.angle, pull",
        "body.link1.omega, push",
    ]
    assert len(figure.axes) == 4 and [axes.get_ylabel() for axes in panels] == ["rad", "rad", "rad/s"]
    assert [axes.get_xlabel() for axes in panels] == ["", "time (s)", "time (s)"]
    points, line = panels[1].lines
    np.testing.assert_array_equal(points.get_xydata(), np.stack([data.time[1], data.measured[1, :, 0]], 1)[: N // 2])
    np.testing.assert_array_equal(line.get_ydata(), data.predicted[1, : N // 2, 0])


def test_residuals_are_compared_with_the_noise():
    data = made()
    over_time, spread, correlated, *_ = shown(pictures(data)["residuals"])
    assert [line.get_label() for line in over_time.lines[::2]] == ["push", "pull"]
    np.testing.assert_array_equal(over_time.lines[0].get_ydata(), data.residual[0, :, 0])
    assert over_time.collections[0].get_datalim(over_time.transData).height == pytest.approx(4 * NOISE)
    (curve,) = spread.lines
    density, y = curve.get_xdata(), curve.get_ydata()
    np.testing.assert_allclose(density, np.exp(-0.5 * (y / NOISE) ** 2) / (np.sqrt(2 * np.pi) * NOISE), rtol=1e-12)
    area = sum(bar.get_width() * bar.get_height() for bar in spread.patches)
    assert area == pytest.approx(1.0)
    bars = correlated.collections[0].get_segments()
    e = [data.residual[0, :, 0].values, data.residual[1, : N // 2, 0].values]
    lag3 = sum(x[3:] @ x[:-3] for x in e) / sum(x @ x for x in e)
    assert len(bars) == N // 4 and bars[2][1][1] == pytest.approx(lag3)


def test_only_the_channels_that_look_least_like_noise_are_shown_if_there_are_many():
    data = made(channels=5)
    data["correlated"][0, 3], data["correlated"][1, 1] = 1e-6, 1e-9
    found = {"residuals": residuals(data, most_channels=2), "fit": fit(data, most_panels=4)}
    panels = shown(found["residuals"])
    assert [axes.get_title(loc="left") for axes in panels[::3]] == ["body.link1.omega", "body.link3.omega"]
    assert "2 of 5 channels" in found["residuals"].get_suptitle()
    assert len(shown(found["fit"])) == 4 and "4 of 9" in found["fit"].get_suptitle()


def test_an_unknown_standard_error_has_no_correlation_and_no_bar():
    figure = pictures(made())["correlation"]
    matrix, errors = shown(figure)
    drawn = matrix.images[0].get_array()
    np.testing.assert_array_equal(np.ma.getmaskarray(drawn), [[False, True, True], [True, False, False], [True, False, False]])
    labels = [text.get_text() for text in matrix.get_yticklabels()]
    assert labels == ["body.a.mass  1", "body.b.mass  2", "length(a) = ... (3 tied)  3"]
    assert [(bar.get_y() + 0.3, bar.get_x() + bar.get_width()) for bar in errors.patches] == [(1, 0.5), (2, 0.5)]
    assert [text.get_text() for text in errors.texts] == ["unknown"]
    assert "correlation" not in pictures(made(parameters=("body.a.mass",)))


def test_a_cost_that_rises_begins_another_fit():
    cost, change = shown(pictures(made())["convergence"])
    assert [list(line.get_xdata()) for line in cost.lines] == [[1, 2, 3], [4, 5]]
    assert [list(line.get_ydata()) for line in change.lines] == [[1.0, 0.1, identify_figures.ZERO_DRAWN], [0.2, 1e-9]]


def test_profiles_are_drawn_with_their_approximation_by_the_standard_error():
    data = made()
    data["parameter_units"] = "parameter", ["kg", "kg", "m"]
    x = np.array([[1.98, 2.0, 2.03, np.nan], [1.0, 2.0, 3.0, 4.0]])
    more = xarray.Dataset(
        {
            "profile_value": (("profile", "point"), x),
            "rise": (("profile", "point"), [[4.0, 0.0, 4.0, np.nan], [1.0, 0.0, 1.0, 2.0]]),
            "interval": (("profile", "end"), [[1.98, 2.03], [-np.inf, np.inf]], {"level": 0.95, "limit": 3.84}),
        },
        {"profile": ["body.b.mass", "body.a.mass"]},
    )
    one, two = shown(pictures(data.merge(more))["profiles"])
    curve, line, limit = one.lines
    np.testing.assert_array_equal(curve.get_xdata(), x[0, :3])
    np.testing.assert_allclose(line.get_ydata(), ((line.get_xdata() - 2.0) / 0.01) ** 2)
    assert limit.get_ydata()[0] == 3.84 and (one.get_title(loc="left"), one.get_xlabel()) == ("body.b.mass", "kg")
    assert len(two.lines) == 2  # its standard error is unknown
    assert two.patches[0].get_width() == 3.0  # an unbounded interval is drawn as far as the profile goes


@pytest.mark.slow
def test_single_samples_and_exact_fits_can_be_drawn(tmp_path):
    data = made(records=("one",), channels=1).isel(sample=slice(1))
    assert shown(pictures(data)["fit"])[0].get_title(loc="left") == "body.link0.angle"
    exact = made()
    exact["residual"], exact["noise"] = 0.0 * exact["residual"], np.nan * exact["noise"]
    assert list(save_fit_pictures(exact, tmp_path)) == ["fit.png", "residuals.png", "convergence.png", "correlation.png"]
    assert (tmp_path / "residuals.png").read_bytes().startswith(b"\x89PNG")
