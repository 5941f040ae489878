"""The derivative rule compared with differences along directions of constant rank, in every mode and order."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.pinv.methods import entries
from udkjax.pinv import SVD, Plus, Pseudoinverse, Varga
from udkjax.programs.deferred import deferred

rng = np.random.default_rng(7)
SIZE = 12
NAMES = ["fivebar_J_c3_5_s4_5", "fivebar_J_collinear", "proj12_rank11", "magic8", "redundant_rows"]
LEFT, RIGHT = rng.normal(size=(2, 2, SIZE, SIZE)) / SIZE
B, DB, WEIGHTS = rng.normal(size=SIZE), rng.normal(size=(2, SIZE)), rng.normal(size=(SIZE, SIZE))


@pytest.fixture(scope="session")
def matrices(exact):
    """Repeated singular values at every rank: of the linkage, and of a partial isometry; one of rank three; one of full rank."""
    chosen = {m.name: m.a for m in exact}
    padded = [np.pad(chosen[k], [(0, SIZE - size) for size in chosen[k].shape]) for k in NAMES]
    return jnp.array([*padded, 4 * np.eye(SIZE) + rng.normal(size=(SIZE, SIZE))])


def make(entry):
    return entry.make() if entry.own_threshold else entry.make(1e-9)


def moved(a, p):
    """A matrix of the same rank as a function of two parameters, and a right-hand side."""
    one = jnp.eye(SIZE)
    left = (one + p[0] * LEFT[0]) @ (one + p[1] * LEFT[1])
    right = (one + p[0] * RIGHT[0]) @ (one + p[1] * RIGHT[1])
    return left @ a @ right, B + p @ DB


def solution(method):
    return lambda a, p: method.solve(*moved(a, p)).x


def differences(f, h):
    """Gradient and Hessian of f(p) for two numbers p, by central differences of fourth order, along the last axis."""
    stencil = [(-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12)]
    e = h * jnp.eye(2)
    first = [sum(w * f(k * e[i]) for k, w in stencil) / h for i in (0, 1)]
    second = [
        sum(v * w * f(k * e[i] + l * e[j]) for k, v in stencil for l, w in stencil) / h**2  # noqa: E741
        for i, j in ((0, 0), (0, 1), (1, 1))
    ]
    return jnp.stack(first, -1), jnp.stack(second, -1)


def triangle(hessian):
    return jnp.stack([hessian[..., 0, 0], hessian[..., 0, 1], hessian[..., 1, 1]], -1)


def close(actual, expected, tol):
    """Compare relative to the largest entry of each matrix of the batch."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    size = np.abs(expected).max(axis=tuple(range(1, expected.ndim)), keepdims=True)
    np.testing.assert_array_less(np.abs(actual - expected), np.broadcast_to(tol * size, expected.shape))


def test_checker_sees_what_is_wrong():
    with pytest.raises(AssertionError):
        close(np.ones((2, 3)) + 1e-6, np.ones((2, 3)), 1e-7)
    with pytest.raises(AssertionError):
        close(np.full((2, 3), np.nan), np.ones((2, 3)), 1e-7)
    gradient, hessian = differences(lambda p: jnp.array([p[0] ** 2 + 3 * p[0] * p[1] + p[1]]), 1e-2)
    np.testing.assert_allclose(gradient, [[0, 1]], atol=1e-12)
    np.testing.assert_allclose(hessian, [[2, 3, 0]], atol=1e-10)


def derivatives(method):
    """Derivatives of x along a path of constant rank, and of a function of A^+ with respect to every entry of A.

    In directions that change the rank the rule also gives a number, the same for all methods.
    """
    x = solution(method)

    functions = [
        lambda a: jax.jacfwd(x, 1)(a, jnp.zeros(2)),
        lambda a: jax.jacrev(jax.jacrev(x, 1), 1)(a, jnp.zeros(2)),
        jax.grad(lambda a: jnp.sum(WEIGHTS * method(a))),
    ]
    return deferred(jax.vmap(lambda a: [f(a) for f in functions]))


@pytest.fixture(scope="session")
def reference(matrices):
    return derivatives(SVD(1e-9))(matrices)


CHOSEN = "Greville", "Elimination"  # the others solve as Varga does, by orthogonal factors, or as SVD, below


@pytest.mark.parametrize("entry", entries(*CHOSEN), indirect=True)
def test_derivatives(entry, matrices, reference):
    value = jax.jit(jax.vmap(solution(make(entry)), (0, None)))
    first, second = differences(lambda p: value(matrices, p), 2e-2)
    actual = derivatives(make(entry))(matrices)
    close(actual[0], first, 1e-6)
    close(triangle(actual[1]), second, 1e-5)
    # cond = 82 in the last matrix: cond^2 in each of the three applications that a second derivative takes
    tol = 1e-10 if entry.power == 1 else 1e-8
    for a, b in zip(actual, reference):
        close(a, b, tol)


def test_forward_and_reverse_are_transposes(matrices):
    method = Varga(1e-9)

    def product(a, da, db, ct):
        f = lambda a, b: method.solve(a, b).x  # noqa: E731
        _, dx = jax.jvp(f, (a, B), (da, db))
        ct_a, ct_b = jax.vjp(f, a, B)[1](ct)
        return ct @ dx, jnp.sum(ct_a * da) + ct_b @ db

    u, v = deferred(jax.vmap(product, (0, None, None, None)))(matrices, LEFT[0], DB[0], DB[1])
    np.testing.assert_allclose(u, v, rtol=1e-10)


