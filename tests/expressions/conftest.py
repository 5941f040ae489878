"""Functions as programs: they are traced, read into a graph, and emitted."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.expressions import Graph, ScalarProgram, trace


class Emitted(NamedTuple):
    program: ScalarProgram
    shapes: list[tuple[int, ...]]

    def __call__(self, *arguments: Any) -> tuple[Any, ...]:
        """Call the program with arrays, like the function itself."""
        return self.shaped(self.program([a[place] for a in map(jnp.asarray, arguments) for place in np.ndindex(*a.shape)]), jnp)

    def on_floats(self, *arguments: Any) -> tuple[Any, ...]:
        """Call the program with Python numbers."""
        return self.shaped(self.program([x.item() for a in arguments for x in np.asarray(a).flat]), np)

    def shaped(self, outputs: list[Any], xp: Any) -> tuple[Any, ...]:
        results, start = [], 0
        for shape in self.shapes:
            size = int(np.prod(shape))
            part = [xp.asarray(x) for x in outputs[start : start + size]]
            results.append(xp.stack(part).reshape(shape) if part else xp.zeros(shape))
            start += size
        return tuple(results)


def emit_function(function: Callable, *examples: Any) -> Emitted:
    """Make every element of the array arguments one input, and every element of the result one output."""
    examples = tuple(jnp.asarray(e) for e in examples)
    graph = Graph()
    inputs = []
    for k, example in enumerate(examples):
        array = np.empty(example.shape, object)
        for place in np.ndindex(*example.shape):
            array[place] = graph.input((k, place), "argument", example.dtype)
        inputs.append(array)
    outputs = trace(lambda *a: jax.tree.leaves(function(*a)), *examples)(graph, *inputs)
    program = ScalarProgram(graph, [s for a in inputs for s in a.flat], [s for o in outputs for s in o.flat])
    return Emitted(program, [o.shape for o in outputs])


@pytest.fixture
def emit() -> Callable[..., Emitted]:
    return emit_function


@pytest.fixture
def graph():
    return Graph()


@pytest.fixture
def xyz(graph):
    return [graph.input(name, "state") for name in "xyz"]
