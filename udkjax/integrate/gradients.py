"""What a run depends on without its derivatives doing so: choices of step and order, estimates of errors."""

from typing import TypeVar

import equinox as eqx
import jax

Tree = TypeVar("Tree")


def stop_gradients(tree: Tree) -> Tree:
    """Return the same values, of no interest to any derivative."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)
