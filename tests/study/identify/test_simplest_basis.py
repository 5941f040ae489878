"""The directions that records leave open, in simple words: a common factor, and single parameters."""

import numpy as np
from numpy.testing import assert_allclose

from udkjax.study.identify.answers.uncertainty import simplest_basis


def test_a_common_factor_comes_first_also_of_bounded_parameters():
    """In the unknowns z of the search, a common factor of x has the direction x / (dx/dz)."""
    x, dx_dz = np.array([2.0, 3.0, 5.0, 7.0]), np.array([2.0, 0.5, 1.0, 0.25])
    kinds = ["positive", "bounded", "free", "bounded"]
    factor = np.array([1.0, 6.0, 0.0, 28.0])
    other = np.array([0.0, 1.0, 1.0, 0.0])
    free = np.linalg.svd(np.stack([factor, other]))[2][:2]
    found = simplest_basis(free, x, dx_dz, kinds)
    assert_allclose(found[0], factor)
    assert np.linalg.matrix_rank(found) == 2
    assert_allclose(found @ free.T @ free, found, atol=1e-12)
