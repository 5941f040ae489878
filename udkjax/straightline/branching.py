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


def whole(function: Callable[[Tree], tuple[Tree, Array]], holds: Array, x: Tree) -> tuple[Tree, Array]:
    """`function(x)`, another such tree and an array, compiled into one function. The condition `holds`; XLA must not know.

    Of more than eight operations that wait for nothing, as zeros would to begin with, XLA hands some to other threads.
    """
    other = jax.eval_shape(function, x)[1]
    begin = x, jnp.broadcast_to(holds.astype(other.dtype), other.shape)
    return when(holds, lambda begin: function(begin[0]), begin)


def when(condition: Array, function: Callable[[Tree], Tree], x: Tree) -> Tree:
    """`function(x)` or x: a branch that does not keep XLA from compiling the loop that it is in into one function."""
    return jax.lax.while_loop(lambda c: c[0], lambda c: (jnp.zeros_like(condition), function(c[1])), (condition, x))[1]
