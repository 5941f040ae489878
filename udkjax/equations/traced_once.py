"""Functions of a mechanism and a state that are traced once, however often larger programs take them.

One program takes Psi, its Jacobian and the loads dozens of times: in each stage, in projection, under each derivative. JAX finds
the trace of a function under `jit` again, and of its derivatives and batches too.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from udkjax.scene.mechanism import Mechanism

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def traced_once(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function of a mechanism and of numbers that is traced once for each structure."""
    program: Callable[..., Any] = eqx.filter_jit(function)

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        return program(*map(_as_traced, args), **{name: _as_traced(value) for name, value in kwargs.items()})

    return run


def _as_traced(value: Any) -> Mechanism | Array:
    """Return a mechanism without its origin, and numbers as arrays: neither is part of what is traced."""
    return value.without_origin if isinstance(value, Mechanism) else jnp.asarray(value, jnp.result_type(float))
