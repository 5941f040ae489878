"""Newton's method for problems with kinks: steps first find the smooth piece of the solution, then double the correct digits."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

MOST_STEPS = 50  # three to six are usual
LAST_CHANGE = 1e-13  # by the last step, relative, in float64: the digits of the step before are half as many


def repeated_newton(
    step: Callable[[Array], tuple[Array, Array, Array]],
    start: Array,
    begins: Bool[ArrayLike, ""] = True,
    most_steps: int = MOST_STEPS,
    last_change: float | None = None,
) -> tuple[Array, Bool[Array, ""]]:
    """Take Newton steps until one of them hardly changes the iterate, or `most_steps` are taken.

    Args:
        step: From an iterate to the next one, the size of the change, and the size of the next iterate.
        start: The first iterate.
        begins: Whether any steps are taken.
        most_steps: The maximum number of steps.
        last_change: Steps end after one whose change is at most this fraction of the iterate's size. None: `LAST_CHANGE`, or as
            many rounding errors in float32.

    Returns:
        The last iterate, and True if the last step still changed it by more: the iteration has not converged.
    """
    if last_change is None:
        last_change = LAST_CHANGE * float(jnp.finfo(start.dtype).eps / jnp.finfo(jnp.float64).eps)

    def again(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, change, size = step(state[0])
        return x, change > last_change * size, state[2] + 1

    def goes_on(state: tuple[Array, Array, Array]) -> Array:
        return state[1] & (state[2] < most_steps)

    x, is_open, _ = jax.lax.while_loop(goes_on, again, (start, jnp.asarray(begins), jnp.asarray(0)))
    return x, is_open
