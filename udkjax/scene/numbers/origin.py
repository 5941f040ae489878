"""The concrete mechanism from which a mechanism with traced numbers was made."""

from typing import Any

import jax
import numpy as np


class Origin:
    """The concrete mechanism from which a mechanism with traced numbers was made, hashable and compared by value."""

    def __init__(self, mechanism: Any):
        self.mechanism = mechanism
        leaves, structure = jax.tree.flatten(mechanism)
        self._key = structure, tuple((np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in leaves)
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Origin) and self._key == other._key)
