"""Simplifications of a graph while it is built."""

import math
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from udkjax.expressions import Graph, Scalar, ScalarProgram


def operations(graph: Graph) -> list[str]:
    return [node.kind for node in graph.nodes if node.kind not in ("input", "constant")]


def test_zeros_vanish(graph, xyz):
    x, *_ = xyz
    zero = graph.constant(0.0)
    assert x + 0.0 == x == 0.0 + x
    assert x - 0.0 == x
    assert 0.0 - x == -x
    assert x * 0.0 == zero == 0.0 * x
    assert zero / x == zero
    assert (x - x).is_zero and (x + -x).is_zero
    assert graph.constant(-0.0) == zero == -zero
    assert operations(graph) == []


def test_ones_vanish_and_minus_one_is_a_sign(graph, xyz):
    x, *_ = xyz
    assert x * 1.0 == x == 1.0 * x
    assert x * -1.0 == -x
    assert x / 1.0 == x
    assert x / -1.0 == -x
    assert (x / x).constant == 1.0
    assert (x / -x).constant == -1.0
    assert operations(graph) == []


def test_constants_are_folded(graph):
    two, three = graph.constant(2.0), graph.constant(3.0)
    assert [(two + three).constant, (two - three).constant, (two * -three).constant] == [5.0, -1.0, -6.0]
    assert (-three / two).constant == -1.5
    assert graph.sqrt(graph.constant(9.0)).constant == 3.0
    assert operations(graph) == []


def test_division_of_constants_by_zero_is_left_to_the_run(graph):
    assert operations(graph) == [] and (graph.constant(1.0) / 0.0).constant is None
    assert operations(graph) == ["div"]


def test_a_minus_b_and_b_minus_a_and_its_negative_are_one_node(graph, xyz):
    x, y, _ = xyz
    difference = x - y
    assert y - x == -difference
    assert -(x - y) == -difference
    assert -y + x == difference
    assert operations(graph) == ["sub"]


def test_signs_cost_nothing(graph, xyz):
    x, y, _ = xyz
    negative = -x
    assert -negative == x
    assert -x - y == -(x + y)
    assert (-x) * y == -(x * y) == x * (-y)
    assert (-x) * (-y) == y * x
    assert (-x) / y == -(x / y) == x / (-y)
    assert operations(graph) == ["add", "mul", "div"]


def test_equal_expressions_are_one_node(graph, xyz):
    x, y, z = xyz
    assert x * y + z == z + y * x
    assert (x + y) * (x + y) == (y + x) * (y + x)
    assert graph.sqrt(x * y) == graph.sqrt(y * x)
    assert operations(graph) == ["mul", "add", "add", "mul", "sqrt"]


def test_twice_the_same_is_a_product(graph, xyz):
    x, *_ = xyz
    assert x + x == 2.0 * x
    assert -x - x == -2.0 * x
    assert operations(graph) == ["mul"]


def test_constants_of_both_signs_share_a_node(graph, xyz):
    x, *_ = xyz
    assert x * 3.0 == -(x * -3.0)
    assert [node.detail for node in graph.nodes if node.kind == "constant"] == [3.0]


def test_the_root_of_a_negative_is_another_node(graph, xyz):
    x, y, _ = xyz
    assert graph.sqrt(x - y) != graph.sqrt(y - x)


def test_inputs_are_told_apart_by_group_and_name(graph):
    assert graph.input(0, "value") != graph.input(0, "right")
    assert graph.input(0, "value") == graph.input(0, "value")


def test_what_a_node_depends_on(graph):
    m, q = graph.input("m", "parameter"), graph.input("q", "state")
    assert (m * 2.0).node.depends == {"parameter"}
    assert (m * q).node.depends == {"parameter", "state"}
    assert graph.constant(2.0).node.depends == frozenset()


def test_every_argument_comes_before_its_use(graph, xyz):
    x, y, z = xyz
    _ = graph.sqrt((x - y) * z / (y + 1.0)) - x * y
    for index, node in enumerate(graph.nodes):
        assert all(a.index < index for a in node.arguments)


def test_an_input_that_is_missing_is_named(graph, xyz):
    x, y, _ = xyz
    with pytest.raises(ValueError, match=r"not given.*'y'"):
        ScalarProgram(graph, [x], [x + y])


def test_what_is_not_asked_for_is_not_emitted(graph, xyz):
    x, y, z = xyz
    product, _ = x * y, graph.sqrt(z) / x
    program = ScalarProgram(graph, xyz, [product])
    assert program.count() == {"mul": 1}
    assert [program.uses(s) for s in xyz] == [True, True, False]
    assert program([2.0, 3.0, math.nan]) == [6.0]


# Random expressions: nested tuples (operation, operands), with leaves 0, 1, 2 (inputs) or a float.

