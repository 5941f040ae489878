"""Mechanisms for a wanted path."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.studio.limits import RefusedError
from udkjax.studio.path_search import find_mechanisms, path_of_table

ANGLES = np.linspace(0.0, 2 * np.pi, 60)
BEAN = np.stack([0.1 + 0.06 * np.cos(ANGLES) + 0.01 * np.cos(2 * ANGLES), 0.1 + 0.03 * np.sin(ANGLES)], 1)


@pytest.mark.parametrize("path", [None, [], [[0, 0], [1, 1]], [[0, 0, 0]] * 5, [[0, "x"]] * 5, [[0, np.nan]] * 5, [[1, 1]] * 5])
def test_paths_that_are_none_are_refused(path):
    with pytest.raises(RefusedError, match="path"):
        find_mechanisms(path)


def test_a_path_is_read_from_a_table():
    np.testing.assert_allclose(
        path_of_table("a.csv", "t,x,y\n0,1,2\n1,3,4\n2,5,2", "mm"), [[1e-3, 2e-3], [3e-3, 4e-3], [5e-3, 2e-3]]
    )
    for table, message in (("1,2\n3,x", "line 2 of a.csv"), ("1,2\n3,4", "a list of 3"), ("1,2\n3,inf\n4,5", "places")):
        with pytest.raises(RefusedError, match=message):
            path_of_table("a.csv", table, "mm")


def test_the_mechanisms_of_a_closed_path_turn_and_stay_within_their_deviation():
    found = find_mechanisms(BEAN.tolist(), "cm")
    assert found["designs"][0]["document"]["units"] == {"length": "cm"}
    for design in found["designs"][:1]:
        mechanism = udk.loads(design["text"])
        curve = np.asarray(udk.path(mechanism, udk.simulate(mechanism, np.linspace(0.0, 1.0, 14401)), "P"))
        off = np.linalg.norm(BEAN[:, None] - curve[None], axis=2).min(1).max()
        assert design["turns"] and off == pytest.approx(design["deviation"], rel=0.02)
    assert found["designs"][0]["deviation"] < 0.02 * found["extent"]
