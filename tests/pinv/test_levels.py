"""Elimination by levels against dense solutions: values, the warning of dependent rows, derivatives, and what it costs."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from tests.pinv.structures import chain, clique, dense, four_bars, grid, matrix, parts, star, touching, tree
from tests.pinv.test_dissection import graphs
from udkjax.pinv.levels import Levels

STRUCTURES = {
    "one block": ([3], []),
    "chain": chain(20),
    "loops": touching(four_bars(7)),
    "tree": tree(30),
    "star": star(9),
    "grid": grid(5),
    "clique": clique(6),
    "parts": parts(chain(9), tree(7), clique(3), ([1], []), star(4)),
}
DROP = 1e-10
FAST = {"xla_backend_optimization_level": 0}  # compiles in a third of the time


@lru_cache
def compiled(name):
    sizes, pairs = STRUCTURES[name]
    levels = Levels.of(sizes, pairs)

    def solve(diagonal, coupling, r, drop):
        factors, safe = levels.factor(diagonal, coupling, drop)
        return levels.solve(factors, r), safe

    arguments = (*matrix(sizes, pairs), np.ones((len(sizes), max(sizes))), DROP)
    return jax.jit(solve).lower(*arguments).compile(FAST)


def by_fronts(levels, diagonal, coupling, r):
    """The plain twin: the same fronts one after another, each solved by LAPACK."""
    entries = np.concatenate([diagonal.ravel(), coupling.ravel(), [0, 1]])
    sent, carried, done = np.zeros(0), np.zeros(0), []
    for groups in levels.plan.levels:
        updates, passed = [], []
        for g in groups:
            e = g.eliminated
            front = entries[g.entries]
            front[:, :e] += sent[g.pivot].sum(0)
            front[:, e:] += sent[g.side].sum(0)
            right = r.ravel()[g.rows] + carried[g.carried].sum(0)
            corner, rest = sent[g.corner].sum(0), carried[g.passed].sum(0)
            for f in range(g.fronts):
                weights = np.linalg.solve(front[:, :e, f], np.column_stack([front[:, e:, f], right[:, f]]))
                corner[:, :, f] -= front[:, e:, f].T @ weights[:, :-1]
                rest[:, f] -= front[:, e:, f].T @ weights[:, -1]
                done.append((g, f, weights))
            updates.append(corner.ravel())
            passed.append(rest.ravel())
        sent, carried = np.concatenate(updates), np.concatenate(passed)
    found, at = np.zeros(sum(g.eliminated * g.fronts for groups in levels.plan.levels for g in groups)), 0
    for groups in levels.plan.levels[::-1]:
        for g in groups:
            for _, f, weights in (d for d in done if d[0] is g):
                found[at + f + g.fronts * np.arange(g.eliminated)] = weights[:, -1] - weights[:, :-1] @ found[g.above[:, f]]
            at += g.eliminated * g.fronts
    return found[levels.plan.solution]


@settings(deadline=None)
@given(graphs(most=30))
def test_the_plan_solves_any_structure(structure):
    sizes, pairs = structure
    if not sizes:
        return
    diagonal, coupling = matrix(sizes, pairs)
    S, places = dense(sizes, pairs, diagonal, coupling)
    r = np.random.default_rng(1).normal(size=(len(sizes), max(sizes)))
    y = by_fronts(Levels(sizes, np.array(pairs, int).reshape(-1, 2)), diagonal, coupling, r)
    expected = np.linalg.solve(S, r.ravel()[places])
    np.testing.assert_allclose(y.ravel()[places], expected, atol=1e-14 * np.linalg.cond(S) * np.abs(expected).max())


@pytest.mark.parametrize("name", STRUCTURES)
def test_solution(name):
    sizes, pairs = STRUCTURES[name]
    diagonal, coupling = matrix(sizes, pairs)
    S, places = dense(sizes, pairs, diagonal, coupling)
    r = np.random.default_rng(1).normal(size=(len(sizes), max(sizes)))
    y, safe = compiled(name)(diagonal, coupling, r, DROP)
    expected = np.zeros(r.size)
    expected[places] = np.linalg.solve(S, r.ravel()[places])
    assert safe
    np.testing.assert_allclose(y.ravel(), expected, atol=1e-15 * np.linalg.cond(S) * np.abs(expected).max())


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(graphs())
def test_solution_of_any_structure(structure):
    sizes, pairs = structure
    levels = Levels.of(sizes, pairs)
    diagonal, coupling = matrix(sizes, pairs)
    S, places = dense(sizes, pairs, diagonal, coupling)
    r = np.random.default_rng(1).normal(size=(len(sizes), max(sizes, default=0)))
    factors, safe = levels.factor(jnp.asarray(diagonal), jnp.asarray(coupling), DROP)
    y = levels.solve(factors, jnp.asarray(r))
    expected = np.linalg.solve(S, r.ravel()[places])
    assert safe
    scale = np.linalg.cond(S) * np.abs(expected).max() if sizes else 1
    np.testing.assert_allclose(y.ravel()[places], expected, atol=1e-15 * scale)


def chain_of_bars(angle):
    """D of a chain hung from the ground at one end, and held by a bar at the other; its last two rows meet at that angle."""
    sizes, pairs = STRUCTURES["chain"]
    random = np.random.default_rng(2)
    rows = random.normal(size=(2 * len(sizes), 3 * (len(sizes) + 1)))
    for i in range(len(sizes)):
        rows[2 * i : 2 * i + 2, : 3 * i] = rows[2 * i : 2 * i + 2, 3 * i + 6 :] = 0
    rows[-1] = rows[-2] * np.cos(angle) + rows[-1] * np.sin(angle)
    S = (rows @ rows.T).reshape(len(sizes), 2, len(sizes), 2)
    diagonal = np.stack([S[i, :, i] for i in range(len(sizes))])
    return rows, diagonal, np.stack([S[i, :, j] for i, j in pairs])


def test_a_row_that_nearly_depends_on_others_is_told_by_its_pivot():
    verdict = {}
    for angle in (0.0, 1e-6, 1e-3):
        _, diagonal, coupling = chain_of_bars(angle)
        r = np.ones((len(diagonal), 2))
        verdict[angle] = [bool(compiled("chain")(diagonal, coupling, r, drop)[1]) for drop in (1e-14, 1e-10, 1e-4)]
    assert verdict[0.0][1:] == [False, False]
    assert verdict[1e-6] == [True, False, False]
    assert verdict[1e-3] == [True, True, False]


def test_near_dependence_an_attainable_right_side_is_still_met():
    """b = D x for a moderate x: so is the minimum-norm solution, and the equations hold to rounding error, cond(S) > 1e10."""
    rows, diagonal, coupling = chain_of_bars(2e-5)
    x = np.random.default_rng(3).normal(size=rows.shape[1])
    y, safe = compiled("chain")(diagonal, coupling, (rows @ x).reshape(-1, 2), 1e-12)
    assert safe
    assert np.linalg.cond(rows) ** 2 > 1e10
    np.testing.assert_allclose(rows @ (rows.T @ y.ravel()), rows @ x, atol=1e-11)


def test_forward_and_reverse_derivatives():
    """S dy = dr - dS y, for a structure with padded fronts of several shapes."""
    sizes, pairs = parts(tree(6), clique(3), ([1], []))
    levels = Levels.of(sizes, pairs)
    random = np.random.default_rng(1)
    r, dr, weights = random.normal(size=(3, len(sizes), max(sizes)))
    point, change = ([np.nan_to_num(a) for a in matrix(sizes, pairs, seed)] for seed in (0, 5))
    S, places = dense(sizes, pairs, *point)
    y = np.linalg.solve(S, r.ravel()[places])
    dy = np.linalg.solve(S, dr.ravel()[places] - dense(sizes, pairs, *change)[0] @ y)

    def solve(diagonal, coupling, r):
        return levels.solve(levels.factor(diagonal, coupling, DROP)[0], r)

    def both(point, change):
        gradients = jax.grad(lambda *p: (weights * solve(*p)).sum(), (0, 1, 2))(*point)
        return jax.jvp(solve, point, change)[1], sum((g * c).sum() for g, c in zip(gradients, change, strict=True))

    arguments = (*point, r), (*change, dr)
    forward, reverse = jax.jit(both).lower(*arguments).compile(FAST)(*arguments)
    np.testing.assert_allclose(forward.ravel()[places], dy, atol=1e-11 * np.abs(dy).max())
    np.testing.assert_allclose(reverse, weights.ravel()[places] @ dy, rtol=1e-10)


def test_a_batch_is_each_of_its_members():
    name = "chain"
    sizes, pairs = STRUCTURES[name]
    levels = Levels.of(sizes, pairs)
    members = [np.stack(a) for a in zip(*(matrix(sizes, pairs, seed) for seed in range(3)), strict=True)]
    r = np.random.default_rng(1).normal(size=(3, len(sizes), max(sizes)))
    drops = np.array([DROP, DROP, 0.9])

    def solve(diagonal, coupling, r, drop):
        factors, safe = levels.factor(diagonal, coupling, drop)
        return levels.solve(factors, r), safe

    y, safe = jax.jit(jax.vmap(solve)).lower(*members, r, drops).compile(FAST)(*members, r, drops)
    assert safe.tolist() == [True, True, False]
    for k in range(3):
        alone, _ = compiled(name)(members[0][k], members[1][k], r[k], drops[k])
        np.testing.assert_allclose(y[k], alone, rtol=1e-9, atol=1e-12)


def cost(structure):
    """Return the equations of the program, the numbers in its factors and the places it looks up."""
    sizes, pairs = structure
    levels = Levels.of(sizes, pairs)
    width = max(sizes)
    shapes = (len(sizes), width, width), (len(pairs), width, width), (len(sizes), width)

    def solve(diagonal, coupling, r):
        factors, safe = levels.factor(diagonal, coupling, DROP)
        return levels.solve(factors, r), safe, factors

    jaxpr, out = jax.make_jaxpr(solve, return_shape=True)(*(jax.ShapeDtypeStruct(s, float) for s in shapes))
    groups = [g for level in levels.plan.levels for g in level]
    places = sum(getattr(g, a).size for g in groups for a in ("entries", "pivot", "side", "corner"))
    return len(jaxpr.eqns), sum(a.size for a in jax.tree.leaves(out[2])), places


@pytest.mark.parametrize("structure", [chain, lambda n: touching(four_bars(n // 3))], ids=["chain", "loops"])
def test_the_program_grows_like_the_logarithm_and_its_numbers_like_the_size(structure):
    """From 150 to 2,400 blocks, 16 times as many: four more levels."""
    equations, numbers, places = np.transpose([cost(structure(n)) for n in (150, 600, 2400)])
    assert np.ptp(np.diff(equations)) <= 0.2 * np.diff(equations).mean()  # as much for every factor of four
    assert equations[-1] < 2 * equations[0]
    assert numbers[-1] < 17 * numbers[0]
    assert places[-1] < 17 * places[0]


def test_a_structure_is_analysed_once():
    assert Levels.of(*chain(50)) is Levels.of(*chain(50))


def test_no_block_at_all():
    levels = Levels.of([], [])
    factors, safe = levels.factor(jnp.zeros((0, 0, 0)), jnp.zeros((0, 0, 0)), DROP)
    assert safe
    assert levels.solve(factors, jnp.zeros((0, 0))).shape == (0, 0)


@pytest.mark.parametrize(
    ("sizes", "pairs", "message"),
    [
        ([2, 0], [], r"sizes are \[0\]"),
        ([2, 2], [(0, 2)], "blocks 0 to 1, but one is 2"),
        ([2, 2], [(-1, 1)], "one is -1"),
        ([2, 2], [(1, 1)], "two different blocks"),
        ([2, 2], [(0, 1), (1, 0)], "one pair only"),
    ],
)
def test_structures_that_are_none(sizes, pairs, message):
    with pytest.raises(ValueError, match=message):
        Levels.of(sizes, pairs)
