"""A branch for programs that run in loops."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

Tree = TypeVar("Tree")


def when(condition: Array, function: Callable[[Tree], Tree], x: Tree) -> Tree:
    """`function(x)` or x: a branch that does not keep XLA from compiling the loop that it is in into one function."""
    return jax.lax.while_loop(lambda c: c[0], lambda c: (jnp.zeros_like(condition), function(c[1])), (condition, x))[1]
