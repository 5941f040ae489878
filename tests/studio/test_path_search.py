"""Mechanisms for a wanted path."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.studio.limits import RefusedError
from udkjax.studio.path_search import TARGETS, _spread, find_mechanisms

ANGLES = np.linspace(0.0, 2 * np.pi, 60)
BEAN = np.stack([0.1 + 0.06 * np.cos(ANGLES) + 0.01 * np.cos(2 * ANGLES), 0.1 + 0.03 * np.sin(ANGLES)], 1)


def test_places_are_spread_evenly_along_a_path():
    targets = _spread(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.5]]))
    steps = np.linalg.norm(np.diff(targets, axis=0), axis=1)
    assert len(targets) == TARGETS + 1 and targets[-1].tolist() == [1.0, 0.5]
    np.testing.assert_allclose(steps[steps > 0.09], 1.5 / TARGETS, rtol=1e-12)  # but around the corner
    assert len(_spread(BEAN[:-1])) == TARGETS  # closed


@pytest.mark.parametrize("path", [None, [], [[0, 0], [1, 1]], [[0, 0, 0]] * 5, [[0, "x"]] * 5, [[0, np.nan]] * 5, [[1, 1]] * 5])
def test_paths_that_are_none_are_refused(path):
    with pytest.raises(RefusedError, match="path"):
        find_mechanisms(path)


@pytest.mark.slow
def test_the_mechanisms_of_a_closed_path_turn_and_stay_within_their_deviation():
    found = find_mechanisms(BEAN.tolist(), "cm")
    assert len(found["designs"]) > 1
    for design in found["designs"]:
        mechanism = udk.loads(design["text"])
        curve = np.asarray(udk.path(mechanism, udk.simulate(mechanism, np.linspace(0.0, 1.0, 721)), "P"))
        off = np.linalg.norm(BEAN[:, None] - curve[None], axis=2).min(1).max()
        assert design["turns"] and off == pytest.approx(design["deviation"], rel=0.02)
    assert found["designs"][0]["deviation"] < 0.02 * found["extent"]
