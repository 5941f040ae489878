"""JAX functions of one member as machine code: each primitive, loops and branches equal JAX in every lane."""

import itertools
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend import core
from jax.scipy.linalg import cho_factor, cho_solve
from numpy.testing import assert_allclose

from tests.native.lowering.lowered import lowered, write
from udkjax.native.code import processor
from udkjax.native.language.program import UnsupportedError
from udkjax.native.language.text import text_of_module
from udkjax.native.lowering.lowering import SEPARATE_FUNCTION_SIZE, traced
from udkjax.native.lowering.module_calls import call_p
from udkjax.native.lowering.own_objects import Written
from udkjax.native.lowering.rules import CONTROL_RULES, ELEMENTWISE, RULES
from udkjax.native.lowering.varying import inlined

A, B = (np.random.default_rng(k).standard_normal((9, 4, 5)) for k in (0, 1))
P = np.abs(A) / 4  # within the domain of all functions
INDEX = np.arange(9) % 7 - 1  # an index for each member, some outside


def unary(*names):
    return lambda p: tuple(getattr(jnp, name)(p) for name in names)


def fibonacci(a, count):
    """A loop whose states are exchanged, with a count for each lane."""
    x, y, k = lax.while_loop(lambda s: s[2] < count, lambda s: (s[1], s[0] + 0.5 * s[1], s[2] + 1), (a, a + 1.0, 0))
    return x, y, k


def rows(a, b):
    total, found = lax.scan(lambda s, r: (s + r[0] * r[1], s.sum()), jnp.zeros(5), (a, b), reverse=True)
    return total, found


def long_rows(a):
    """Reductions whose results and terms are in loops, with a remainder."""
    x = jnp.outer(a.ravel(), jnp.cos(a).ravel())
    return x @ x[:, :19], x.sum(0), x.max(1), x[:, 0] @ x, x[0] @ x[1]


def gauss(a):
    """Elimination in place, with the pivot of each lane."""

    def step(k, m):
        p = jnp.argmax(jnp.where(jnp.arange(4) >= k, jnp.abs(m[:, k]), -1.0))
        m = m.at[k].set(m[p]).at[p].set(m[k])
        factor = jnp.where(jnp.arange(4) > k, m[:, k] / m[k, k], 0.0)
        return m - factor[:, None] * m[k]

    return lax.fori_loop(0, 4, step, a)


def systems(a, b):
    square = a[:, :4].at[1].set(0.0).at[1, 1].set(1.0)  # pivots are exchanged
    return jnp.linalg.solve(square, b), jnp.linalg.solve(square, b[:, 0]), jnp.linalg.inv(square), *lax.linalg.lu(a)


def triangular(a, b):
    square = a[:, :4] + 3 * jnp.eye(4)
    solve = lax.linalg.triangular_solve
    kinds = itertools.product((True, False), repeat=4)
    return tuple(
        solve(square, b if left else b.T, left_side=left, lower=lower, transpose_a=transpose, unit_diagonal=unit)
        for left, lower, transpose, unit in kinds
    )


def definite(a, b):
    """Cholesky's factors and their solutions; the second matrix is not definite."""
    square = a @ a.T + jnp.eye(4)
    return jnp.linalg.cholesky(square), jnp.linalg.cholesky(a[:, :4] + a[:, :4].T), cho_solve(cho_factor(square), b)


def reflections(a):
    """Signs are those of LAPACK; of a deficient matrix, products are compared."""
    modes, deficient = ("reduced", "complete"), a[:, :4].at[1].set(a[0, :4])
    known = [x for each in (a, a.T, a[:, :4], 0 * a) for mode in modes for x in jnp.linalg.qr(each, mode=mode)]
    pivoted = [x for each in (a, a.T) for x in jax.scipy.linalg.qr(each, pivoting=True)]
    q, r = jnp.linalg.qr(deficient)
    return (*known, *pivoted, q @ r, q.T @ q)


def singular(a):
    """Singular values, and products that the signs of singular vectors do not change."""
    found = []
    for x in (a, 1e-200 * a.T.at[:, 3].set(a[0])):
        found += [jnp.linalg.svd(x, compute_uv=False) / jnp.abs(x).max(), jnp.linalg.pinv(x) * jnp.abs(x).max()]
        for full in (True, False):
            u, s, vt = jnp.linalg.svd(x, full_matrices=full)
            found += [u[:, :4] * s @ vt[:4] / jnp.abs(x).max(), u.T @ u, vt @ vt.T]
    return (*found, jnp.linalg.matrix_rank(a.at[1].set(a[0])), jnp.linalg.lstsq(a, a[:, 0])[0], jnp.linalg.norm(a, 2))


