"""Newton's method of problems whose steps settle their kinks first, and then double the correct digits."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

MOST_STEPS = 50  # three to six are usual
LAST_CHANGE = 1e-13  # by the last step, relative: the digits of the step before are half as many


def repeated_newton(
    step: Callable[[Array], tuple[Array, Array, Array]],
    start: Array,
    begins: Bool[ArrayLike, ""] = True,
    most_steps: int = MOST_STEPS,
    last_change: float = LAST_CHANGE,
) -> tuple[Array, Bool[Array, ""]]:
    """Return the last of at most `most_steps` iterates, and whether the last step still changed it.

    Args:
        step: Returns the next iterate, the size of its change and its own; the change counts beyond `last_change` of the size.
        start: The first iterate.
        begins: Whether there are any steps.
        most_steps: The maximum number of steps.
        last_change: The largest relative change by a last step.
    """

    def again(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, change, size = step(state[0])
        return x, change > last_change * size, state[2] + 1

    def goes_on(state: tuple[Array, Array, Array]) -> Array:
        return state[1] & (state[2] < most_steps)

    x, is_open, _ = jax.lax.while_loop(goes_on, again, (start, jnp.asarray(begins), jnp.asarray(0)))
    return x, is_open
