"""Loops of a jaxpr whose number of iterations is known, unrolled while the jaxpr is read."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

Read: TypeAlias = Callable[[Any, Sequence[np.ndarray]], list[np.ndarray]]  # reads a jaxpr with these arguments
UNROLLED_OPERATIONS = 20_000  # maximum for an unrolled loop, over all its iterations: more take too long to compile


def unroll(read: Read, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray] | None:
    """Return the outputs of a `scan` or a `while` loop, unrolled; None if it has too many iterations, or an unknown number."""
    return (_unroll_scan if equation.primitive.name == "scan" else _unroll_while)(read, equation, inputs)


def _unroll_scan(read: Read, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray] | None:
    body, length = equation.params["jaxpr"], equation.params["length"]
    inner, order = getattr(body, "jaxpr", body), range(equation.params["length"])
    if length * len(inner.eqns) > UNROLLED_OPERATIONS:
        return None
    # Constants and carry come first; the scanned inputs have a leading dimension, one entry per iteration.
    rows = sum(a.aval.shape != b.aval.shape for a, b in zip(equation.invars, inner.invars, strict=True))
    carries = sum(a.aval.shape == b.aval.shape for a, b in zip(equation.outvars, inner.outvars, strict=True))
    ends = np.cumsum([len(inputs) - carries - rows, carries])
    fixed, state, scanned = inputs[: ends[0]], inputs[ends[0] : ends[1]], inputs[ends[1] :]
    rows_of_outputs: dict[int, list[np.ndarray]] = {}
    for k in reversed(order) if equation.params["reverse"] else order:
        outputs = read(body, [*fixed, *state, *(np.asarray(x[k], object) for x in scanned)])
        state, rows_of_outputs[k] = outputs[:carries], outputs[carries:]
    columns = zip(*(rows_of_outputs[k] for k in order), strict=True)
    return [*state, *(np.stack([np.asarray(x, object) for x in column]) for column in columns)]


def _unroll_while(read: Read, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray] | None:
    options = equation.params
    counts = options["cond_nconsts"], options["body_nconsts"]
    first, second, state = inputs[: counts[0]], inputs[counts[0] : sum(counts)], inputs[sum(counts) :]
    condition, body = options["cond_jaxpr"], options["body_jaxpr"]
    for _ in range(1 + UNROLLED_OPERATIONS // max(1, len(body.jaxpr.eqns))):
        goes_on = read(condition, [*first, *state])[0].item().constant
        if goes_on is None:
            return None
        if not goes_on:
            return state
        state = read(body, [*second, *state])
    return None
