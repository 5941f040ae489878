"""Everything that JAX can trace becomes a program with the same results: on floats, under jit and vmap, and differentiated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.choices import fast
from tests.fresh_process import python
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import defined


@jax.custom_jvp
def _doubled(x):
    return 2.0 * x


_doubled.defjvp(lambda primals, tangents: (_doubled(*primals), 7.0 * tangents[0]))  # wrong on purpose, to recognize the rule


def _switch(x, y):
    return lax.switch(jnp.where(x[0] > 0, 1, 0), [lambda a: a * a, jnp.sin], y)


def _scan(x, y):
    return lax.scan(lambda c, a: (c * a + 1.0, c - a), y[0], x)


FUNCTIONS = {
    # expanded: scalar operations only
    "arithmetic": lambda x, y: (x[0] - y[0]) / (1.0 + x[1] ** 2) - (y[1] - x[0]) * -x[2],
    "powers": lambda x, y: jnp.stack([x[0] ** 3, y[0] ** -2, x[1] ** 0, jnp.square(x[1])]),
    "real power": lambda x, y: jnp.abs(y) ** 1.5,
    "trigonometry": lambda x, y: jnp.sin(x) * jnp.cos(y) + jnp.arctan2(x, y) + jnp.tanh(x),
    "roots": lambda x, y: jnp.sqrt(1.0 + x * x) + lax.rsqrt(1.0 + y * y) + jnp.cbrt(y),
    "shapes": lambda x, y: jnp.concatenate([x[None], y.reshape(1, 3)], 0).T[::-1, 1:].ravel() * jnp.repeat(x[1:2], 3),
    "broadcasting": lambda x, y: x[:, None] * y[None, :] + jnp.ones((3, 1)),
    "axes of length one": lambda x, y: jnp.where(lax.ge_p.bind(x[None, :1], y[None]), x, y),
    "constant indices": lambda x, y: x[jnp.array([2, 0, 0])] * y[np.array([1, 1, 2])],
    "known places": lambda x, y: x.at[1].set(y[0]).at[jnp.array([2, 0])].set(y[1:]),
    "a known slice": lambda x, y: lax.dynamic_update_slice(jnp.outer(x, x), y[None, 1:], (1, 0)),
    "dot": lambda x, y: jnp.dot(x, y),
    "matmul": lambda x, y: jnp.outer(x, y) @ jnp.outer(y, x),
    "einsum": lambda x, y: jnp.einsum("ij,ik->ijk", jnp.outer(x[:2], x[:2]), y[:2, None]),
    "where": lambda x, y: jnp.where(x > y, x * y, x - y),
    "where of known": lambda x, y: jnp.where(jnp.array([True, False, True]), x, y),
    "clip": lambda x, y: jnp.clip(x, -0.5, 0.5) + jnp.maximum(x, y) - jnp.minimum(x, 0.0),
    "mean": lambda x, y: jnp.mean(x) + jnp.var(y),
    "nested jit": lambda x, y: jax.jit(lambda a: jax.jit(jnp.sin)(a) * a)(x) + y,
    "deferred": lambda x, y: deferred(lambda a: deferred(jnp.cos)(a) * a)(x) + y,
    "custom_jvp": lambda x, y: _doubled(x) + jax.nn.relu(y) + jax.nn.silu(x),
    "checkpoint": lambda x, y: jax.checkpoint(lambda a: jnp.sin(a) * y)(x),
    "derivative": lambda x, y: jax.jacfwd(lambda a: jnp.sin(a) * y[0])(x),
    "derivative that may be undefined": lambda x, y: jax.jacfwd(defined(lambda a: jnp.sin(a) * y[0]))(x),
    "gradient that may be undefined": lambda x, y: jax.grad(lambda a: defined(lambda b: jnp.sin(b) * y[0])(a).sum())(x),
    "stack": lambda x, y: jnp.stack([x, y], axis=1),
    "iota": lambda x, y: x * jnp.arange(3.0),
    "no argument at all": lambda x, y: jnp.ones(2),
    # with opaque nodes
    "cond": lambda x, y: lax.cond(x[0] > 0, lambda a, b: a * b, lambda a, b: a + b, x, y),
    "switch": _switch,
    "scan": _scan,
    "long loop": lambda x, y: lax.fori_loop(0, 20_001, lambda k, a: 0.5 * a + y[0], x),
    "fori_loop": lambda x, y: lax.fori_loop(0, 3, lambda k, a: jnp.sin(a) + k * y, x),
    "gather": lambda x, y: x[jnp.where(y > 0, 2, 1)],
    "dynamic slice": lambda x, y: lax.dynamic_slice(x, (jnp.where(y[0] > 0, 1, 0),), (2,)),
    "interpolation": lambda x, y: jnp.interp(x[0], jnp.array([-2.0, 0.0, 3.0]), y),
    "product and maximum": lambda x, y: jnp.prod(x) + jnp.max(y),
    "running sums": lambda x, y: jnp.cumsum(x) * y + jnp.cumprod(y),
    "linear system": lambda x, y: jnp.linalg.solve(jnp.diag(2.0 + x * x) + 0.1 * jnp.outer(x, y), y),
    "scatter": lambda x, y: x.at[1].set(y[0]).at[jnp.array([0, 2])].add(y[1]),
    "pad": lambda x, y: jnp.pad(x, (1, 2)) * y[0],
    "sort": lambda x, y: jnp.sort(x) * y,
    "argsort": lambda x, y: y[jnp.argsort(x)[0]] + jnp.sort(jnp.outer(x, y), axis=0, descending=True)[0],
    "extremes": lambda x, y: (
        x[jnp.argmax(y)] * y[jnp.argmin(x)] + lax.cummax(x)[::-1] + jnp.where(jnp.any(x > 1) & jnp.all(y < 1), 1, 2)
    ),
    "median": lambda x, y: jnp.median(x) + jnp.select([x < 0, x < 1], [x, x * y], y),
    "whole numbers": lambda x, y: x * jnp.sum(jnp.where(y > 0, 1, 2)),
    "inverse": lambda x, y: jnp.linalg.inv(jnp.outer(x, y) + jnp.diag(y)[::-1]) @ x,
    "determinants": lambda x, y: jnp.stack([jnp.linalg.det(jnp.outer(x, y) + A) for A in (jnp.eye(3), jnp.eye(3)[::-1])]),
    "determinant of four rows": lambda x, y: jnp.linalg.det(jnp.eye(4)[::-1].at[1:, 1:].add(jnp.outer(x, y))),
    "large linear system": lambda x, y: jnp.linalg.solve(jnp.diag(jnp.arange(1.0, 10.0)).at[:3, 0].add(x), jnp.ones(9)) * y[0],
    "norm": lambda x, y: jnp.linalg.norm(x) * jnp.hypot(y[0], y[1]),
}
CHOICES = [
    "cond",
    "switch",
    "gather",
    "dynamic slice",
    "interpolation",
    "product and maximum",
    "running sums",
    "sort",
    "argsort",
    "extremes",
    "median",
    "linear system",
    "inverse",
    "determinants",
    "determinant of four rows",
]
ELEMENTWISE = list(FUNCTIONS)[: list(FUNCTIONS).index("cond")]
SLOW = "inverse", "determinants", "determinant of four rows", "large linear system"  # as "linear system"
X, Y = np.array([0.3, -0.7, 1.1]), np.array([0.5, 0.9, -0.4])
XS, YS = np.stack([X, -X, X[::-1]]), np.stack([Y, Y + 0.2, -Y])


def close(found, expected):
    expected = jax.tree.leaves(expected)
    assert len(found) == len(expected)
    for f, e in zip(found, expected, strict=True):
        assert np.shape(f) == np.shape(e)
        np.testing.assert_allclose(f, e, rtol=1e-12, atol=1e-13)


@pytest.fixture(params=fast([name for name in FUNCTIONS if name not in SLOW], FUNCTIONS), scope="module")
def function(request):
    return request.param, FUNCTIONS[request.param]


def test_read(function, emit):
    name, f = function

    def total(outputs):
        return sum(jnp.sum(jnp.asarray(o, float) ** 2) for o in jax.tree.leaves(outputs))

    def point(g, x, y):  # one elementwise function is differentiated: its program consists of JAX operations
        slope = jax.grad(lambda x, y: total(g(x, y)), argnums=(0, 1))
        return g(x, y), slope(x, y) if name not in ELEMENTWISE or name == "arithmetic" else ()

    program = emit(f, X, Y)
    if name == "custom_jvp":  # the rule belongs to a derivative that is traced; of the program the body counts
        f = lambda x, y: 2.0 * x + jax.nn.relu(y) + jax.nn.silu(x)  # noqa: E731
    found, expected = jax.jit(jax.vmap(lambda x, y: (point(program, x, y), point(f, x, y))))(XS, YS)
    close(jax.tree.leaves(found), expected)
    close(program.on_floats(X, Y), [x[0] for x in jax.tree.leaves(expected[0])])  # the first of the batch
    by_numpy = program.program.by_numpy([*XS.T, *YS.T])
    close([np.stack(by_numpy, 1)], [np.concatenate([np.reshape(x, (3, -1)) for x in jax.tree.leaves(expected[0])], 1)])


def test_branches_and_steps_of_values_that_are_not_finite(emit):
    """NumPy agrees with JAX, and so do floats, for which Python's operations raise."""
    program = emit(lambda x: jnp.stack([jnp.where((x[0] > 0) & (x[1] < 2), 1 / x[0], jnp.floor(x[1])), jnp.abs(x[0])]), X[:2])
    rows = np.array([[0.0, 1.5], [0.5, -0.5], [np.nan, -np.inf], [0.5, 2.5], [1e-320, np.nan], [np.inf, 0.0]])
    expected = [[1.0, 0.0], [2.0, 0.5], [-np.inf, np.nan], [2.0, 0.5], [np.nan, 1e-320], [0.0, np.inf]]
    np.testing.assert_array_equal(np.stack(program.program.by_numpy([*rows.T]), 1), expected)
    np.testing.assert_array_equal([np.ravel(program.on_floats(row)) for row in rows], expected)


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_elementwise_functions_have_no_calls(name, emit):
    assert not [node for node in emit(FUNCTIONS[name], X, Y).program.graph.nodes if node.kind == "call"]


