"""The elimination tree: what it must be for any graph, and how shallow and narrow it is for those of mechanisms."""

from math import log2

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from tests.pinv.structures import chain, clique, four_bars, grid, parts, star, touching, tree
from udkjax.pinv.dissection import dissect


@st.composite
def graphs(draw, most=24):
    n = draw(st.integers(0, most))
    sizes = draw(st.lists(st.integers(1, 3), min_size=n, max_size=n))
    edges = st.tuples(st.integers(0, max(n - 1, 0)), st.integers(0, max(n - 1, 0))).filter(lambda e: e[0] != e[1])
    pairs = draw(st.lists(edges, max_size=3 * n, unique_by=frozenset)) if n > 1 else []
    return sizes, pairs


def below(fronts, k):
    """All blocks eliminated at a front or before it, by its descendants."""
    return set(fronts[k].eliminated).union(*(below(fronts, c) for c in fronts[k].children))


@settings(deadline=None)
@given(graphs())
def test_every_front_is_coupled_to_what_elimination_couples_it_to(graph):
    sizes, pairs = graph
    fronts = dissect(sizes, pairs)
    assert sorted(i for f in fronts for i in f.eliminated) == list(range(len(sizes)))
    order = {i: k for k, f in enumerate(fronts) for i in f.eliminated}
    near = {i: {j for pair in pairs for j in pair if i in pair} for i in order}
    for k, front in enumerate(fronts):
        inside = below(fronts, k)
        outside = set().union(*(near[i] for i in inside)) - inside
        assert set(front.boundary) == outside
        assert len(front.boundary) == len(outside)
        assert all(order[i] > k for i in outside)
        assert len(front.children) <= 2
        assert all(c < k and fronts[c].depth == front.depth + 1 for c in front.children)


@pytest.mark.parametrize("n", [10, 100, 1000, 6000])
def test_chains_take_a_logarithm_of_levels_and_fronts_of_three_blocks(n):
    fronts = dissect(*chain(n))
    assert max(f.depth for f in fronts) + 1 <= log2(n) + 1
    assert max(len(f.eliminated) + len(f.boundary) for f in fronts) == 3


def test_loops_in_series_take_no_wider_fronts_than_a_chain():
    fronts = dissect(*touching(four_bars(1000)))
    assert max(f.depth for f in fronts) + 1 == 12
    assert max(len(f.eliminated) + len(f.boundary) for f in fronts) == 3


@pytest.mark.parametrize("seed", range(3))
def test_a_tree_is_cut_at_single_blocks(seed):
    n = 1000
    fronts = dissect([2] * n, tree(n, seed)[1])
    assert max(len(f.eliminated) for f in fronts) == 1
    assert max(f.depth for f in fronts) < 2 * log2(n)


def test_a_star_is_as_deep_as_joining_its_rays_takes():
    fronts = dissect(*star(1000))
    assert max(f.depth for f in fronts) == 10
    assert max(len(f.boundary) for f in fronts) == 1


def test_a_grid_needs_fronts_of_the_order_of_its_side():
    sides = 10, 20, 40
    rows = [max(len(f.eliminated) + len(f.boundary) for f in dissect(*grid(n))) for n in sides]
    assert all(front <= 2 * n for n, front in zip(sides, rows, strict=True))


def test_a_clique_is_one_front():
    assert len(dissect(*clique(12))) == 1


def test_parts_that_do_not_touch_share_levels():
    alone, together = dissect(*chain(31)), dissect(*parts(*[chain(31)] * 5, chain(3)))
    assert max(f.depth for f in together) == max(f.depth for f in alone) == 4
    assert sum(f.depth == 0 for f in together) == 6
