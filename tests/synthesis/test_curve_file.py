"""Curves from files: tables, and SVG files against the definitions of their shapes."""

import numpy as np
import pytest

from udkjax.synthesis.curves.curve_file import read_curve_file


@pytest.mark.parametrize(
    "text",
    [
        "x,y\n0,0\n1,2\n3,1\n",
        "0 0\n1 2\n3 1",
        "# x; y\n0;0;7\n1;2;8\n3;1;9\n",
        "0,0,\n1,2,\n\n3,1,\n",
        "# a curve\nt [s],Y [m],X [m]\n0,0,0\n1,2,1\n# its end\n2,1,3\n",
        '"x"\t"y"\nmm\tmm\n"0"\t"0"\n"1"\t"2"\n"3"\t"1"',
        "x;y\n0,0;0\n1,0;2,0\n3;1,0",
    ],
)
def test_rows_of_a_table(tmp_path, text):
    file = tmp_path / "curve.csv"
    file.write_text(text)
    np.testing.assert_array_equal(read_curve_file(file), [[0, 0], [1, 2], [3, 1]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no rows"),
        ("x,y\n1,2\n3,four\n", "line 3"),
        ("1\n2\n3\n", "line 1"),
        ("a\nb\nc", "no rows"),
        ("1,2,3\n", "a heading must name"),
    ],
)
def test_tables_with_mistakes(tmp_path, text, message):
    file = tmp_path / "curve.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_curve_file(file)


def test_arcs_and_splines_lie_on_their_curves(tmp_path):
    file = tmp_path / "curve.svg"
    file.write_text('<svg><path d="M3 0A3 3 0 0 0 -3 0C-3 4 3 4 3 0"/></svg>')
    z = read_curve_file(file) @ [1, -1j]
    arc, spline = np.split(z, 2)
    np.testing.assert_allclose(np.abs(arc), 3.0, rtol=1e-12)
    t = np.linspace(0.0, 1.0, len(spline))
    exact = -3 * (1 - t) ** 3 + 3 * t * (1 - t) ** 2 * (-3 + 4j) + 3 * t**2 * (1 - t) * (3 + 4j) + 3 * t**3
    np.testing.assert_allclose(spline, exact, atol=1e-12)
    assert (np.diff(np.angle(arc)) < 0).all() and np.abs(np.diff(arc)).max() < 0.2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<svg", "not an SVG file"),
        ("<svg/>", "draws nothing"),
        ('<svg><path d="M0 0"/></svg>', "draws nothing"),
        ('<svg><path d="M0 0L1 1M2 2L3 3"/></svg>', "pen is lifted"),
        ('<svg><path id="a" d="M0 0L1 1"/><circle cx="9" cy="9" r="1"/></svg>', "between path 'a' and circle"),
    ],
)
def test_drawings_with_mistakes(tmp_path, content, message):
    file = tmp_path / "curve.svg"
    file.write_text(content)
    with pytest.raises(ValueError, match=message):
        read_curve_file(file)


def test_a_closed_shape_is_one_stroke(tmp_path):
    file = tmp_path / "curve.svg"
    file.write_text('<svg width="9mm" height="9mm" viewBox="0 0 10 10"><circle cx="5" cy="5" r="3"/></svg>')
    points = read_curve_file(file)
    np.testing.assert_allclose(np.linalg.norm(points - [4.5, -4.5], axis=1), 2.7, rtol=1e-9)
    np.testing.assert_allclose(points[0], points[-1], atol=1e-9)


def test_a_drawing_with_a_transform_and_a_unit(tmp_path):
    file = tmp_path / "curve.SVG"
    drawing = '<g transform="scale(2)"><path d="M0 0 H2 V-1"/><line x1="2" y1="-1" x2="3" y2="0"/></g>'
    file.write_text(f'<svg xmlns="http://www.w3.org/2000/svg">{drawing}</svg>')
    np.testing.assert_allclose(read_curve_file(file)[[0, 48, 97, 146]], [[0, 0], [4, 0], [4, 2], [6, 0]], atol=1e-12)
    file.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" width="20cm" height="20cm" viewBox="0 0 100 100">{drawing}</svg>')
    np.testing.assert_allclose(read_curve_file(file)[[0, 48, 97, 146]], [[0, 0], [8, 0], [8, 4], [12, 0]], atol=1e-9)
