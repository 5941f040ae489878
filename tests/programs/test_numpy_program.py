"""JAX programs evaluated by NumPy equal XLA's: operation by operation, in loops, branches and under transformations."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.calls import calls_of
from udkjax.programs.deferred import WORTH_COMPILING, _compiled, deferred, deferred_p
from udkjax.programs.numpy_program import Meter, numpy_program

X = np.random.default_rng(3).uniform(-2.0, 2.0, (4, 5))
Y = np.random.default_rng(4).uniform(0.2, 0.9, (4, 5))
K = np.array([[3, -1, 7, 2, 0]] * 4)
B = X > 0
ONE_ARGUMENT = (
    *(jnp.sin, jnp.cos, jnp.tan, jnp.exp, jnp.expm1, jnp.tanh, jnp.sinh, jnp.cosh, jnp.arctan, jnp.abs, jnp.sign, jnp.floor),
    *(jnp.ceil, jnp.square, jnp.cbrt, jnp.isfinite, jnp.isnan, jnp.negative, jnp.exp2, jnp.nan_to_num),
    *(jnp.arcsinh, jnp.round, jax.lax.round, jax.lax.logistic, jax.lax.erf, jax.lax.erfc, lambda x: jnp.arccosh(1 + x * x)),
)
OF_PARTS = (jnp.sqrt, jnp.log, jnp.log2, jnp.log1p, jnp.arcsin, jnp.arccos, jnp.arctanh, jax.lax.rsqrt)
TWO_ARGUMENTS = (
    *(jnp.add, jnp.subtract, jnp.multiply, jnp.divide, jnp.maximum, jnp.minimum, jnp.arctan2, jnp.fmod, jnp.hypot, jnp.power),
    *(jnp.nextafter, jnp.equal, jnp.not_equal, jnp.less, jnp.less_equal, jnp.greater, jnp.greater_equal),
)


@jax.custom_batching.custom_vmap
def _by_rows(row):
    return jnp.sin(row) + row


@_by_rows.def_vmap
def _(axis_size, batched, rows):
    del axis_size, batched
    return jax.lax.map(_by_rows, rows), True


SHAPED = {
    "sums": lambda x, k: (x.sum(), x.sum(0), x.prod(1), x.max(0), x.min(1), k.sum(1)),
    "of nothing": lambda x, k: (x[:0].sum(0), x[:0].prod(0), jax.lax.reduce_max(x[:0], (0,)), jax.lax.reduce_min(x[:, :0], (1,))),
    "any and all": lambda x, k: ((x > 0).any(0), (x > -1).all(1)),
    "places": lambda x, k: (x.argmax(0), x.argmin(1), jnp.argsort(x, 1), jnp.sort(x, 0), jnp.flatnonzero(x > 0, size=9)),
    "places of NaN": lambda x, k: (jnp.where(x > 0, jnp.nan, x).argmax(1), jnp.where(x > 0, jnp.nan, x).max(0)),
    "cumulative": lambda x, k: (x.cumsum(0), x.cumprod(1), jax.lax.cummax(x, 0), jax.lax.cumsum(x, 1, reverse=True), k.cumsum(0)),
    "shapes": lambda x, k: (x.T, x.reshape(2, 10), x[:, None], jnp.flip(x, 1), jnp.tile(x, (2, 3)), jnp.squeeze(x[:1])),
    "parts": lambda x, k: (x[1:3, ::2], x[-1], *jnp.split(x, [1, 3], axis=1), jnp.concatenate([x, x + 1], 1), jnp.stack([x, x])),
    "padded": lambda x, k: (
        jnp.pad(x, ((1, 2), (0, 3))),
        jax.lax.pad(x, 7.0, ((1, -1, 2), (-2, 1, 0))),
        jax.lax.pad(x, 0.0, ((-1, -1, 1), (3, -4, 1))),
    ),
    "gathered": lambda x, k: (
        x[k[0] % 4],
        x[k[:, :4] % 4, k[:, 1:] % 5],
        x.at[9].get(mode="fill", fill_value=3.0),
        x[:, k[0, 0]],
    ),
    "taken": lambda x, k: (jnp.take(x, k, axis=1, mode="fill"), jnp.take(x, k, axis=0, mode="clip"), x[k[0, 2]]),
    "taken along": lambda x, k: jnp.take_along_axis(x, k % 5, axis=1),
    "whole numbers": lambda x, k: (
        k // 2,
        k % 3,
        k * k,
        -k,
        k**2,
        jnp.abs(k),
        k & 5,
        k | 2,
        k ^ 1,
        ~k,
        k << 2,
        k >> 1,
        k.astype(float),
        k > 1,
    ),
    "shifted": lambda x, k: (k << 2, k >> 1),
    "rounded": lambda x, k: (x.astype(int), x.astype(bool), x.astype(jnp.float32), k.astype(jnp.int32).sum(), jnp.round(x, 1)),
    "changed": lambda x, k: (
        x.at[1].set(0.0),
        x.at[k[0] % 4].add(1.0),
        x.at[jnp.array([1, 9, 2])].set(5.0, mode="drop"),
        x.at[:, 2].mul(3.0),
        x.at[1:3, 2:].set(x[:2, :3]),
        x.at[jnp.array([1, 1, 3])].max(0.5),
    ),
    "moved": lambda x, k: (
        jax.lax.dynamic_slice(x, (k[0, 2], 1), (2, 3)),
        jax.lax.dynamic_update_slice(x, x[:2, :2] * 9, (k[0, 0], k[0, 1])),
        jax.lax.dynamic_index_in_dim(x, k[0, 3]),
    ),
    "products": lambda x, k: (
        x @ x.T,
        x.T @ x[:, 0],
        jnp.einsum("ij,kj->ik", x, x),
        jnp.einsum("ij,ij->j", x, x),
        jnp.outer(x, x),
    ),
    "batched products": lambda x, k: jnp.einsum("bij,bjk->bik", x.reshape(2, 2, 5), x.reshape(2, 5, 2)),
    "chosen": lambda x, k: (
        jnp.where(x > 0, x, 0.0),
        jax.lax.select_n(k % 3, x, x + 1, x + 2),
        jnp.select([x > 1, x > 0], [x, -x]),
    ),
    "clipped": lambda x, k: (jnp.clip(x, -1, 0.5), jax.lax.clamp(-1.0, x, 1.0)),
    "solved": lambda x, k: (
        jnp.linalg.solve(x[:, :4] + 3 * jnp.eye(4), x[:, 4]),
        jnp.linalg.inv(x[:, :4] + 3 * jnp.eye(4)),
        jnp.linalg.svd(x, full_matrices=False)[1],
        jnp.linalg.pinv(x),
        jnp.linalg.det(x[:, :4]),
    ),
    "searched": lambda x, k: (jnp.searchsorted(jnp.sort(x[0]), x[1]), jnp.interp(x[1], jnp.sort(x[0]), x[2])),
    "made": lambda x, k: (jnp.eye(3), jnp.arange(4.0), jnp.full((2, 2), x[0, 0]), jnp.linspace(0.0, x[0, 0], 5)),
    "loop": lambda x, k: jax.lax.while_loop(lambda s: s[0] < x[0, 0] + 9, lambda s: (s[0] + 1, s[1] * x[0, 1]), (0.0, x)),
    "scan": lambda x, k: jax.lax.scan(lambda c, row: (c + row, c * row), x[0], x, reverse=True),
    "counted": lambda x, k: jax.lax.fori_loop(0, k[0, 0], lambda i, c: c + x[i], x[0]),
    "branches": lambda x, k: (
        jax.lax.cond(x[0, 0] > 0, jnp.sin, jnp.cos, x),
        jax.lax.switch(k[0, 2], [jnp.sin, jnp.cos, lambda x: x * 2], x),
    ),
    "mapped": lambda x, k: (
        jax.vmap(lambda r: r / r.sum())(x),
        jax.lax.map(lambda r: r.sum(), x),
        jax.vmap(jnp.searchsorted)(x, x),
    ),
    "derivatives": lambda x, k: (
        jax.grad(lambda x: jnp.sum(jnp.sin(x) * x[k[0] % 4].sum()))(x),
        jax.jacfwd(lambda r: jnp.linalg.solve(jnp.diag(r) + 5, r))(x[0]),
        jax.grad(lambda x: jnp.linalg.norm(x @ x.T))(x),
    ),
    "one after another": lambda x, k: jax.vmap(_by_rows)(x),
    "remembered": lambda x, k: jax.grad(lambda x: jax.checkpoint(jnp.sin)(x).sum())(x),
    "order of zeros": lambda x, k: jnp.searchsorted(jnp.array([-1.0, -0.0, 0.0, jnp.nan]), jnp.array([0.0, -0.0, jnp.nan, 9.0])),
}


def _agree(function, *arguments):
    """Compare with XLA: values up to rounding, shapes and types exactly."""
    program = jax.jit(function).trace(*arguments).jaxpr
    with np.errstate(all="ignore"):
        found = numpy_program(program)(Meter(10**6), [np.asarray(x) for x in arguments])
    expected = jax.tree.leaves(jax.jit(function)(*arguments))
    assert len(found) == len(expected)
    for x, y in zip(found, expected, strict=True):
        assert np.shape(x) == y.shape
        assert np.asarray(x).dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-13)


def test_functions_of_one_and_of_two_arrays_are_those_of_xla():
    _agree(lambda x, y: [*(f(x) for f in ONE_ARGUMENT), *(f(y) for f in OF_PARTS)], X, Y)
    _agree(lambda x, y: [f(x, y) for f in TWO_ARGUMENTS if f is not jnp.power], X, Y)
    _agree(lambda x, y: [jnp.power(y, x), x**3, x**-2, 2.0 / x, x % y], X, Y)
    _agree(lambda b: [b & ~b, b | b, b ^ b, jnp.logical_not(b), b.sum(), b.astype(float)], B)


def test_what_is_not_finite_stays_so():
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0])
    _agree(lambda x: [jnp.sqrt(x), 1 / x, x - x, jnp.log(x), jnp.max(x), jnp.min(x), jnp.sign(x), jnp.maximum(x, 0), x < 1], odd)


@pytest.mark.parametrize("name", SHAPED)
def test_operations_on_shapes_are_those_of_xla(name):
    _agree(SHAPED[name], X, K)


def _count(function, *arguments):
    meter = Meter(10**6)
    numpy_program(jax.jit(function).trace(*arguments).jaxpr)(meter, [np.asarray(x) for x in arguments])
    return meter.count


def test_constants_are_computed_once_and_calls_are_no_operations():
    """A trace repeats the arithmetic of constants, and calls functions that JAX has compiled."""

    def scaled(x):
        return jax.jit(lambda x: jax.lax.stop_gradient(jnp.sum(2.0 * jnp.sqrt(jnp.arange(5.0))) * jax.jit(jnp.sin)(x)))(x)

    assert _count(scaled, X) == 2  # the sine, and the product
    assert_allclose(numpy_program(jax.jit(scaled).trace(X).jaxpr)(Meter(10), [X])[0], scaled(X), rtol=1e-15)


def test_the_same_operations_are_evaluated_once_and_unused_ones_never():
    """Functions that compute the same are traced anew at each call, with all they call."""

    def slopes(x):
        return jax.jacfwd(lambda x: jnp.sin(x) * jnp.sum(x[K[0] % 4] ** 2))(x)

    def again(x):
        unused = jnp.linalg.svd(slopes(x) + 1.0)
        return (slopes(x) + 0.0 * slopes(x)) * jnp.where(x > 0.0, 2.0, 2.0), unused[0].shape[0]

    _agree(lambda x: again(x)[0], X[0, :4])
    _agree(lambda x: (jnp.zeros(3).at[0].set(x[0]), jnp.zeros(3).at[1].set(x[0]), -0.0 * x, 0.0 * x, 0 * x), X[0])
    assert _count(lambda x: again(x)[0], X[0, :4]) <= _count(slopes, X[0, :4]) + 10


@pytest.fixture
def programs():
    """Note the programs that are compiled because they have often been called."""
    with calls_of(_compiled) as compiled:
        yield compiled


def _bend(x, power):
    return jax.lax.while_loop(lambda s: s[1] < 5, lambda s: (jnp.sin(s[0]) * x, s[1] + 1), (x**power, 0))[0]


def test_derivatives_and_batches_are_those_of_the_function(programs):
    by_numpy, x = deferred(_bend), X[0]
    along = lambda f: jax.jvp(lambda x: f(x, 2), (x,), (x * 0 + 1.0,))  # noqa: E731
    np.testing.assert_allclose(along(by_numpy), along(_bend), rtol=1e-13)
    np.testing.assert_allclose(jax.vmap(lambda x: by_numpy(x, 3))(X), jax.vmap(lambda x: _bend(x, 3))(X), rtol=1e-13)
    curve = lambda x, c: jax.lax.scan(lambda s, r: (jnp.sin(s) * r, s * r), x, c * x[None])[0].sum()  # noqa: E731
    late = deferred(curve)
    for make in (jax.grad, jax.hessian, jax.jacfwd, lambda f: jax.grad(f, 1), lambda f: jax.grad(jax.checkpoint(f))):
        np.testing.assert_allclose(make(late)(x, X), make(curve)(x, X), rtol=1e-12)
        np.testing.assert_allclose(jax.jit(make(late))(x, X), make(curve)(x, X), rtol=1e-12)
    assert not programs


@pytest.mark.skipif(deferred_p is None, reason="this JAX compiles what is called once, too")
def test_what_is_called_often_or_takes_long_is_compiled(programs):
    few = deferred(lambda x: jnp.sin(x) + x)
    for _ in range(WORTH_COMPILING):
        few(1.5 * jnp.ones(()))
    assert not programs
    for _ in range(5):
        found = few(1.5 * jnp.ones(()))
    assert len(programs) == 1
    np.testing.assert_allclose(found, np.sin(1.5) + 1.5, rtol=1e-15)
    count = WORTH_COMPILING * 4
    long = deferred(lambda x: jax.lax.fori_loop(0, count, lambda i, s: s + 1.0, x))
    assert long(jnp.zeros(())) == count
    assert len(programs) == 2


def test_static_parts_and_trees_come_through():
    found = deferred(lambda tree, name, **more: {"sum": tree["a"] + more["b"], "name": name})(
        {"a": jnp.ones(2)}, "x", b=jnp.ones(2)
    )
    np.testing.assert_array_equal(found["sum"], [2.0, 2.0])
    assert found["name"] == "x"


@pytest.mark.skipif(deferred_p is None, reason="this JAX evaluates such a function operation by operation")
def test_concrete_numbers_among_traced_ones_stay_concrete_and_are_traced_once_for_their_content():
    seen = []

    @partial(deferred, keeps_concrete=True)
    def scaled(x, by, names):
        seen.append(by)
        if by[0] < 0:
            raise ValueError("by must not be negative")
        return {name: x * by[k] for k, name in enumerate(names)}, 2 * by

    by = np.array([2.0, 3.0])
    for turn in range(3):
        by = by.copy()
        slope = jax.grad(lambda x, by=by: scaled(x, by, ("a", "b"))[0]["b"])(1.0)
        found, known = jax.vmap(lambda x, by=by: scaled(x, by, ("a", "b")), out_axes=(0, None))(X[0])
        assert slope == 3.0 and np.array_equal(found["a"], 2 * X[0]) and isinstance(known, np.ndarray)
        assert len(seen) <= 2, f"traced again in turn {turn}"  # a batch's number is no weak one, as Python's is
    assert jax.grad(lambda x: scaled(x, np.array([2.0, 4.0]), ("a", "b"))[0]["b"])(1.0) == 4.0
    assert jax.jit(lambda x: scaled(x, by, ("a",))[0]["a"])(X[0]).tolist() == (2 * X[0]).tolist()
    with pytest.raises(ValueError, match="must not be negative"):
        jax.grad(lambda x: scaled(x, -by, ("a",))[0]["a"])(1.0)
    assert scaled(1.0, by, ("a",))[0]["a"] == 2.0


def test_loops_of_a_batch_end_one_by_one():
    """Under `vmap` each member has its own loop condition, and stays the same once its loop has ended."""

    def halve(x, y):
        return jax.lax.while_loop(lambda state: state[0] > 1.0, lambda state: (0.5 * state[0], state[1] + x * y), (x, y))

    x, y = np.array([0.3, 7.0, 40.0]), np.arange(6.0).reshape(3, 2)
    program = jax.jit(jax.vmap(halve)).trace(x, y).jaxpr
    for one, other in zip(numpy_program(program)(Meter(np.inf), [x, y]), jax.jit(jax.vmap(halve))(x, y), strict=True):
        np.testing.assert_allclose(one, other)
