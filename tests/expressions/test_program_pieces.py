"""The pieces of a long program compute what the program computes, in the order in which inputs and outputs may share places."""

import numpy as np
import pytest

from udkjax.expressions import Graph, Scalar, ScalarProgram
from udkjax.expressions.scalars.program_pieces import pieces_of
from udkjax.expressions.scalars.selection import greater, where


def random_program(rng, count):
    """Return a program of arithmetic, functions and conditions, whose nodes are read soon or much later."""
    graph = Graph()
    values = [graph.input(("x", k), "x") for k in range(4)]
    inputs = list(values)
    for _ in range(count):
        a, b = (values[int(i)] for i in rng.integers(max(len(values) - 30, 0), len(values), 2))
        c = values[int(rng.integers(len(values)))]
        kind = int(rng.integers(5))
        new = (a + 0.5 * c, a * b - c, where(greater(a, b), c, a - b), a / (c * c + 2.0), -a * 0.3 + 1.5)[kind]
        values.append(graph.sqrt(new * new + 1.0) if rng.random() < 0.1 else new)
    return ScalarProgram(graph, inputs, [*values[-3:], values[5], inputs[1], graph.constant(2.0), -values[count // 2]])


@pytest.mark.parametrize("longest", [1, 7, 60, 10_000])
def test_pieces_compute_the_program(longest):
    rng = np.random.default_rng(longest)
    program = random_program(rng, 300)
    late = {0, 3}
    pieces, size = pieces_of(program, late, longest)
    x = rng.uniform(0.5, 1.5, 4).tolist()
    nodes, memory, found = program.graph.nodes, {}, {}
    given = {s.index: value for s, value in zip(program.inputs, x, strict=True)}
    one = lambda index, values: ScalarProgram(program.graph, list(values), [Scalar(program.graph, index)])  # noqa: E731
    for k, piece in enumerate(pieces):
        assert len(piece.order) <= longest + sum(nodes[i].kind == "constant" for i in piece.order)
        values = {i: given[i] for i in piece.inputs} | {i: memory[place] for i, place in piece.received.items()}
        for index in piece.order:
            scalars = {Scalar(program.graph, i): v for i, v in values.items()}
            values[index] = one(index, scalars)(list(scalars.values()))[0]
        for index, place in piece.passed.items():
            assert place < size
            memory[place] = values[index]
        for j in piece.outputs:
            assert j not in late or k == len(pieces) - 1
            found[j] = program.outputs[j].sign * values[program.outputs[j].index]
    assert [found[k] for k in range(len(program.outputs))] == program(x)
