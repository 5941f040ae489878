"""What of a program XLA compiles into one function: loops, unless there is something in them that it cannot compile so."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array

Tree = TypeVar("Tree")

ONE = {"inlineable": "false", "xla_cpu_small_call": "true"}  # XLA notes the second at loops that it compiles into one function


def apart(x: Array) -> Array:
    """The whole number x, in a form that keeps XLA from compiling the loop that it is in into one function.

    It costs to sort two numbers. Loops inside of that one are functions all the same, which are compiled side by side, and in
    less time than all as one.
    """
    return jax.lax.sort(jnp.stack([x, jnp.full_like(x, jnp.iinfo(x.dtype).max)]), dimension=0)[0]


def after(x: Array, tree: Tree) -> Tree:
    """The same numbers, which XLA has at hand no sooner than the number x, of any value.

    What waits for nothing is ready at once, and of more than nine operations that are, XLA starts some on other threads, which
    takes longer than to do them.
    """
    width = 8 * x.dtype.itemsize
    bits = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(x), jnp.dtype(f"uint{width}"))
    never = jax.lax.shift_right_logical(bits, bits.dtype.type(width - 1)) > 1  # one bit: XLA does not look so far
    return jax.tree.map(lambda y: jnp.where(never, jnp.ones_like(y), y), tree)


def as_one(function: Callable[[Tree], Tree]) -> Callable[[Tree], Tree]:
    """The same, which XLA compiles into one function on the CPU wherever it is called, and all derivatives of it, too.

    It must be arithmetic that uses all it is given: XLA asks only of loops whether they can be compiled so. Operations by
    themselves are started one by one, for a microsecond each, and some on other threads where more than nine are ready.
    """
    inner = jax.jit(function)

    def outer(x: Tree) -> Tree:
        if jax.default_backend() != "cpu":
            return inner(x)
        # XLA may put a constant in the place of an argument, which is then left unused, and XLA, having no address of it, ends
        # the process. What has passed a barrier is no constant. Of results, that is for what is handed back to them.
        with set_xla_metadata(**ONE):
            results = inner(jax.lax.optimization_barrier(x))
        return jax.lax.optimization_barrier(results)

    return outer


def when(condition: Array, function: Callable[[Tree], Tree], x: Tree) -> Tree:
    """`function(x)` or x: a branch that does not keep XLA from compiling the loop that it is in into one function.

    Where XLA cannot know that the condition holds, it makes one function of `function`. An x that has been computed is better
    than zeros: of more than nine operations that wait for nothing XLA hands some to other threads.
    """
    return jax.lax.while_loop(lambda c: c[0], lambda c: (jnp.zeros_like(condition), function(c[1])), (condition, x))[1]