@pytest.mark.parametrize("name", CHOICES)
def test_choices_are_written_out(name, emit):
    """A branch, an unknown index and sorting become comparisons and choices between scalars."""
    assert not [node for node in emit(FUNCTIONS[name], X, Y).program.graph.nodes if node.kind == "call"]


def test_a_loop_that_ends_after_a_known_number_of_turns_is_unrolled(emit):
    """One whose end depends on numbers of the state is opaque."""

    def count(limit, x, y):
        return lax.while_loop(lambda s: s[0] < limit(s[1]), lambda s: (s[0] + 1, jnp.sin(s[1]) + y), (0, x))[1]

    for limit, is_known in ((lambda x: 4, True), (lambda x: jnp.where(x[0] < 0.8, 4, 2), False)):
        program = emit(lambda x, y, limit=limit: count(limit, x, y), X, Y)
        assert is_known == (not [node for node in program.program.graph.nodes if node.kind == "call"])
        close(program(X, Y), count(limit, X, Y))


def test_a_branch_with_an_opaque_node_is_opaque_itself(emit):
    """A loop in a branch that is not taken might never end."""
    halve = lambda a: lax.while_loop(lambda a: a > 1.0, lambda a: 0.5 * a, a)  # noqa: E731
    program = emit(lambda x: lax.cond(x[0] > 0.0, halve, jnp.sin, x[1]), X)
    assert [n.detail.primitive.name for n in program.program.graph.nodes if n.kind == "call"][-1] == "cond"
    np.testing.assert_allclose(program(X), [halve(X[1])])


