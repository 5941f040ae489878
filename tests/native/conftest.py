"""Functions as machine code, called with arrays; and trajectories by it, for comparison with another engine."""

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import pytest

from tests.quick_code import optimize
from udkjax.expressions import Graph, ScalarProgram, trace
from udkjax.native.code import machine, processor
from udkjax.native.language.ir import POINTER, Function
from udkjax.native.language.program import write
from udkjax.native.language.text import text_of_module

WIDTHS = sorted({1, 2, processor.lanes()})


def loaded(*functions: Function, globals: Sequence[str] = ()) -> Callable[..., None]:
    """Compile functions; return the last one, to be called with arrays, integers and numbers."""
    last = functions[-1]
    library = machine.Library([machine.compile_module(text_of_module(functions, globals))], [last.name])
    kinds = {POINTER: ctypes.c_void_p, "i64": ctypes.c_int64, "double": ctypes.c_double}
    run = machine.function(library[last.name], *(kinds[x.base] for name, x in last.given.items() if name != "block_memory"))

    def call(*arguments: Any, _alive: Any = library):
        assert all(a.flags.c_contiguous for a in arguments if isinstance(a, np.ndarray))
        run(*(a.ctypes.data if isinstance(a, np.ndarray) else a for a in arguments))

    return call


@pytest.fixture(scope="module", autouse=True)
def optimized_code():
    """Require optimized code, which is what users run."""
    optimize(True)
    yield
    optimize(False)


@pytest.fixture(scope="session")
def code():
    return loaded


@pytest.fixture(params=[pytest.param(w, id=f"{w} lanes", marks=[pytest.mark.slow] * (w == 2 < WIDTHS[-1])) for w in WIDTHS])
def width(request):
    return request.param


def as_machine_code(function: Callable, width: int, *examples: Any) -> Callable[..., np.ndarray]:
    """A function of numbers as machine code, applied to arrays: (outputs, samples); conditions become zeros and ones."""
    examples = tuple(np.asarray(e) for e in examples)
    graph = Graph()
    inputs = [graph.input(k, "argument", e.dtype) for k, e in enumerate(examples)]
    arrays = []
    for s in inputs:
        array = np.empty((), object)
        array[()] = s
        arrays.append(array)
    found = trace(lambda *a: jax.tree.leaves(function(*a)), *examples)(graph, *arrays)
    outputs = [s for o in found for s in o.flat]
    program = ScalarProgram(graph, inputs, outputs)
    places = [("x", k) for k in range(len(inputs))], [("y", k) for k in range(len(outputs))]
    run = loaded(write(program, "program", width, ("x", "y"), *places))

    def on(*samples: np.ndarray) -> np.ndarray:
        x = np.stack([np.asarray(s, float) for s in np.broadcast_arrays(*samples)])
        count = x.shape[1]
        padded = np.concatenate([x, np.repeat(x[:, -1:], -count % width, axis=1)], axis=1)
        y = np.empty((len(outputs), padded.shape[1]))
        for k in range(0, padded.shape[1], width):
            out = np.full((len(outputs), width), np.nan)
            run(np.ascontiguousarray(padded[:, k : k + width]), out)
            y[:, k : k + width] = out
        return y[:, :count]

    return on


@pytest.fixture(scope="session")
def on_machine():
    return as_machine_code
