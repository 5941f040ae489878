"""Elements of an array by their places, which are known when the program is traced."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def take(values: Float[Array, "*shape n"], places: np.ndarray) -> Array:
    """values[..., places], for places that are known to exist."""
    values = jnp.asarray(values)
    if not places.size:  # of no values, too
        return jnp.zeros((*values.shape[:-1], *places.shape), values.dtype)
    return values.at[..., places].get(mode="promise_in_bounds", wrap_negative_indices=False)