@pytest.mark.parametrize("name", ["long loop", "large linear system"])
def test_what_does_neither_is_opaque(name, emit):
    """A long loop or a factorization becomes one node, instead of a node for each of its steps."""
    assert [node for node in emit(FUNCTIONS[name], X, Y).program.graph.nodes if node.kind == "call"]


def test_a_traced_derivative_uses_its_own_rule(emit):
    program = emit(lambda x: jax.jvp(_doubled, (x,), (jnp.ones(()),)), 3.0)
    assert [float(o) for o in program(3.0)] == [6.0, 7.0]


def test_known_arrays_are_computed_without_jax(emit, monkeypatch):
    """Identity matrices, comparisons of indices and padding, each of which JAX would compile; sines are those of JAX."""
    function = lambda x: jnp.pad(x * (jnp.eye(3) - jnp.tri(3)), ((0, 1), (1, 0))) + jnp.arange(4) * x[0]  # noqa: E731
    expected = function(X)

    def refuse():
        raise AssertionError("JAX computes a constant")

    monkeypatch.setattr(jax, "ensure_compile_time_eval", refuse)
    close(emit(function, X)(X), expected)
    with pytest.raises(AssertionError, match="JAX computes"):
        emit(lambda x: x + jnp.sin(jnp.arange(3)), X)


