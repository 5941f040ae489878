"""Row spaces, and names and numbers in sentences."""

import numpy as np

from udkjax.pinv.row_spaces import connected_columns, echelon, null_space, row_space
from udkjax.study.report import ratio
from udkjax.wording import join_names


def test_spaces_of_rows():
    matrix = np.array([[2.0, -4.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [2.0, -4.0, 0.0, 3.0]])
    np.testing.assert_allclose(row_space(matrix, 1e-9), [[1.0, -2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(echelon(null_space(matrix, 1e-9)), [[1.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], atol=1e-12)
    assert connected_columns(row_space(matrix, 1e-9)) == [[0, 1], [3]]
    assert connected_columns(np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, 0.0]])) == [[0, 1, 2, 3]]


def test_words():
    assert join_names(["a"]) == "a" and join_names(["a", "b", "c"]) == "a, b and c"
    assert join_names([str(k) for k in range(10)]) == "0, 1, 2, 3, 4, 5, 6, 7 and 2 more"
    assert ratio([2.0, 1.0, -4.0]) == "1 : 0.5 : -2"