@pytest.mark.slow
def test_second_derivatives_in_every_mode(matrices):
    x = solution(Varga(1e-9))
    modes = [(outer, inner) for outer in (jax.jacfwd, jax.jacrev) for inner in (jax.jacfwd, jax.jacrev)]
    hessians = deferred(lambda a: [outer(inner(x, 1), 1)(a, jnp.zeros(2)) for outer, inner in modes])(matrices[0])
    for hessian in hessians[1:]:
        close(hessian[None], hessians[0][None], 1e-11)


@pytest.mark.slow
def test_third_derivative():
    """A(s) = u(s) v^T with |u| = |v| = 1 has rank one, and A(s)^+ b = v (u . b) has three derivatives in closed form."""
    v = jnp.array([0.6, 0.8, 0.0])

    def f(s):
        u = jnp.array([jnp.cos(s), jnp.sin(s)])
        return SVD().solve(jnp.outer(u, v), jnp.array([1.0, 2.0])).x

    s = 0.3
    expected = v * (np.sin(s) - 2 * np.cos(s))
    np.testing.assert_allclose(jax.jit(jax.jacrev(jax.jacfwd(jax.jacrev(f))))(s), expected, atol=1e-13)


def test_no_factorization_is_differentiated_or_repeated():
    """However many derivatives are taken, A is factorized once."""

    def factorizations(f):
        return str(jax.make_jaxpr(f)(jnp.ones((3, 4)), jnp.ones(3))).count("svd")

    f = lambda a, b: SVD().solve(a, b).x  # noqa: E731
    once = factorizations(f)
    assert once >= 1
    assert factorizations(jax.jacrev(f)) == factorizations(jax.jacrev(jax.jacrev(f))) == factorizations(jax.jacfwd(f)) == once


@pytest.mark.slow
def test_transforms_compose():
    """A batch within a scan within a gradient."""
    a = jnp.array(rng.normal(size=(4, 3, 2)) @ rng.normal(size=(4, 2, 5)))
    b = jnp.array(rng.normal(size=(4, 3)))

    def scanned(a):
        def step(carry, b):
            x = jax.vmap(lambda a, b: SVD(1e-9).solve(a, b + carry).x, (0, None))(a, b)
            return x.sum(), x

        return jnp.sum(jax.lax.scan(step, 0.0, b)[1] ** 2)

    def looped(a):
        carry, total = 0.0, 0.0
        for i in range(4):
            x = jnp.stack([SVD(1e-9)(a[j]) @ (b[i] + carry) for j in range(4)])
            carry, total = x.sum(), total + jnp.sum(x**2)
        return total

    np.testing.assert_allclose(jax.jit(jax.grad(scanned))(a), jax.jit(jax.grad(looped))(a), rtol=1e-9, atol=1e-9)


class Scaled(eqx.Module):
    """The operator diag(d) padded to (m, n): a pytree that is not a matrix, with an integer leaf."""

    d: jax.Array
    where: jax.Array  # columns of the diagonal


class Factors(eqx.Module):
    inverse: jax.Array
    where: jax.Array
    rank: jax.Array


class ForScaled(Pseudoinverse):
    def admit(self, D):
        return D

    def shape(self, D):
        return len(D.d), len(D.d) + 1

    def matvec(self, D, x):
        return D.d * x[D.where]

    def rmatvec(self, D, y):
        return jnp.zeros(len(D.d) + 1).at[D.where].add(D.d * y)

    def factor(self, D):
        kept = jnp.abs(D.d) > 1e-9
        return Factors(jnp.where(kept, 1 / jnp.where(kept, D.d, 1), 0), D.where, kept.sum())

    def apply(self, factors, b):
        return jnp.zeros(len(b) + 1).at[factors.where].add(factors.inverse * b)

    def apply_transpose(self, factors, c):
        return factors.inverse * c[factors.where]


@pytest.mark.slow
def test_the_rule_serves_any_operator():
    where = jnp.array([2, 0, 1])
    d, b = jnp.array([2.0, 0.0, -0.5]), jnp.array([1.0, 2.0, 3.0])
    free = jnp.array([1.0, 0.0, 1.0])  # the second stays zero: constant rank

    def sparse(d, b):
        return ForScaled().solve(Scaled(free * d, where), b).x

    def dense(d, b):
        return SVD(1e-9).solve(jnp.zeros((3, 4)).at[jnp.arange(3), where].set(free * d), b).x

    for derivative in (jax.jacfwd, lambda f: jax.jacrev(jax.jacrev(f))):
        np.testing.assert_allclose(jax.jit(derivative(sparse))(d, b), jax.jit(derivative(dense))(d, b), atol=1e-12)
    assert isinstance(ForScaled().plus(Scaled(d, where)), Plus)
    np.testing.assert_allclose(ForScaled()(Scaled(d, where)) @ b, sparse(d, b))


def test_a_vector_that_a_batch_shares():
    """If many matrices share a right-hand side, its cotangent is the sum of theirs, however batches are nested."""
    many, b, method = jnp.asarray(rng.normal(size=(2, 3, 4, 5))), jnp.arange(4.0), SVD()
    size = lambda a, b: jnp.sum(method.solve(a, b).x ** 2)  # noqa: E731
    total = lambda b: jnp.sum(jax.vmap(jax.vmap(size, (0, None)), (0, None))(many, b))  # noqa: E731
    each = jax.vmap(jax.grad(size, 1), (0, None))
    found, slopes = jax.jit(lambda b: (jax.grad(total)(b), each(many.reshape(6, 4, 5), b)))(b)
    np.testing.assert_allclose(found, slopes.sum(0), rtol=1e-12)
