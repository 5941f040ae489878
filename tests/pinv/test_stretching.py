"""Bodies that many joints meet: the same solution from copies and welds, and what it saves."""

from itertools import pairwise

import jax
import numpy as np
import pytest

from tests.pinv.structures import four_bars, touching
from udkjax.pinv.block_methods import BlockElimination
from udkjax.pinv.blocks import BlockPattern
from udkjax.pinv.dissection import dissect
from udkjax.pinv.stretching import MANY, Stretched, stretch


def wheel(k):
    """Rays on a hub (body 0), which has a joint with the ground."""
    return [(0,)] + [(0, 1 + i) for i in range(k)]


def ladder(k):
    """Rungs of two bars between two rails (bodies 0 and 1), as many joints as a rung has freedoms."""
    return [joint for i in range(2, 2 * k + 2, 2) for joint in ((0, i), (i, i + 1), (i + 1, 1))]


def matrices(meets, stretched: Stretched, seed=0):
    """Return D of joints of two rows on bodies of three columns, and D of the same on copies, with the welds."""
    random = np.random.default_rng(seed)
    copies = len(stretched.original)
    D, stretch_D = np.zeros((2 * len(meets), 3 * (1 + stretched.original.max()))), np.zeros((2 * len(meets), 3 * copies))
    for i, (bodies, there) in enumerate(zip(meets, stretched.meets, strict=False)):
        for body, copy in zip(bodies, there, strict=True):
            block = random.normal(size=(2, 3))
            D[2 * i : 2 * i + 2, 3 * body : 3 * body + 3] = block
            stretch_D[2 * i : 2 * i + 2, 3 * copy : 3 * copy + 3] = block * stretched.scale[copy]
    welds = np.zeros((stretched.welds, copies))
    for w, (one, other) in enumerate(stretched.meets[len(meets) :]):
        welds[w, [one, other]] = 1, -1
    return D, np.vstack([stretch_D, np.kron(welds, np.eye(3))])


@pytest.mark.parametrize(
    "meets", [wheel(40), ladder(20), four_bars(5) + [(0, 20 + i) for i in range(30)]], ids=["wheel", "ladder", "arms"]
)
def test_the_joints_multipliers_are_those_of_the_whole_body(meets):
    stretched = stretch(meets)
    assert stretched.welds > 0
    D, stretched_D = matrices(meets, stretched)
    m = len(D)
    np.testing.assert_array_equal(stretched.original[np.concatenate(stretched.meets[: len(meets)])], np.concatenate(meets))
    inverse = np.linalg.inv(stretched_D @ stretched_D.T)[:m, :m]
    expected = np.linalg.inv(D @ D.T)
    np.testing.assert_allclose(inverse, expected, atol=1e-10 * np.abs(expected).max())


def work(meets, welds=0):
    sizes, pairs = touching(meets)
    sizes[len(sizes) - welds :] = [3] * welds
    rows = [[sum(sizes[i] for i in blocks) for blocks in (f.eliminated, f.boundary)] for f in dissect(sizes, pairs)]
    return sum(e * (e + b) ** 2 for e, b in rows)


@pytest.mark.parametrize("structure", [wheel, ladder])
def test_work_grows_like_the_number_of_joints_not_its_cube(structure):
    works = [work(s.meets, s.welds) for s in (stretch(structure(k)) for k in (50, 100, 200))]
    assert all(1.8 < more / less < 2.2 for less, more in pairwise(works))
    assert works[-1] < work(structure(200)) / 20


def test_bodies_of_few_joints_stay_whole():
    meets = wheel(MANY - 1)
    stretched = stretch(meets)
    assert stretched.meets == meets
    assert stretched.welds == 0
    assert stretched.scale.tolist() == [1] * MANY


@pytest.mark.parametrize("damping", [None, 0.1])
def test_elimination_of_blocks_cuts_bodies_of_many_joints(damping):
    meets = wheel(20)
    pattern = BlockPattern([2] * len(meets), meets, 3, 21)
    assert pattern.copies is not None
    D = np.random.default_rng(0).normal(size=(2, 3, 2 * len(meets))) * (pattern.columns >= 0)
    dense = np.zeros((2 * len(meets), 3 * 21))
    for s, column in enumerate(pattern.columns):
        if column >= 0:
            i = 2 * (s % len(meets))
            dense[i : i + 2, 3 * column : 3 * column + 3] = D[:, :, s]
    S = dense @ dense.T
    if damping:
        S += damping * np.diag(np.diag(S))
    method, b = BlockElimination(pattern, damping=damping), np.random.default_rng(1).normal(size=2 * len(meets))
    solution = jax.jit(lambda D, b: method.apply(method.factor(D), b))(D, b)
    np.testing.assert_allclose(solution, dense.T @ np.linalg.solve(S, b), atol=1e-10)
