"""The results of a program as one vector."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp


def vector(values: Sequence[Any]) -> Any:
    """Return scalars (or vectors over a batch) side by side along a new first axis."""
    dtype = jnp.result_type(float)
    values = [x if isinstance(x, jax.Array) and x.dtype == dtype else jnp.asarray(x, dtype) for x in values]
    return jnp.stack(values) if values else jnp.zeros(0)