def symmetric_ones(a):
    found = []
    for x in (a @ a.T, a[:, :4] + a[:, :4].T, jnp.diag(a[0]), jnp.zeros((3, 3)) + a[0, 0], 1e100 * (a.T @ a)):
        values, vectors = jnp.linalg.eigh(x)
        found += [values / jnp.abs(x).max(), vectors * values @ vectors.T / jnp.abs(x).max(), vectors.T @ vectors]
    return (*found, lax.linalg.eigh(a[:, :4], lower=True, symmetrize_input=False)[1])


def in_order(a, b):
    holes = jnp.round(jnp.where(a > 1, jnp.nan, jnp.where(a < -1, jnp.inf, a)), 1)
    return (
        jnp.sort(holes), jnp.sort(holes, 0), jnp.argsort(holes, 1), jnp.sort((4 * b).astype(int)), jnp.median(a, 1),
        *lax.sort((jnp.round(a), b), dimension=0, num_keys=2),
    )  # fmt: skip


def masks(a, b):
    x, y = a > 0, b > 0
    return (
        x < y, x <= y, x > y, x >= y, x == y, x != y, jnp.maximum(x, y), jnp.minimum(x, y), jnp.where(x < y, a, b),
        x.max(0), x.min(1), x.argmax(1), x.argmin(0), x.sum(1), x.cumsum(0), x.astype(float), x.astype(int),
        jnp.sort(x, 0), jnp.argsort(~x, 1, stable=True), jnp.all(x, 0), jnp.any(y, 1), jnp.argmax(jnp.any(x & y, 0)),
    )  # fmt: skip


def long(a, b):
    """More operations than a function has in machine code: it is split."""
    for _ in range(SEPARATE_FUNCTION_SIZE):
        a = 0.9 * a + b
    return a, jnp.any(a > b)


def long_parts(a, b):
    of_branch = lax.cond(jnp.sum(a) > 0, long, lambda a, b: (b, jnp.sum(a) > 1), a, b)
    of_loop = lax.fori_loop(0, 3, lambda k, x: long(x, b)[0] * k, a)
    return *of_branch, of_loop, *jax.jit(long)(a, b), *jax.jit(long)(b, a)


