"""Every method is compared with exact pseudoinverses, within its promised accuracy."""

from itertools import groupby

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.pinv.methods import entries


def rank_tol(entry, matrix, dtype):
    """A threshold between the kept and the dropped singular values; None if the method has a better default."""
    if entry.own_threshold:
        return None
    if dtype == np.float32:
        return 1e-5
    return 1e-12 if matrix.cond < 1e11 else 0.0  # the worst Hilbert matrices: of full rank, nothing is to be dropped


def bound(entry, matrix, dtype):
    return 100 * float(np.finfo(dtype).eps) * matrix.cond**entry.power


def admitted(entry, matrix, dtype):
    """True if the rank can be determined from a matrix in float32 by a method, and the method guarantees its error."""
    if entry.power > 1 and bound(entry, matrix, dtype) >= 1:
        return False
    if entry.own_threshold:
        return matrix.cond < 0.3 * float(np.finfo(dtype).eps) ** (-1 / 3)
    return dtype == np.float64 or matrix.cond < 1e4


def frame(matrix):
    """Pad all matrices to a few shapes, which compiles faster: zero rows and columns only add zeros to a pseudoinverse."""
    m, n = matrix.a.shape
    return (12, 12) if m == n else (8, 5) if m > n else (m, n)


def padded(a, shape):
    return np.pad(a, [(0, new - old) for old, new in zip(a.shape, shape)])


def compute(entry, matrices, dtype):
    """Yield (matrix, X, rank)."""
    chosen = sorted((m for m in matrices if admitted(entry, m, dtype)), key=frame)
    for shape, group in groupby(chosen, key=frame):
        group = list(group)
        stack = jnp.asarray(np.array([padded(m.a, shape) for m in group]), dtype)
        tols = None if entry.own_threshold else jnp.array([rank_tol(entry, m, dtype) for m in group])
        inverses, ranks = jax.jit(jax.vmap(lambda tol, a: (entry.make(tol)(a), entry.make(tol).rank(a))))(tols, stack)
        assert inverses.dtype == dtype
        for matrix, inverse, rank in zip(group, np.asarray(inverses, np.float64), ranks):
            m, n = matrix.a.shape
            np.testing.assert_array_equal(inverse, padded(inverse[:n, :m], shape[::-1]))
            yield matrix, inverse[:n, :m], rank


def relative_error(x, reference):
    return np.linalg.norm(x - reference) / np.linalg.norm(reference)


def penrose_defects(a, x):
    """The four Penrose conditions, each relative to the size of its terms."""
    ax, xa = a @ x, x @ a
    return {
        "a x a = a": relative_error(ax @ a, a),
        "x a x = x": relative_error(x @ ax, x),
        "(a x)^T = a x": np.linalg.norm(ax - ax.T) / np.linalg.norm(ax),
        "(x a)^T = x a": np.linalg.norm(xa - xa.T) / np.linalg.norm(xa),
    }


def wrong(x, matrix, tolerance):
    """Return every way in which x is not the pseudoinverse of the matrix, in words."""
    measured = {"error": relative_error(x, matrix.plus), **penrose_defects(matrix.a, x)}
    return [f"{matrix.name}: {k}: {v:.1e} > {tolerance:.1e}" for k, v in measured.items() if not v <= tolerance]


def check_exact_matrices(entry, exact, dtype):
    complaints, seen = [], 0
    for matrix, x, rank in compute(entry, exact, dtype):
        complaints += wrong(x, matrix, min(1.0, bound(entry, matrix, dtype)))
        if rank != matrix.rank:
            complaints.append(f"{matrix.name}: rank {rank}, not {matrix.rank}")
        seen += 1
    assert not complaints, "\n".join(complaints)
    everything = {np.float64: 27, np.float32: 15}[dtype]
    assert seen == everything if entry.power == 1 else seen >= 11


# OneOf is as exact as the chosen method; test_scale_invariance checks that it applies the chosen one
@pytest.mark.parametrize("entry", entries("SVD", "Elimination", "Greville", "Auto"), indirect=True)
def test_exact_matrices(entry, exact):
    check_exact_matrices(entry, exact, np.float64)


@pytest.mark.parametrize("entry", entries("SVD", "Greville"), indirect=True)
def test_exact_matrices_in_single_precision(entry, exact):
    check_exact_matrices(entry, exact, np.float32)


def test_the_checker_sees_what_is_wrong(exact):
    matrix = exact[0]
    assert not wrong(matrix.plus, matrix, 1e-14)
    perturbed = matrix.plus + 1e-9 * np.eye(4)
    assert len(wrong(perturbed, matrix, 1e-11)) == 5
    assert len(wrong(matrix.a.T, matrix, 0.1)) >= 3
    assert len(wrong(np.full((4, 4), np.nan), matrix, 1.0)) == 5


SHAPES = (1, 5), (5, 1), (3, 7), (7, 3)


@pytest.mark.parametrize("shape", [pytest.param(s, id=str(s), marks=pytest.mark.slow if s in SHAPES[:3] else ()) for s in SHAPES])
@pytest.mark.parametrize("entry", entries("Varga", "Greville", "Elimination", "Auto"), indirect=True)
def test_shapes_and_degenerate_matrices(entry, shape):
    rng = np.random.default_rng(3)
    m, n = shape
    general = rng.normal(size=shape)
    equal_rows_and_columns = np.ones(shape)
    rank_one = np.outer(rng.normal(size=m), rng.normal(size=n))
    stack = np.array([np.zeros(shape), equal_rows_and_columns, rank_one, general])
    b = rng.normal(size=(4, m))
    method = entry.make()

    plus, (x, rank) = jax.jit(jax.vmap(lambda a, b: (method(a), method.solve(a, b))))(stack, b)
    expected = np.linalg.pinv(stack)
    np.testing.assert_allclose(plus, expected, atol=1e-12)
    np.testing.assert_allclose(x, np.einsum("snm,sm->sn", expected, b), atol=1e-12)
    assert rank.tolist() == [0, 1, 1, min(m, n)]


@pytest.mark.parametrize("entry", entries("Varga", "Greville", "Elimination", "OneOf"), indirect=True)
def test_scale_invariance(entry):
    """A relative threshold does not depend on units."""
    a = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 1.0, -1.0]])
    scales = np.array([1e-100, 1e-8, 1.0, 1e100])
    plus = jax.jit(jax.vmap(entry.make()))(scales[:, None, None] * a)
    np.testing.assert_allclose(plus * scales[:, None, None], np.broadcast_to(np.linalg.pinv(a), plus.shape), atol=1e-13)
