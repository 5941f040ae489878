import io
from itertools import combinations
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

import udkjax as udk
from udkjax.equations.states.quantities import Energy
from udkjax.integrate import Result, Solution
from udkjax.show import plots
from udkjax.show.figures import driven_figure
from udkjax.show.plots import farthest_instants, trajectory
from udkjax.show.style import COLOURS
from udkjax.study.accuracy import exact_coordinates


def solution(mech, q, v=None, code=Result.successful):
    q = jnp.asarray(q)
    ts = jnp.linspace(0.0, 1.0, len(q))
    v = jnp.zeros_like(q) if v is None else v
    tol = jnp.array(1e-8)
    return Solution(ts, q, v, jnp.array(int(code)), ts[-1], {"steps": jnp.array(3)}, tol, tol, mech.body_names, ())


@pytest.fixture(scope="module")
def exact(linkage):
    return exact_coordinates(linkage, np.linspace(0, 1, 21), linkage.q0, linkage.v0)


def test_trajectory_draws_the_mechanism_where_it_is(linkage, exact):
    figure = trajectory(linkage, solution(linkage, exact))
    scene, angles, constraints, energy = figure.axes
    assert figure.get_suptitle() == "five-bar parallelogram"
    strong = [np.asarray(line.get_xydata()) for line in scene.lines if line.get_linewidth() > 2 and line.get_alpha() == 1]
    assert len(strong) == len(linkage.bodies)
    tip = np.array([np.cos(-np.pi / 4), np.sin(-np.pi / 4)])
    for drawn, pivot in zip(strong, ([0, 0], [1, 0], [2, 0]), strict=False):
        ends = drawn[np.argsort(-drawn[:, 1])]
        np.testing.assert_allclose(ends, np.add(pivot, [0 * tip, tip]), atol=1e-12)
    assert angles.get_legend_handles_labels()[1] == ["link1, link2, link3", "coupler"]
    assert constraints.get_yscale() == "log" and np.asarray(constraints.lines[0].get_ydata()).max() < 1e-14
    assert energy.get_xlabel() == "time (s)"


def test_a_pin_of_a_single_link_is_drawn_with_its_path():
    mech = udk.Drawing(
        pins={"O": (0, 0), "A": (1, 0), "P": (3, 1)}, links={"plate": udk.Link(["O", "A", "P"], mass=1)}, ground=["O"]
    ).mechanism()
    q = np.repeat(np.asarray(mech.q0)[None], 2, axis=0)
    q[1] += [0.1, 0.2, 0.0]
    (scene, *_) = trajectory(mech, solution(mech, q)).axes
    drawn = [np.asarray(line.get_xydata()) for line in scene.lines if line.get_alpha() in (1, 0.6)]
    assert (
        sum(bool((abs(points - [3, 1]).max(axis=1) < 1e-12).any()) for points in drawn) == 2
    )  # the plate's corner, and the path


def test_poses_are_far_apart(exact):
    chosen = farthest_instants(exact, 4)
    assert chosen[0] == 0 and len(set(chosen)) == 4
    angles = exact[chosen, 0, 2]
    assert np.ptp(angles) == pytest.approx(np.ptp(exact[:, 0, 2]))
    assert farthest_instants(exact[:1].repeat(3, axis=0), 4) == [0]  # a mechanism at rest has one pose


def test_two_pictures_do_not_share_anything(linkage, exact):
    first, second = (trajectory(linkage, solution(linkage, exact)) for _ in range(2))
    assert not set(first.axes) & set(second.axes)


def test_a_failed_run_is_drawn_up_to_its_failure(linkage, exact):
    broken = np.where(np.arange(len(exact))[:, None, None] < 5, exact, np.nan)
    figure = trajectory(linkage, solution(linkage, broken, code=Result.step_limit))
    figure.savefig(io.BytesIO(), format="png")
    assert np.isfinite(figure.axes[0].get_xlim()).all()


# Plots on given axes.


@pytest.fixture
def axes():
    return Figure().subplots()


def line(axes, label) -> np.ndarray:
    (found,) = (one for one in axes.lines if one.get_label() == label)
    return np.asarray(found.get_xydata())


TS = np.linspace(0, 1, 5)


@pytest.fixture
def sweep_data():
    data = xarray.Dataset(coords={"mass": ("mass", [1.0, 2.0, 3.0], {"units": "kg"}), "rtol": [1e-8, 1e-6]})
    data["result"] = ("mass", "rtol"), np.array([[0, 0], [0, int(Result.drift)], [0, 0]])
    data["violation"] = ("mass", "rtol"), np.arange(6.0).reshape(3, 2), {"units": "m"}
    return data


def test_heat_maps(axes, sweep_data):
    assert plots.draw_sweep(axes, sweep_data, "violation") is axes
    mesh: Any = axes.collections[0]
    np.testing.assert_array_equal(np.asarray(mesh.get_array()).ravel(), np.arange(6.0))
    assert (axes.get_ylabel(), axes.get_xlabel()) == ("mass (kg)", "rtol")
    assert mesh.colorbar.ax.get_ylabel() == "violation (m)"
    one = Figure().subplots()
    plots.draw_sweep(one, sweep_data.isel(rtol=0), "violation")
    np.testing.assert_array_equal(one.lines[0].get_ydata(), [0, 2, 4])
    with pytest.raises(ValueError, match="several panels: select values"):
        plots.draw_sweep(axes, sweep_data.expand_dims(method=["SVD", "Varga"]), "violation")


