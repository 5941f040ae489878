"""What of a program XLA compiles into one function: loops, unless there is something in them that it cannot compile so."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

Tree = TypeVar("Tree")


def apart(x: Array) -> Array:
    """The whole number x, in a form that keeps XLA from compiling the loop that it is in into one function.

    It costs to sort two numbers. Loops inside of that one are functions all the same, which are compiled side by side, and in
    less time than all as one.
    """
    return jax.lax.sort(jnp.stack([x, jnp.full_like(x, jnp.iinfo(x.dtype).max)]), dimension=0)[0]


def when(condition: Array, function: Callable[[Tree], Tree], x: Tree) -> Tree:
    """`function(x)` or x: a branch that does not keep XLA from compiling the loop that it is in into one function.

    Where XLA cannot know that the condition holds, it makes one function of `function`. An x that has been computed is better
    than zeros: of more than eight operations that wait for nothing XLA hands some to other threads.
    """
    return jax.lax.while_loop(lambda c: c[0], lambda c: (jnp.zeros_like(condition), function(c[1])), (condition, x))[1]
