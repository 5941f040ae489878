"""Curves from files: tables, and the paths of SVG files against their definition."""

import numpy as np
import pytest

from udkjax.synthesis.curves.curve_file import points_of_path, read_curve_file


@pytest.mark.parametrize("text", ["x,y\n0,0\n1,2\n3,1\n", "0 0\n1 2\n3 1", "# x; y\n0;0;7\n1;2;8\n3;1;9\n", "0,0\n1,2\n\n3,1\n"])
def test_rows_of_a_table(tmp_path, text):
    file = tmp_path / "curve.csv"
    file.write_text(text)
    np.testing.assert_array_equal(read_curve_file(file), [[0, 0], [1, 2], [3, 1]])


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "no rows"), ("x,y\n1,2\n3,four\n", "line 3"), ("1\n2\n3\n", "line 2|no rows"), ("a\nb\nc", "line 2")],
)
def test_tables_with_mistakes(tmp_path, text, message):
    file = tmp_path / "curve.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_curve_file(file)


def test_lines_of_a_path_in_all_notations():
    expected = [[0, 0], [4, 0], [4, -3], [1, -3], [0, 0]]
    for path in ("M0 0L4 0L4 3L1 3Z", "m0,0 4,0 0,3 -3,0z", "M0 0H4V3h-3Z", "M 0 0 h4 v+3 L1,3e0 z"):
        np.testing.assert_allclose(points_of_path(path), expected, atol=1e-12)


def test_bezier_curves_of_a_path_follow_their_polynomials():
    t = np.linspace(0.0, 1.0, 49)[:, None]
    a, b, c, d = np.array([[0.0, 0.0], [1.0, 2.0], [3.0, 2.0], [4.0, 0.0]])
    cubic = (1 - t) ** 3 * a + 3 * t * (1 - t) ** 2 * b + 3 * t**2 * (1 - t) * c + t**3 * d
    np.testing.assert_allclose(points_of_path("M0 0C1 2 3 2 4 0") * [1, -1], cubic, atol=1e-12)
    twice = points_of_path("M0 0C1 2 3 2 4 0S7-2 8 0") * [1, -1]
    np.testing.assert_allclose(twice, points_of_path("M0 0c1 2 3 2 4 0c1-2 3-2 4 0") * [1, -1], atol=1e-12)
    waves = points_of_path("M0 0Q1 1 2 0T4 0T6 0") * [1, -1]
    np.testing.assert_allclose(waves, points_of_path("M0 0Q1 1 2 0Q3-1 4 0Q5 1 6 0") * [1, -1], atol=1e-12)


@pytest.mark.parametrize("large", [0, 1])
@pytest.mark.parametrize("sweep", [0, 1])
def test_arcs_of_a_path_lie_on_their_ellipse(large, sweep):
    z = points_of_path(f"M3 1A2 1 30 {large}{sweep}2 2") @ [1, -1j]
    assert (z[0], z[-1]) == (3 + 1j, 2 + 2j)
    local = z * np.exp(-1j * np.deg2rad(30.0))
    x, y = local.real / 2.0, local.imag
    A = np.stack([2 * x, 2 * y, np.ones_like(x)], 1)
    (a, b, c), *_ = np.linalg.lstsq(A, x**2 + y**2)
    np.testing.assert_allclose(np.hypot(x - a, y - b), 1.0, rtol=1e-10)
    assert np.sqrt(c + a**2 + b**2) == pytest.approx(1.0, rel=1e-10)
    angles = np.unwrap(np.angle(x - a + 1j * (y - b)))
    assert (abs(angles[-1] - angles[0]) > np.pi) == bool(large) and (angles[-1] > angles[0]) == bool(sweep)


def test_radii_of_arcs_that_are_too_small_grow():
    z = points_of_path("M0 0A1 1 0 0 1 4 0") @ [1, -1j]
    np.testing.assert_allclose(np.abs(z - 2.0), 2.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("", "no path"),
        ("L1 1", "no path"),
        ("M0 0 L1 1 M2 2 L3 3", "one stroke"),
        ("M0 0 L1", "needs 2 numbers"),
        ("M0 0 foo", "no path"),
        ("M0 0", "draws nothing"),
    ],
)
def test_paths_with_mistakes(path, message):
    with pytest.raises(ValueError, match=message):
        points_of_path(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<svg", "no SVG file"),
        ("<svg/>", "one path, not 0"),
        ('<svg><path d="M0 0L1 1"/><path d="M0 0L1 1"/></svg>', "not 2"),
        ('<svg><g transform="scale(2)"><path d="M0 0L1 1"/></g></svg>', "transform"),
    ],
)
def test_drawings_with_mistakes(tmp_path, content, message):
    file = tmp_path / "curve.svg"
    file.write_text(content)
    with pytest.raises(ValueError, match=message):
        read_curve_file(file)


def test_a_drawing_with_a_path(tmp_path):
    file = tmp_path / "curve.SVG"
    file.write_text('<svg xmlns="http://www.w3.org/2000/svg"><path d="M0 0 H2 V-1"/></svg>')
    np.testing.assert_array_equal(read_curve_file(file), [[0, 0], [2, 0], [2, 1]])
