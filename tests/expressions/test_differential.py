"""Derivatives of graphs: equal to those of JAX, forward and transposed, with shared expressions and nothing superfluous."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.expressions.test_read import FUNCTIONS as READ
from udkjax.expressions import Differential, Graph, ScalarProgram, cotangents, tangents, trace
from udkjax.expressions.algebra.differential import common_factors
from udkjax.expressions.algebra.node_derivatives import ActiveNodes

X, Y = np.array([0.3, -0.7, 1.1]), np.array([0.5, 0.9, -0.4])
FUNCTIONS = {
    "quotients": lambda x, y: (x[0] - y[0]) / (1.0 + x[1] ** 2) - (y[1] - x[0]) * -x[2] / y,
    "powers": lambda x, y: jnp.stack([x[0] ** 3, y[0] ** -2, x[1] ** 0, jnp.square(x[1]), jnp.abs(y[2]) ** 1.5]),
    "choice": lambda x, y: jnp.where(x > y, x * y, jnp.abs(x) - y) + jnp.clip(x, -0.5, 0.5) + jnp.maximum(x, y),
    "branch": lambda x, y: lax.cond(x[0] > 0, lambda a, b: a * b, lambda a, b: a + b, jnp.sin(x), y) * x,
    "loop": lambda x, y: lax.scan(lambda c, a: (c * a + 1.0, c - a), y[0] * y[1], jnp.sort(x)),
    "indices": lambda x, y: x[jnp.where(y > 0, 2, 1)] * jnp.interp(x[0], jnp.array([-2.0, 0.0, 3.0]), y),
    **{name: READ[name] for name in ("roots", "trigonometry", "no argument at all", "linear system", "scatter")},
}


@pytest.fixture(params=FUNCTIONS)
def function(request):
    return FUNCTIONS[request.param]


def test_forward_and_reverse_are_those_of_jax(function):
    graph = Graph()
    x, y = (np.array([graph.input((name, k), "state") for k in range(3)], object) for name in "xy")
    flat = lambda z: jnp.concatenate([jnp.ravel(o) for o in jax.tree.leaves(function(z[:3], z[3:]))])  # noqa: E731
    outputs = list(trace(lambda x, y: flat(jnp.concatenate([x, y])), jnp.asarray(X), jnp.asarray(Y))(graph, x, y)[0])
    inputs, at, random = [*x, *y], np.concatenate([X, Y]), np.random.default_rng(0)
    dots, weights = random.standard_normal(6), random.standard_normal(len(outputs))
    seeds = [graph.constant(d) for d in dots]
    found = ScalarProgram(graph, inputs, tangents(graph, outputs, dict(zip(inputs, seeds, strict=True))))([float(a) for a in at])
    by_jax = jax.jit(lambda z, d, w: (jax.jvp(flat, (z,), (d,))[1], jax.vjp(flat, z)[1](w)[0]))
    forward, reverse = by_jax(at, dots, weights)
    np.testing.assert_allclose(found, forward, rtol=1e-12, atol=1e-13)
    back = cotangents(graph, outputs, [graph.constant(w) for w in weights], inputs)
    np.testing.assert_allclose(ScalarProgram(graph, inputs, back)([float(a) for a in at]), reverse, rtol=1e-12, atol=1e-13)


def traced(function, graph, *scalars):
    (result,) = trace(function, *(0.0 for _ in scalars))(graph, *(np.asarray(s, object) for s in scalars))
    return result.item()


def test_what_has_no_seed_does_not_move(graph, xyz):
    x, y, z = xyz
    dx = graph.input("dx", "tangent")
    f, g = traced(lambda x, y, z: jnp.sin(y) * x + jnp.cos(z), graph, x, y, z), y * z
    df, dg = tangents(graph, [f, g], {x: dx})
    assert dg.is_zero
    assert ScalarProgram(graph, [x, y, z, dx], [df]).count() == {"sincos": 1, "mul": 1}
    assert tangents(graph, [f, g], {})[0].is_zero


def test_derivatives_are_the_nodes_of_the_function_where_they_can_be(graph, xyz):
    """When a vector is turned, the derivative of each component is the other one."""
    angle, x, y = xyz
    one = traced(lambda a, x, y: jnp.cos(a) * x - jnp.sin(a) * y, graph, angle, x, y)
    other = traced(lambda a, x, y: jnp.sin(a) * x + jnp.cos(a) * y, graph, angle, x, y)
    known = len(graph.nodes)
    differential = Differential(graph, [one, other], [angle])
    assert differential.row(one) == {angle.index: -other}
    assert differential.row(other) == {angle.index: one}
    new = {node.kind for node in graph.nodes[known:]} - {"constant"}
    assert new <= {"add", "sub"}  # on the way: none of them is part of a result
    assert not set(ScalarProgram(graph, xyz, [one, other]).order) - set(range(known))


def test_a_second_direction_takes_one_product_more(graph, xyz):
    x, y, z = xyz
    f = traced(lambda x, y, z: jnp.exp(jnp.sin(x * y) / z), graph, x, y, z)
    dots = [graph.input(k, "tangent") for k in range(3)]
    results = [tangents(graph, [f], {x: d})[0] for d in dots]
    counts = [sum(ScalarProgram(graph, [x, y, z, *dots], results[:k]).count().values()) for k in (1, 2, 3)]
    assert counts[1] == counts[0] + 1 and counts[2] == counts[0] + 2


def test_what_is_fixed_hides_what_it_is_made_of(graph, xyz):
    x, y, _ = xyz
    hidden = x * y
    f = hidden * x
    assert Differential(graph, [f], [x], fixed=[hidden]).row(f) == {x.index: hidden}
    assert Differential(graph, [f], [hidden], fixed=[x]).row(-f) == {hidden.index: -x}


def test_signs_of_seeds_and_inputs(graph, xyz):
    x, y, _ = xyz
    dx = graph.input("dx", "tangent")
    assert tangents(graph, [x * y], {-x: dx}) == [-(dx * y)]
    assert cotangents(graph, [-(x * y)], [dx], [-x]) == [dx * y]


def test_a_factor_that_a_column_has_in_common_is_taken_out(graph, xyz):
    x, y, z = xyz
    rows, factors = common_factors([{0: x * y, 1: x}, {0: -(z * y), 2: y * z}, {1: y, 2: z * x}])
    assert factors == {0: y, 2: z}
    assert rows == [{0: x, 1: x}, {0: -z, 2: y}, {1: y, 2: x}]
    assert common_factors([{0: x * y}, {0: y * z}], {(y * z).index}) == ([{0: x * y}, {0: y * z}], {})
    assert common_factors([{0: x * y}]) == ([{0: x * y}], {})


def node_by_node(graph, outputs, inputs):
    """Tangents of functions and cotangents of inputs, with seeds as inputs."""
    nodes = ActiveNodes(graph, outputs, inputs)
    dots = [graph.input(("d", k), "tangent") for k in range(len(inputs))]
    bars = [graph.input(("bar", k), "cotangent") for k in range(len(outputs))]
    return (nodes, [*inputs, *dots], nodes.push_forward(dots)), (nodes, [*inputs, *bars], nodes.pull_back(bars))


@pytest.mark.parametrize("name", ["quotients", "powers", "choice", "branch", "loop", "indices", "roots", "trigonometry"])
def test_passes_from_node_to_node_are_those_of_jax(name):
    """The way that takes fewer operations is chosen; here both passes are taken in any case, with inputs of either sign."""
    graph, function = Graph(), FUNCTIONS[name]
    given = [graph.input(k, "state") for k in range(6)]
    inputs = [-s if k % 2 else s for k, s in enumerate(given)]
    flat = lambda z: jnp.concatenate([jnp.ravel(o) for o in jax.tree.leaves(function(z[:3], z[3:]))])  # noqa: E731
    outputs = list(trace(flat, jnp.zeros(6))(graph, np.asarray(inputs, object))[0])
    random, at = np.random.default_rng(1), np.concatenate([X, Y])
    dots, weights = random.standard_normal(6), random.standard_normal(len(outputs))
    (_, forward, moved), (_, backward, pulled) = node_by_node(graph, outputs, inputs)
    signs = [s.sign for s in inputs]
    of_nodes = [float(a * sign) for a, sign in zip(at, signs, strict=True)]
    found = ScalarProgram(graph, [*given, *forward[6:]], moved)([*of_nodes, *dots.tolist()])
    np.testing.assert_allclose(found, jax.jvp(flat, (at,), (dots,))[1], rtol=1e-12, atol=1e-13)
    found = ScalarProgram(graph, [*given, *backward[6:]], pulled)([*of_nodes, *weights.tolist()])
    np.testing.assert_allclose(found, jax.vjp(flat, at)[1](weights)[0], rtol=1e-12, atol=1e-13)


def test_the_solution_of_a_sparse_system_is_not_differentiated_as_a_dense_matrix():
    """Derivatives of a bidiagonal solution by its right-hand side take as many operations as the solution."""

    def count(size):
        graph = Graph()
        below, b = ([graph.input((name, k), name) for k in range(size)] for name in ("below", "b"))
        x = [b[0]]
        for k in range(1, size):
            x.append(b[k] - below[k] * x[-1])
        for k in range(size - 2, -1, -1):
            x[k] = x[k] - below[k + 1] * x[k + 1]
        seeds = [graph.input(("seed", k), "tangent") for k in range(size)]
        found = tangents(graph, x, dict(zip(b, seeds, strict=True))), cotangents(graph, x, seeds, b)
        return [sum(ScalarProgram(graph, [*below, *seeds], outputs).count().values()) for outputs in found]

    assert count(20) == [4 * 19] * 2
    assert count(40) == [4 * 39] * 2
