"""The pseudoinverses in machine code equal those of `udkjax.pinv`: the same ranks, and D^+ b up to rounding, in every lane."""

import ctypes
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.choices import fast
from tests.pinv.matrices import read_exact
from udkjax import pinv
from udkjax.native.code import machine, processor
from udkjax.native.language.ir import POINTER, Function
from udkjax.native.language.text import text_of_module
from udkjax.native.module.layout import Layout
from udkjax.native.module.memory import Memory
from udkjax.native.pseudoinverses import dense_method
from udkjax.native.pseudoinverses.dense import DenseLayout, DenseMatrices

METHODS = {
    "SVD": pinv.SVD,
    "Varga": pinv.Varga,
    "Householder": pinv.Householder,
    "GramSchmidt": pinv.GramSchmidt,
    "GramSchmidt once": lambda *a, **k: pinv.GramSchmidt(*a, **k, twice=False),
    "Greville": pinv.Greville,
}


class Solver(Memory):
    """One method for (m, n) matrices with a number of lanes."""

    def __init__(self, method: pinv.Pseudoinverse, m: int, n: int, width: int):
        plan: Any = SimpleNamespace(width=width, vector=processor.lanes())
        code = dense_method(method)
        assert code is not None
        self.plan = plan
        self.places, self.m, self.n = Layout(width, processor.lanes()), m, n
        self.places.add("fallback_tol")
        self.begins = []
        self.places.add("method")
        layout = DenseLayout(self, code.matrices(m, n), (m, n))
        functions = []
        names = ["index", "factor", "solve", *(["solve_transposed"] if isinstance(method, pinv.SVD) else [])]
        for name in names:
            f = Function(name, [(POINTER, "work")], width)
            if name == "index":
                layout.number_columns(f)
            else:
                getattr(code, name)(DenseMatrices(layout, f))
            functions.append(f)
        self._library = machine.library(text_of_module(functions), names)
        self._layout = layout

    def _view(self, memory, name):
        """The entries of a matrix, (rows, columns, lanes)."""
        rows, columns = self._layout.shapes[name]
        width, start = self.plan.width, self.places[f"dense {name}"] * self.plan.width
        stride = self._layout.registers[name] * self.plan.vector
        return memory[start : start + rows * stride].reshape(rows, -1, width)[:, :columns]

    def __call__(self, matrices, right, tols, numbers: Any = 0.0, solve="solve"):
        """Return x and the ranks, for as many matrices as there are lanes."""
        given, to = ("b", "x") if solve == "solve" else ("x", "b")
        size = self.places.size * self.plan.width
        memory = np.zeros(size + 8)
        memory = memory[(-memory.ctypes.data // 8) % 8 :][:size]
        memory[: self.plan.width] = tols
        memory[self.places["method"] * self.plan.width :][: self.plan.width] = numbers
        self._view(memory, "D")[:] = np.moveaxis(matrices, 0, -1)
        self._view(memory, given)[0] = np.moveaxis(right, 0, -1)
        for name in ("index", "factor", solve):
            machine.function(self._library[name], ctypes.c_void_p)(memory.ctypes.data)
        return np.moveaxis(self._view(memory, to)[0], -1, 0), self._view(memory, "rank")[0, 0]


def solved(make, matrices, right, tols, width, relative=True, numbers: Any = 0.0):
    """Solve with machine code, in groups of lanes; the last group is padded."""
    method = make(1.0, relative=relative)
    m, n = matrices.shape[1:]
    solver, found, ranks = Solver(method, m, n, width), [], []
    for k in range(0, len(matrices), width):
        chosen = np.minimum(np.arange(k, k + width), len(matrices) - 1)
        tol, number = (np.broadcast_to(y, len(matrices))[chosen] for y in (tols, numbers))
        x, rank = solver(matrices[chosen], right[chosen], tol, number)
        found.append(x)
        ranks.append(rank)
    return np.concatenate(found)[: len(matrices)], np.concatenate(ranks)[: len(matrices)]


def plain(make, matrices, right, tols, relative=True):
    of = jax.jit(jax.vmap(lambda D, b, tol: tuple(make(tol, relative=relative).solve(D, b))))
    return [np.asarray(x) for x in of(matrices, right, jnp.broadcast_to(jnp.asarray(tols), len(matrices)))]


def random_matrices(m, n, ranks, seed=0):
    random = np.random.default_rng(seed)
    found = []
    for rank in ranks:
        u, v = (np.linalg.qr(random.standard_normal((k, k)))[0] for k in (m, n))
        found.append((u[:, :rank] * random.uniform(0.5, 2.0, rank)) @ v[:rank])
    return np.array(found), random.standard_normal((len(ranks), m))


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("m, n, width", [(12, 12, processor.lanes()), (5, 20, 1), (9, 5, processor.lanes()), (3, 1, 1)])
def test_every_lane_has_a_rank_of_its_own(name, m, n, width):
    """Right-hand sides are inconsistent: where the rank falls, results are least-squares solutions of least norm."""
    ranks = [k % (min(m, n) + 1) for k in range(min(m, n), 2 * min(m, n) + 9)]
    matrices, right = random_matrices(m, n, ranks)
    x, found = solved(METHODS[name], matrices, right, 1e-6, width)
    assert_array_equal(found, ranks)
    assert_allclose(x, [np.linalg.pinv(D, rcond=1e-6) @ b for D, b in zip(matrices, right, strict=True)], rtol=0, atol=1e-12)


def one(matrix, right, tol, solve="solve"):
    """Solve with one matrix, by singular values."""
    D = np.array(matrix, float)
    m, n = D.shape
    solver = Solver(pinv.SVD(1.0), m, n, 1)
    return solver(D[None], np.array(right, float)[None], tol, solve=solve)[0][0]


@pytest.mark.parametrize("m, n", [(1, 6), (12, 12), (9, 5), (7, 11)])
def test_transposed(m, n):
    matrices, _ = random_matrices(m, n, [min(m, n), max(min(m, n) - 2, 1)])
    for D in matrices:
        x = np.random.default_rng(1).standard_normal(n)
        assert_allclose(one(D, x, 1e-9, "solve_transposed"), np.linalg.pinv(D, rcond=1e-9).T @ x, rtol=0, atol=1e-12)


def test_small_singular_values_are_exact_to_many_digits():
    """The rows have very different lengths; results from D D^T would have no correct digits."""
    (inner,), _ = random_matrices(3, 3, [3])
    D, x = np.diag([1.0, 1e-5, 1e-10]) @ inner, [1.0, 2.0, 3.0]
    assert_allclose(one(D, D @ x, 1e-14), x, rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-60, 1e60])
def test_what_is_scaled_is_solved_alike(scale):
    (D,), (b,) = random_matrices(4, 6, [3])
    assert_allclose(one(scale * D, scale * b, 1e-9), one(D, b, 1e-9), rtol=1e-12)


def test_zeros_and_numbers_that_are_none():
    """Zero matrices have rank zero, and non-finite matrices terminate."""
    assert_array_equal(one(np.zeros((3, 4)), np.ones(3), 1e-9), np.zeros(4))
    assert_allclose(one([[0.0, 0.0], [0.0, 2.0], [0.0, 0.0]], [5.0, 1.0, 7.0], 1e-9), [0.0, 0.5])
    for bad in (np.nan, np.inf):
        assert np.isnan(one([[1.0, bad], [2.0, 3.0]], [1.0, 1.0], 1e-9)).any()


@pytest.mark.parametrize("name", fast(["SVD", "Varga", "Greville"], METHODS))
def test_exact_matrices(name):
    """Errors of D^+ are those that the plain form promises: eps cond(D), or eps cond(D)^2."""
    make = METHODS[name]
    power = 2 if name in ("Greville", "GramSchmidt once") else 1
    eps = np.finfo(float).eps
    for matrix in read_exact():
        if matrix.cond**power * eps * 100 > 1 or (name == "Greville" and matrix.cond > 0.3 * eps ** (-1 / 3)):
            continue
        m = len(matrix.a)
        tol = eps ** (1 / 3) if name == "Greville" else 1e-12 if matrix.cond < 1e11 else 0.0
        matrices, right = np.broadcast_to(matrix.a, (m, *matrix.a.shape)), np.eye(m)
        x, rank = solved(make, matrices, right, tol, processor.lanes())
        bound = 100 * eps * matrix.cond**power * np.linalg.norm(matrix.plus)
        assert_array_equal(rank, matrix.rank, err_msg=matrix.name)
        assert np.linalg.norm(x.T - matrix.plus) <= bound, matrix.name


@pytest.mark.parametrize("name", fast(["SVD", "Varga", "Greville"], METHODS))
@pytest.mark.parametrize("relative", [True, False])
def test_thresholds_meet_the_same_scale(name, relative):
    """Lengths of rows decrease by factors of ten. The ranks at thresholds in between equal those of the plain form."""
    lengths = 10.0 ** -np.arange(5)
    matrices = np.array([np.diag(lengths) * 3.0] * 7)
    right, tols = np.ones((7, 5)), np.array([3e-1, 0.05, 3e-2, 5e-3, 3e-4, 1e-5, 4.0]) * (1.0 if relative else 1.7)
    x, rank = solved(METHODS[name], matrices, right, tols, processor.lanes(), relative)
    reference, expected = plain(METHODS[name], matrices, right, tols, relative)
    assert len(set(expected)) > 4
    assert_array_equal(rank, expected)
    assert_allclose(x, reference, rtol=1e-12)


@pytest.mark.parametrize("width", [1, processor.lanes()])
def test_each_lane_has_chosen_a_method_of_its_own(width):
    """Each lane's result is bitwise that of the code of its method alone, in any order of methods."""
    numbers = np.array([3, 0, 4, 1, 1, 2, 0, 4, 2, 3, 0, 2, 4])
    ranks = [12 - k % 3 for k in range(len(numbers))]
    matrices, right = random_matrices(12, 12, ranks)
    makers = [METHODS[name] for name in ("SVD", "Varga", "Householder", "GramSchmidt", "Greville")]
    alone = [solved(make, matrices, right, 1e-6, width) for make in makers]
    several = partial(pinv.OneOf, methods=[make() for make in makers])
    x, found = solved(several, matrices, right, 1e-6, width, numbers=numbers)
    assert_array_equal(found, ranks)
    assert_array_equal(x, [alone[number][0][k] for k, number in enumerate(numbers)])