def test_reactions_and_their_uniqueness(axes):
    load = np.array([[3.0, 4.0, 0.0]] * 5)
    unique = {"A": {"link": load >= 0}, "B": {"link": load > 3}}
    assert plots.draw_reactions(axes, TS, {"A": {"link": load}, "B": {"link": 2 * load}}, unique) is axes
    np.testing.assert_allclose(line(axes, "A")[:, 1], 5)
    np.testing.assert_allclose(line(axes, "B (not unique)")[:, 1], 10)
    assert axes.lines[1].get_linestyle() == ":" and axes.get_ylabel() == "joint force (N)"


def test_coupler_curves_begin_at_a_mark(axes):
    path = np.column_stack([np.cos(TS), np.sin(TS)])
    assert plots.draw_coupler_curves(axes, {"P": path, "Q": 2 * path}) is axes
    np.testing.assert_allclose(line(axes, "Q"), 2 * path)
    assert axes.get_aspect() == 1 and (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "y (m)")
    assert list(axes.lines[1].get_xdata()) == [1.0]


def test_the_fit_of_one_channel(axes):
    dims = ("record", "sample", "channel")
    values = np.arange(6.0).reshape(1, 3, 2)
    data = xarray.Dataset(
        {name: (dims, values + k) for k, name in enumerate(("measured", "predicted", "residual", "noise"))}
        | {"time": (("record", "sample"), np.arange(3.0)[None])},
        coords={"record": ["run"], "channel": ["angle(a)", "angle(b)"], "channel_units": ("channel", ["rad", "rad"])},
    )
    assert plots.draw_fit(axes, data, "angle(b)") is axes
    np.testing.assert_allclose(line(axes, "measured"), [[0, 1], [1, 3], [2, 5]])
    np.testing.assert_allclose(line(axes, "predicted")[:, 1], [2, 4, 6])
    assert axes.get_ylabel() == "angle(b) (rad)"
    with pytest.raises(ValueError, match=r"no record has a channel 'x': there are angle\(a\), angle\(b\)"):
        plots.draw_fit(axes, data, "x")


def test_every_drawing_function_labels_its_axes_with_units(linkage, exact):
    sol = solution(linkage, exact)
    cases: list[Any] = [
        (plots.draw_motion, linkage, exact),
        (plots.draw_angles, linkage, sol.ts, exact),
        (plots.draw_violation, sol.ts, udk.violation(linkage, sol)),
        (plots.draw_energy, sol.ts, udk.energy(linkage, sol)),
    ]
    for draw, *arguments in cases:
        axes = Figure().subplots()
        assert draw(axes, *arguments) is axes
        assert axes.get_xlabel().endswith(")") and axes.get_ylabel().endswith(")")


def test_plots_of_a_drawing_are_in_its_units_and_count_as_it_does():
    pins = {"O": (0, 0), "A": udk.polar("O", 50, 60), "C": udk.on_rail("A", 150, "R", (1, 0)), "R": (0, -20)}
    links = {"crank": {"pins": ["O", "A"]}, "rod": {"pins": ["A", "C"]}, "block": {"pins": ["C"], "width": 20}}
    mech = udk.Drawing(
        pins,
        links,
        ["O"],
        motors=[{"pin": "O", "speed": "60 rpm"}],
        slides=[{"link": "block", "direction": [1, 0]}],
        units={"length": "mm", "angle": "deg"},
    ).mechanism()
    along, label = np.linspace(60.0, 420.0, 73), "the angle of O-A from the x axis (deg)"
    turn = udk.kinematics(mech, "motor1", np.radians(along))
    scene, angles = driven_figure(mech, turn, along, label).axes
    assert [scene.get_xlabel(), angles.get_ylabel()] == ["x (mm)", "angle (deg)"]
    assert angles.get_xlabel() == label
    crank = line(angles, "crank")
    np.testing.assert_allclose(crank[:, 0], crank[:, 1], atol=1e-6)  # both count from the x axis
    ticks = scene.get_xticks()
    shown = [float(scene.xaxis.get_major_formatter()(x, k)) for k, x in enumerate(ticks)]
    np.testing.assert_allclose(shown, 1e3 * ticks, rtol=1e-5)
    assert all(x % 10 == 0 for x in shown)
    assert set(np.diff(angles.get_xticks())) <= {45.0, 90.0}
    supports = [x.get_xydata() for x in scene.lines if x.get_marker() == "^"]
    np.testing.assert_allclose(np.concatenate(supports), [[0, 0]])  # none where the slider began
    (alone,) = driven_figure(mech, udk.kinematics(mech, "motor1", [1.0]), along[:1], label).axes
    assert alone.get_ylabel() == "y (mm)"


def luminance(colour):
    """Perceived lightness of a colour (CIE L*, 0 to 100)."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)]
    y = np.dot([0.2126, 0.7152, 0.0722], linear)
    return 116 * np.cbrt(y) - 16 if y > 0.008856 else 903.3 * y


def test_curves_can_be_told_apart_in_print():
    """Two curves on the same axes differ by dashes, markers or lightness."""
    three = {"A": {"b": np.ones((5, 3))}, "B": {"b": np.ones((5, 3))}, "C": {"b": np.ones((5, 3))}}
    cases: list[Any] = [
        (plots.draw_reactions, TS, three),
        (plots.draw_coupler_curves, {name: np.ones((5, 2)) for name in "abcd"}),
        (plots.draw_energy, TS, Energy(jnp.asarray(TS), jnp.asarray(TS))),
    ]
    for draw, *arguments in cases:
        axes = Figure().subplots()
        draw(axes, *arguments)
        curves = [one for one in axes.lines if not str(one.get_label()).startswith("_")]
        for one, other in combinations(curves, 2):
            differ = one.get_linestyle() != other.get_linestyle() or one.get_marker() != other.get_marker()
            assert differ or abs(luminance(one.get_color()) - luminance(other.get_color())) > 10, draw.__name__
    assert max(luminance(colour) for colour in COLOURS) < 75  # all are visible on white
