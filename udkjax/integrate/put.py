"""Arrays of NumPy as those of JAX."""

from collections import Counter
from typing import Any

import jax
import numpy as np

_put_together = jax.jit(lambda *arrays: arrays)
_WORTH_A_PROGRAM = 60  # calls: putting arrays one by one takes 0.3 ms longer than by a program, which takes 15 ms to compile
_calls: Counter[tuple[tuple[int, ...], ...]] = Counter()  # by shapes


def put_arrays(arrays: Any) -> Any:
    """Return a tree of arrays of NumPy, and numbers, as those of JAX."""
    leaves, tree = jax.tree.flatten(arrays)
    _calls[shapes := tuple(map(np.shape, leaves))] += 1
    if _calls[shapes] <= _WORTH_A_PROGRAM:
        return jax.device_put(arrays)
    return jax.tree.unflatten(tree, _put_together(*leaves))
