"""Parts of compiled programs that they hardly ever reach, and that would take most of the time to compile."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.native.base.host_function import call_host
from udkjax.programs.deferred import deferred_p, trace_once
from udkjax.programs.numpy_program import Meter, has_rules, numpy_program


class _TracedFunction:
    """A traced program as a function of arrays: NumPy evaluates it, one member after another."""

    def __init__(self, program: Any):
        self._program = program

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _TracedFunction) and self._program is other._program

    def __hash__(self) -> int:
        return hash(id(self._program))

    def __call__(self, *inputs: Any) -> Sequence[Any]:
        members = max(len(x) for x in inputs)
        found = [self._of_member([x[min(k, len(x) - 1)] for x in inputs]) for k in range(members)]
        return [np.stack(x) for x in zip(*found, strict=True)]

    def shapes(self, members: int) -> Sequence[tuple[int, ...]]:
        """Return the shapes of the results."""
        return [(members, *aval.shape) for aval in self._program.out_avals]

    def _of_member(self, inputs: Sequence[Any]) -> list[Any]:
        given = [np.asarray(x, aval.dtype) for x, aval in zip(inputs, self._program.in_avals, strict=True)]
        with np.errstate(all="ignore"):
            return [np.asarray(x, float) for x in numpy_program(self._program)(Meter(math.inf), given)]


def call_seldom(function: Callable[..., Any], *given: Any) -> Any:
    """Return function(*given), which is traced, and evaluated by NumPy where a program reaches it: nothing of it is compiled.

    It has no derivatives.

    Args:
        function: a function of trees, known by its name: what is traced for it serves all calls of the same structure.
        given: trees of arrays, which may be traced, and of static values.
    """
    if deferred_p is None or jax.default_backend() != "cpu" or not jax.config.jax_enable_x64:
        return function(*given)
    program, leaves, out = trace_once(function, given)
    if not has_rules(program):  # within a program that runs, JAX must not be called
        return function(*given)
    found = call_host(_TracedFunction(program), [jnp.asarray(x)[None] for x in leaves])
    return out.rebuild([x[0].astype(aval.dtype) for x, aval in zip(found, program.out_avals, strict=True)])
