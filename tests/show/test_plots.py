import io

import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.integrate import Result, Solution
from udkjax.show.plots import apart, attachments, outline, placed, trajectory
from udkjax.study import exact_coordinates


@pytest.fixture(scope="module")
def linkage():
    return udk.library.parallelogram()


def solution(mech, q, v=None, code=Result.successful):
    q = jnp.asarray(q)
    ts = jnp.linspace(0.0, 1.0, len(q))
    v = jnp.zeros_like(q) if v is None else v
    tol = jnp.array(1e-8)
    return Solution(ts, q, v, jnp.array(int(code)), ts[-1], {"steps": jnp.array(3)}, tol, tol, mech.body_names, ())


@pytest.fixture(scope="module")
def exact(linkage):
    return exact_coordinates(linkage, np.linspace(0, 1, 21), linkage.q0, linkage.v0)


def test_attachments_are_the_points_of_the_joints(linkage):
    points = attachments(linkage)
    assert list(points) == [*linkage.bodies, "ground"]
    np.testing.assert_allclose(points["ground"], [[0, 0], [1, 0], [2, 0]])
    np.testing.assert_allclose(sorted(points["coupler"].tolist()), [[-1, 0], [0, 0], [1, 0]])


def test_outline_visits_points_in_turn():
    np.testing.assert_allclose(outline(np.array([[1.0, 2.0]])), [[1, 2], [0, 0]])
    np.testing.assert_allclose(np.sort(outline(np.array([[0.0, 0], [2, 2], [1, 1]]))[:, 0]), [0, 1, 2])
    assert abs(np.diff(outline(np.array([[0.0, 0], [2, 2], [1, 1]]))[:, 0])) == pytest.approx(1)
    square = outline(np.array([[0.0, 0], [1, 1], [1, 0], [0, 1]]))
    assert np.hypot(*np.diff(square, axis=0).T) == pytest.approx(1)  # sides only, no diagonal
    np.testing.assert_array_equal(square[0], square[-1])


def test_placed_turns_anticlockwise():
    np.testing.assert_allclose(
        placed(np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([3.0, 4.0, np.pi / 2])), [[3, 5], [2, 4]], atol=1e-15
    )


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


def test_poses_are_far_apart(exact):
    chosen = apart(exact, 4)
    assert chosen[0] == 0 and len(set(chosen)) == 4
    angles = exact[chosen, 0, 2]
    assert np.ptp(angles) == pytest.approx(np.ptp(exact[:, 0, 2]))
    assert apart(exact[:1].repeat(3, axis=0), 4) == [0]  # a mechanism that stands has one pose


def test_two_pictures_do_not_share_anything(linkage, exact):
    first, second = (trajectory(linkage, solution(linkage, exact)) for _ in range(2))
    assert not set(first.axes) & set(second.axes)


def test_a_run_that_failed_is_drawn_as_far_as_it_came(linkage, exact):
    broken = np.where(np.arange(len(exact))[:, None, None] < 5, exact, np.nan)
    figure = trajectory(linkage, solution(linkage, broken, code=Result.step_limit))
    figure.savefig(io.BytesIO(), format="png")
    assert np.isfinite(figure.axes[0].get_xlim()).all()