def test_structural_zeros_of_a_derivative_vanish(emit):
    """d(x0 x1)/dx2 = 0 is known without a run, and so are the ones of the unit directions."""
    jacobian = emit(jax.jacfwd(lambda x: jnp.stack([x[0] * x[1], x[2]])), X).program
    assert [s.constant for s in jacobian.outputs] == [None, None, 0.0, 0.0, 0.0, 1.0]
    assert jacobian.count() == {}


def test_a_cosine_that_two_functions_use_is_one_node(emit):
    program = emit(lambda x: (jnp.cos(x[0]) * x[1], jnp.cos(x[0]) + x[2], jnp.cos(jnp.sum(x[:1]))), X).program
    assert program.count() == {"sincos": 1, "mul": 1, "add": 1}


def test_a_dot_product_with_known_zeros_is_short(emit):
    program = emit(lambda x: jnp.array([[0.0, 1.0, 0.0], [2.0, 0.0, -1.0]]) @ x, X).program
    assert program.count() == {"mul": 1, "sub": 1}


def test_equal_opaque_nodes_are_one(emit):
    root = lambda x: jnp.linalg.cholesky(jnp.outer(x, x) + jnp.eye(3))  # noqa: E731
    f = lambda x, y: (root(x), root(x)[0] * y)  # noqa: E731
    once, twice = emit(lambda x, y: f(x, y)[0], X, Y).program, emit(f, X, Y).program
    calls = lambda program: sum(program.graph.nodes[i].kind == "call" for i in program.order)  # noqa: E731
    assert calls(once) == calls(twice) > 0


def test_an_opaque_node_that_is_not_asked_for_is_not_emitted(emit):
    program = emit(lambda x, y: (jnp.linalg.cholesky(jnp.outer(x, x) + jnp.eye(3))[0], y * 2.0), X, Y)
    graph, outputs = program.program.graph, program.program.outputs
    later = type(program.program)(graph, program.program.inputs, outputs[3:])
    assert later.count() == {"mul": 3}


def test_whole_number_and_logical_arguments(emit):
    f = lambda x, k, flag: jnp.where(flag, x * k, x - k)  # noqa: E731
    arguments = (1.5, np.int32(3), np.bool_(True))
    (found,) = emit(f, *arguments)(*map(jnp.asarray, arguments))
    assert float(found) == 4.5


def test_single_precision_stays_single(emit):
    x = jnp.asarray(X, jnp.float32)
    (found,) = jax.jit(emit(lambda x: jnp.sin(x) * 2.0 + x @ x, x).__call__)(x)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, jnp.sin(x) * 2.0 + x @ x, rtol=1e-6)


def test_programs_without_double_precision_warn_of_nothing():
    """A run by diffrax traces its programs again and again; JAX warns of each double that it makes a single."""
    code = """
import warnings, jax, numpy as np, udkjax as udk
mech = udk.library.double_pendulum()
changed = lambda mass: mech.with_parameters({"body.upper.mass": mass})
run = lambda mass: udk.simulate(changed(mass), np.linspace(0.0, 0.1, 3), throw=False).q[-1, 0, 2]
with warnings.catch_warnings(record=True) as found:
    warnings.simplefilter("always")
    lowered = jax.jit(jax.jacfwd(run)).lower(np.float32(1.0))
others = {str(warning.message) for warning in found if not issubclass(warning.category, DeprecationWarning)}
print(lowered.out_info.dtype, *others)  # older Equinox uses what JAX deprecates
"""
    assert python(code, JAX_ENABLE_X64=0).strip() == "float32"
