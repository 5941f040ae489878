"""Elimination by code written out for each kind of front: against dense solutions, by itself and as fusions of a loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from tests.pinv.structures import chain, four_bars, grid, star, tree
from tests.pinv.test_dissection import below, graphs
from udkjax.pinv.blocks import BlockPattern, by_block, flat
from udkjax.pinv.dissection import Front, dissect
from udkjax.pinv.subtrees import ROWS, merged
from udkjax.pinv.written_out import WrittenOut
from udkjax.straightline import Loop, fusion

TRIED = jax.__version_info__[:2] in fusion.KNOWN
FAST = {"xla_backend_optimization_level": 0}  # compiles in a third of the time
DROP = 1e-10


def links(n):
    """The joints of a chain of n links, by the links that each meets."""
    return [(0,), *((i, i + 1) for i in range(n - 1))]


def pairwise(structure):
    """A block of columns for each pair of blocks that touch, and one of its own for each block."""
    sizes, pairs = structure
    meets = [[i] for i in range(len(sizes))]
    for k, (i, j) in enumerate(pairs):
        meets[i].append(len(sizes) + k)
        meets[j].append(len(sizes) + k)
    return sizes, meets


SHAPES = {
    "links": ([2] * 20, links(20)),
    "loops": ([2] * 22, four_bars(7)),
    "apart": ([2] * 12, [*links(6), *[tuple(6 + i for i in m) for m in links(6)]]),
    "one": ([3], [(0,)]),
    "mixed": ([1 + i % 3 for i in range(15)], links(15)),
    "tree": pairwise(tree(20)),
    "grid": pairwise(grid(4)),
    "star": pairwise(star(6)),
}


def pattern_of(name):
    sizes, meets = SHAPES[name]
    return BlockPattern(sizes, meets, 3, 1 + max(b for m in meets for b in m), np.inf)


def problem(pattern, seed=0):
    """D of random entries, and as a dense matrix; its rows' places; and a right-hand side, NaN where it is padding."""
    random = np.random.default_rng(seed)
    within = np.arange(pattern.rows)[:, None] < pattern.sizes
    there = np.tile(within, pattern.deep) & (pattern.columns >= 0)
    D = random.normal(size=(pattern.rows, 3, len(pattern.columns))) * there[:, None]
    r = np.where(within, random.normal(size=within.shape), np.nan)
    unit = np.eye(3 * pattern.count)
    columns = [flat(pattern.matvec(jnp.asarray(D), by_block(jnp.asarray(x), 3))) for x in unit]
    return D, np.stack(columns, -1), np.flatnonzero(within.T.ravel()), r


@pytest.mark.parametrize("name", SHAPES)
def test_solution(name):
    pattern = pattern_of(name)
    D, matrix, places, r = problem(pattern)
    code = WrittenOut(pattern)

    def solve(D, r):
        factors, safe = code.factor(D, DROP, None)
        return code.solve(factors, r, None), safe

    y, safe = jax.jit(solve).lower(D, r).compile(FAST)(D, r)
    S = matrix[places] @ matrix[places].T
    expected = np.zeros(r.size)
    expected[places] = np.linalg.solve(S, r.T.ravel()[places])
    assert safe
    np.testing.assert_allclose(np.asarray(y).T.ravel(), expected, atol=1e-14 * np.linalg.cond(S) * np.abs(expected).max())