CASES = {
    "long parts": (long_parts, (A, B)),
    "masks": (masks, (A, B)),
    "arithmetic": (
        lambda a, b: (a + b, a - b, a * b, a / b, -a, jnp.abs(a), a**3, a**2, jnp.square(a), a % b, lax.sign(a)),
        (A, B),
    ),
    "comparisons": (
        lambda a, b: (a < b, a <= b, a > b, a >= b, a == b, a != b, jnp.isfinite(a), ~((a < b) & (a > 0) | (b > 1) ^ (a > 1))),
        (A, B),
    ),
    "repeated": (
        lambda a, b: (
            a[:, :1] * b,
            a[:1] - b,
            a[:1, 0] + b[0],
            jnp.where(a[:, :1] > 0, a, b),
            (a[:1] > 0) & (b > 0),
            2.0 / b[:1, :1] * a,
        ),
        (A, B),
    ),
    "extremes": (lambda a, b: (jnp.maximum(a, b), jnp.minimum(a, b), lax.clamp(-0.5, a, 0.5), jnp.where(a < b, a, b)), (A, B)),
    "rounded": (
        lambda a: (
            jnp.floor(a),
            jnp.ceil(a),
            jnp.round(a),
            (3 * a).astype(int),
            lax.stop_gradient(a),
            lax.copy_p.bind(a),
            lax.convert_element_type_p.bind(a > 0, new_dtype=np.dtype(bool), weak_type=False, sharding=None),
        ),
        (A,),
    ),
    "roots": (lambda p: (jnp.sqrt(p), lax.rsqrt(p), jnp.power(p, 0.3), p**-2), (P,)),
    "angles": (unary("sin", "cos", "tan", "arcsin", "arccos", "arctan"), (P,)),
    "angle": (jnp.arctan2, (A, B)),
    "powers": (unary("exp", "exp2", "expm1", "log", "log1p", "sinh", "cosh", "tanh"), (P,)),
    "logistic": (jax.nn.sigmoid, (A,)),
    "views": (lambda a: (a.T, a.reshape(2, 10), a[1:3, ::2], jnp.flip(a, 1), a[None], a[:, None, :2], jnp.squeeze(a[:1])), (A,)),
    "parts": (lambda a: tuple(jnp.split(a, (1, 3), axis=1)), (A,)),
    "joined": (
        lambda a, b: (jnp.concatenate([a, b * 2], 1), jnp.stack([a[0], b[1]]), jnp.stack([a, b], -1), *jnp.unstack(a, axis=1)),
        (A, B),
    ),
    "tables": (lambda a: (a + np.arange(20.0).reshape(4, 5) ** 2, a @ np.eye(5)[::-1], jnp.arange(5) * a), (A,)),
    "at an index": (
        lambda a, i: (lax.dynamic_slice(a, (i, i), (2, 2)), a[i], a.at[i, 1].get(mode="fill"), a[jnp.array([2, 0])]),
        (A, INDEX),
    ),
    "put": (lambda a, i: (a.at[i].set(1.5), a.at[:, i].add(a[:, 0]), a.at[i, 2].set(a[0, 0])), (A, INDEX)),
    "put slices": (lambda a, b, i: lax.dynamic_update_slice(a, b[:2, :3], (i, i)), (A, B, INDEX)),
    "put several": (lambda a, b: a.at[jnp.array([2, 0])].add(b[:2]), (A, B)),
    "sums": (
        lambda a: (
            a.sum(),
            a.sum(0),
            a.sum(1),
            a[:3, :2].prod(),
            jnp.any(a > 2, 1),
            jnp.all(a > -2, 0),
            (a > 0).astype(int).sum(),
        ),
        (A,),
    ),
    "cumulative": (lambda a: (jnp.cumsum(a, 0), jnp.cumprod(a, 1), lax.cumsum(a, 1, reverse=True), jnp.diagonal(a[:, :4])), (A,)),
    "largest": (
        lambda a: (a.max(1), a.min(0), jnp.argmax(a, 1), jnp.argmin(a, 0), jnp.argmax(a > 1, 1), (5 * a).astype(int).max(0)),
        (A,),
    ),
    "largest of NaN": (lambda a: (jnp.argmax(jnp.where(a > 1, jnp.nan, a), 1), jnp.where(a > 1, jnp.nan, a).max()), (A,)),
    "products": (lambda a, b: (a @ b.T, a.T @ b, a[0] @ b[1], jnp.outer(a[0], b[1]), jnp.einsum("ij,ij->i", a, b)), (A, B)),
    "long rows": (long_rows, (A,)),
    "derivative": (lambda a, b: jax.jvp(lambda x: jnp.sum(jnp.sin(x) * x, 0), (a,), (b,)), (A, B)),
    "systems": (systems, (A, B)),
    "triangular systems": (triangular, (A, B)),
    "definite systems": (definite, (A, B)),
    "padded": (lambda a: (jnp.diag(a[0]), lax.pad(a, 2.0, ((1, 0, 1), (0, 2, 0)))), (A,)),
    "scan": (rows, (A, B)),
    "unequal loops": (fibonacci, (A, np.arange(9))),
    "exchanged": (lambda a, b: lax.fori_loop(0, 3, lambda _, s: (s[1], s[0]), (a, b)), (A, B)),
    "branch by lane": (lambda a, b: lax.cond(a[0, 0] > 0, lambda: (a * b, a[0, 0]), lambda: (a - b, b[0, 0])), (A, B)),
    "one branch of three": (lambda a, i: lax.switch(i, [lambda: a, lambda: 2 * a, lambda: a[::-1]]), (A, INDEX)),
    "shared branch": (lambda a: lax.fori_loop(0, 4, lambda k, x: lax.cond(k % 2 == 0, lambda: x + k, lambda: -x), a), (A,)),
    "elimination": (gauss, (A,)),
    "reflections": (reflections, (A,)),
    "singular values": (singular, (A,)),
    "eigenvalues": (symmetric_ones, (A,)),
    "in order": (in_order, (A, B)),
    "tiled": (lambda a: (jnp.tile(a, (2, 1)), jnp.tile(a, (1, 3))), (A,)),
}