_leaves = st.one_of(st.integers(0, 2), st.sampled_from([0.0, 1.0, -1.0, 2.0, -0.5]))
_trees = st.recursive(
    _leaves,
    lambda inner: st.one_of(
        st.tuples(st.sampled_from("+-*/"), inner, inner),
        st.tuples(st.just("neg"), inner),
        st.tuples(st.just("root"), inner),
    ),
    max_leaves=12,
)


def evaluated(tree: Any, leaf: Any, root: Any) -> Any:
    if not isinstance(tree, tuple):
        return leaf(tree)
    name, *operands = tree
    values = [evaluated(operand, leaf, root) for operand in operands]
    match name:
        case "+":
            return values[0] + values[1]
        case "-":
            return values[0] - values[1]
        case "*":
            return values[0] * values[1]
        case "/":
            return values[0] / values[1]
        case "neg":
            return -values[0]
    return root(values[0] * values[0] + 1.0)


def size(tree: Any) -> int:
    if not isinstance(tree, tuple):
        return 0
    return (3 if tree[0] == "root" else 1) + sum(map(size, tree[1:]))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(_trees, st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_simplified_expressions_have_the_same_value(tree, values):
    with np.errstate(all="ignore"):
        expected = evaluated(tree, lambda k: np.float64(values[k] if isinstance(k, int) else k), np.sqrt)
    if not np.isfinite(expected) or abs(expected) > 1e9:
        return  # 0 * x and x / x are simplified as if x were an ordinary number
    graph = Graph()
    inputs = [graph.input(k, "state") for k in range(3)]
    result = evaluated(tree, lambda k: inputs[k] if isinstance(k, int) else graph.constant(k), graph.sqrt)
    program = ScalarProgram(graph, inputs, [result])
    assert sum(program.count().values()) <= size(tree)
    try:
        (found,) = program([float(v) for v in values])
    except ZeroDivisionError:
        return
    assert found == pytest.approx(float(expected), rel=1e-9, abs=1e-9)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(_trees, _trees, st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_an_input_can_be_replaced_by_an_expression(tree, another, values):
    """The result is as if the expression had been used from the start."""
    graph = Graph()
    inputs = [graph.input(k, "state") for k in range(3)]
    built = lambda tree, inputs: evaluated(tree, lambda k: inputs[k] if isinstance(k, int) else graph.constant(k), graph.sqrt)  # noqa: E731
    whole, other = built(tree, inputs), built(another, inputs)
    same, program = {s.index: s for s in inputs}, ScalarProgram(graph, inputs, [whole, -whole])
    assert graph.copy(program, same) == [whole, -whole]
    replaced = graph.copy(program, same | {inputs[0].index: other})[:1]
    with np.errstate(all="ignore"):
        known = lambda k: np.float64(values[k] if isinstance(k, int) else k)  # noqa: E731
        first = evaluated(another, known, np.sqrt)
        expected = evaluated(tree, lambda k: first if k == 0 and isinstance(k, int) else known(k), np.sqrt)
        if not np.isfinite(expected) or abs(expected) > 1e9:
            return
        (found,) = ScalarProgram(graph, inputs, replaced)([np.float64(v) for v in values])
    assert found == pytest.approx(float(expected), rel=1e-9, abs=1e-9)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(_trees, _trees)
def test_no_operation_is_emitted_twice(first, second):
    graph = Graph()
    inputs = [graph.input(k, "state") for k in range(3)]
    leaf = lambda k: inputs[k] if isinstance(k, int) else graph.constant(k)  # noqa: E731
    results = [evaluated(tree, leaf, graph.sqrt) for tree in (first, second, first)]
    assert results[0] == results[2]
    assert -(results[0] - results[1]) == results[1] - results[0]
    program = ScalarProgram(graph, inputs, results)
    keys = [(n.kind, tuple((a.index, a.sign) for a in n.arguments), n.detail) for n in (graph.nodes[i] for i in program.order)]
    assert len(set(keys)) == len(keys)
    assert all(isinstance(s, Scalar) for s in results)


def test_threads_may_write_into_one_graph():
    """Sweeps compile their groups in threads, whose kernels may be of one cached element."""

    def write(graph: Graph) -> list[Scalar]:
        x = [graph.input(k, "q") for k in range(3)]
        return [(x[k % 3] + float(k)) * (x[(k + 1) % 3] - float(k)) for k in range(2_000)]

    before, graph = sys.getswitchinterval(), Graph()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(write, [graph] * 4))
    finally:
        sys.setswitchinterval(before)
    alone = Graph()
    assert len(graph.nodes) == len({tuple(node[:4]) for node in graph.nodes}) == [write(alone), len(alone.nodes)][1]
    assert all(a.index == b.index and a.node.kind == "mul" for other in found[1:] for a, b in zip(found[0], other, strict=True))
