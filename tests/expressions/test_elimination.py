"""Linear systems of expressions compared with NumPy: constant pivots first, then rotations; transposes; redundant rows."""

import numpy as np
import pytest

from udkjax.expressions import Graph, ScalarProgram
from udkjax.expressions.algebra.elimination import SymbolicFactors


def system(seed, m, n):
    """A sparse matrix of ones, minus ones and numbers of a run, as expressions, with their values."""
    rng = np.random.default_rng(seed)
    graph, A, inputs, rows = Graph(), np.zeros((m, n)), [], []
    for i in range(m):
        row = {}
        for k in np.unique([*rng.integers(0, n, 2), i % n]):
            if rng.random() < 0.4:
                A[i, k] = rng.choice([-1.0, 1.0, 2.0])
                row[int(k)] = graph.constant(A[i, k])
            else:
                A[i, k] = rng.normal()
                inputs.append((graph.input((i, int(k)), "a"), A[i, k]))
                row[int(k)] = inputs[-1][0]
        rows.append(row)
    return graph, A, inputs, rows


def values(graph, inputs, outputs):
    program = ScalarProgram(graph, [s for s, _ in inputs], outputs)
    return np.array(program([float(x) for _, x in inputs]))


@pytest.mark.parametrize("seed", range(12))
def test_a_square_system_is_solved_both_ways(seed):
    graph, A, inputs, rows = system(seed, 7, 7)
    if np.linalg.cond(A) > 1e6:
        pytest.skip("singular")
    factors, rng = SymbolicFactors(graph, rows, 7), np.random.default_rng(seed)
    b, c = rng.normal(size=7), rng.normal(size=7)
    x = values(graph, inputs, factors.solve([graph.constant(v) for v in b]))
    y = values(graph, inputs, factors.solve_transposed([graph.constant(v) for v in c]))
    scale = np.linalg.cond(A) * 1e-14
    np.testing.assert_allclose(x, np.linalg.solve(A, b), atol=scale * max(1, np.abs(x).max()))
    np.testing.assert_allclose(y, np.linalg.solve(A.T, c), atol=scale * max(1, np.abs(y).max()))


def test_redundant_rows_that_agree_change_nothing():
    graph, A, inputs, rows = system(3, 5, 5)
    rng = np.random.default_rng(0)
    x = rng.normal(size=5)
    twice = SymbolicFactors(graph, [*rows, *rows], 5)
    b = [graph.constant(v) for v in (*(A @ x), *(A @ x))]
    np.testing.assert_allclose(values(graph, inputs, twice.solve(b)), x, atol=1e-12)
    c = rng.normal(size=5)
    y = values(graph, inputs, twice.solve_transposed([graph.constant(v) for v in c]))
    np.testing.assert_allclose(A.T @ (y[:5] + y[5:]), c, atol=1e-12)


def test_what_no_row_determines_is_refused():
    graph = Graph()
    a = graph.input("a", "a")
    with pytest.raises(ValueError, match="no row determines unknown 1"):
        SymbolicFactors(graph, [{0: a}, {0: a}], 2)
    with pytest.raises(ValueError, match="1 rows cannot determine 2"):
        SymbolicFactors(graph, [{0: a}], 2)


def test_what_is_zero_but_for_rounding_is_no_pivot():
    graph = Graph()
    a, b, c = (graph.input(name, "a") for name in "abc")
    rows = [{0: graph.constant(1.0), 1: graph.constant(6e-17), 2: a}, {0: graph.constant(1.0), 1: b, 2: c}, {1: b * c, 2: a}]
    factors = SymbolicFactors(graph, rows, 3)
    program = ScalarProgram(graph, [a, b, c], factors.solve([graph.constant(x) for x in (1.0, 2.0, 3.0)]))
    values = 0.7, 0.4, -1.3
    A = np.array([[1.0, 6e-17, 0.7], [1.0, 0.4, -1.3], [0.0, -0.52, 0.7]])
    found = [x[0] for x in program.by_numpy([np.array([v]) for v in values])]
    np.testing.assert_allclose(found, np.linalg.solve(A, [1.0, 2.0, 3.0]), rtol=1e-12)
