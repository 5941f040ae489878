"""Values without derivatives, such as choices of step and order, and error estimates."""

from typing import TypeVar

import equinox as eqx
import jax

Tree = TypeVar("Tree")


def stop_gradients(tree: Tree) -> Tree:
    """Return a tree with the same values and zero derivatives."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)