@pytest.mark.parametrize("name", ["links", "loops", "mixed"])
def test_as_fusions_of_a_loop_it_is_the_same(name):
    pattern = pattern_of(name)
    D, _, _, r = problem(pattern)
    code, r = WrittenOut(pattern), np.nan_to_num(r)

    def solved(loop):
        def again(state):
            k, r, safe = state
            factors, still = code.factor(jnp.asarray(D), DROP, loop)
            return k - 1, code.solve(factors, r, loop), safe & still

        return jax.jit(lambda k: jax.lax.while_loop(lambda s: s[0] > 0, again, (k, jnp.asarray(r), jnp.array(True))))

    fused, barred = (solved(loop).lower(2) for loop in (Loop(), None))
    assert [x.as_text().count("mhlo.fusion") > 0 for x in (fused, barred)] == [TRIED, False]
    (_, y, safe), (_, expected, _) = fused.compile()(2), barred.compile(FAST)(2)
    assert safe
    np.testing.assert_allclose(y, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_a_row_that_nearly_depends_on_others_is_told_by_its_pivot():
    pattern = pattern_of("links")
    D, *_ = problem(pattern)
    last = np.flatnonzero(pattern.columns.reshape(pattern.deep, -1)[:, -1] >= 0) * pattern.blocks + pattern.blocks - 1
    code = WrittenOut(pattern)
    safe = jax.jit(lambda D, drop: code.factor(D, drop, None)[1]).lower(D, 0.0).compile(FAST)
    verdict = {}
    for angle in (1e-6, 1e-3):
        turned = D.copy()
        turned[1][:, last] = np.cos(angle) * D[0][:, last] + np.sin(angle) * D[1][:, last]
        verdict[angle] = [bool(safe(turned, drop)) for drop in (1e-14, 1e-10, 1e-4)]
    assert verdict == {1e-6: [True, False, False], 1e-3: [True, True, False]}


@settings(deadline=None)
@given(graphs())
def test_merged_subtrees_are_fronts_of_the_same_tree(graph):
    sizes, pairs = graph
    near = [[j for pair in pairs for j in pair if i in pair and j != i] for i in range(len(sizes))]
    plain = dissect(sizes, pairs)
    fronts = merged(sizes, near, plain, lambda front: len(front.eliminated))
    assert sorted(i for f in fronts for i in f.eliminated) == list(range(len(sizes)))
    for k, front in enumerate(fronts):
        inside = below(fronts, k)
        assert set(front.boundary) == set().union(*(near[i] for i in inside)) - inside
        assert all(c < k and fronts[c].depth == front.depth + 1 for c in front.children)
        assert sum(sizes[i] for i in front.eliminated) <= ROWS or front.eliminated in (f.eliminated for f in plain)


def test_subtrees_that_are_mirrored_are_alike():
    """The halves of a chain, whose blocks and boundaries are numbered the other way round."""
    sizes, pairs = chain(9)
    near = [[j for pair in pairs for j in pair if i in pair and j != i] for i in range(len(sizes))]

    def kind(front: Front):
        number = {i: k for k, i in enumerate([*front.eliminated, *front.boundary])}
        return sorted((number[i], number[j]) for i in front.eliminated for j in near[i] if j in number)

    def structure(front):
        return str(kind(front))

    fronts = merged(sizes, near, dissect(sizes, pairs), structure)
    assert [len(f.eliminated) for f in fronts] == [4, 4, 1]
    assert kind(fronts[0]) == kind(fronts[1])


@pytest.mark.parametrize("joints", [links, lambda n: four_bars(n // 3)], ids=["links", "loops"])
def test_the_code_does_not_grow_with_the_scene_and_its_places_grow_like_it(joints):
    operations, places = [], []
    for n in (300, 1200, 4800):
        meets = joints(n)
        code = WrittenOut(BlockPattern([2] * len(meets), meets, 3, 1 + max(b for m in meets for b in m)))
        assert code.worthwhile
        operations.append(code.operations)
        places.append(sum(g.D.size + g.sent.size for level in code.levels for g in level))
    assert operations[-1] < 2 * operations[0]
    assert places[-1] < 17 * places[0]


def test_where_no_two_fronts_are_alike_it_is_not_worth_it():
    random = np.random.default_rng(0)
    meets = [(i, *random.choice(i, min(i, 2), replace=False).tolist()) for i in range(300)]
    pattern = BlockPattern(random.integers(1, 7, 300).tolist(), meets, 3, 300, np.inf)
    assert not WrittenOut(pattern).worthwhile
    assert pattern.written_out is None