@cache
def by_jax(name):
    """Return the results of all members of a case."""
    function, given = CASES[name]
    return jax.tree.leaves(jax.jit(jax.vmap(function))(*given))


@pytest.mark.parametrize("width", [1, processor.lanes()])
@pytest.mark.parametrize("name", CASES)
def test_equals_jax(name, width):
    function, given = CASES[name]
    for x, y in zip(lowered(function, given, width), by_jax(name), strict=True):
        assert_allclose(x, np.asarray(y, float), rtol=1e-12, atol=1e-12)


def names_in(jaxpr):
    """Return the names of the primitives of a jaxpr."""
    found = set()
    for e in jaxpr.eqns:
        solves = e.primitive.name == "custom_linear_solve"  # its other functions are for derivatives
        params = [e.params["jaxprs"].solve] if solves else e.params.values()
        inner = [x for p in params for x in (p if isinstance(p, tuple | list) else [p])]
        inner = [getattr(x, "jaxpr", x) for x in inner if isinstance(getattr(x, "jaxpr", x), core.Jaxpr)]
        found |= set() if inlined(e) else {e.primitive.name}
        found = found.union(*(names_in(x) for x in inner))
    return found


def test_each_rule_has_a_case():
    """Primitives come and go with JAX's releases: some views are made by some of them only."""
    shapes = lambda given: [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in given]  # noqa: E731
    seen = set().union(*(names_in(jax.make_jaxpr(f)(*shapes(given)).jaxpr) for f, given in CASES.values()))
    of_some_releases = {"expand_dims", "stack", "unstack"}
    of_modules = {call_p.name}  # tests/integrate/systems/test_own_stabilizations.py
    assert {*ELEMENTWISE, *RULES, *CONTROL_RULES} - seen <= of_some_releases | of_modules
    assert seen <= {*ELEMENTWISE, *RULES, *CONTROL_RULES}


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (jax.scipy.linalg.schur, "schur"),
        (lambda a: jnp.linalg.svd(jnp.stack([a, a])), "svd of batches"),
        (lambda a: lax.top_k(a, 2), "top_k"),
        (lambda a: a.astype(np.float32), "float32"),
        (lambda a: a * 1j, "complex128"),
    ],
)
def test_what_is_missing_is_named(function, name):
    with pytest.raises(UnsupportedError, match=name):
        write(function, (A[:, :, :4],), 1)


def test_traces_within_others_are_equal():
    """Otherwise a text that is stored within a trace would take other memory than one from outside."""
    given = [jax.ShapeDtypeStruct((4, 4), float)]

    def function(a):
        return lax.fori_loop(0, 3, lambda _, x: x @ a, jnp.linalg.pinv(a))

    found = [str(traced(function, given))]
    jax.jit(lambda x: found.append(str(traced(function, given))) or x)(0.0)
    for context in (jax.ensure_compile_time_eval(), jax.disable_jit()):
        with context:
            found.append(str(traced(function, given)))
    assert len(found) == 4 and len({*found}) == 1


def test_memory_that_is_too_small_is_refused():
    f, _, size = write(gauss, (A,), 1)
    assert Written(f, size).within(size) is f
    with pytest.raises(RuntimeError, match=f"takes memory for {size} numbers, not {size - 1}"):
        Written(f, size).within(size - 1)


def test_equal_parts_are_one_function():
    """The branch and both calls have one, the body of the loop another."""
    f, *_ = write(long_parts, (A, B), 1)
    assert len([name for name in f.evaluated if name.startswith("part_")]) == 2


def test_webassembly():
    """The same text, without imports."""
    from tests.wasm_host import Host
    from udkjax.native.wasm.target import compile_wasm

    f, outs, size = write(gauss, (A,), 1)
    linked = compile_wasm(text_of_module([f]), ("lowered",))
    host = Host(linked.code, linked.data_end)
    result = host.put(np.zeros(outs[0][0]))
    host.call("lowered", host.put(A[0]), result, host.put(np.full(size, np.nan)))
    assert_allclose(host.numbers(result, 20).reshape(4, 5), jax.jit(gauss)(A[0]), rtol=1e-12, atol=1e-12)
