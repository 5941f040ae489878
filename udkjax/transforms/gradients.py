"""Values without derivatives: the choices of step and order, and estimates of errors, on which a run depends."""

from typing import Any, TypeVar

import equinox as eqx
import jax

Tree = TypeVar("Tree")
TreeDef = Any  # jax.tree_util.PyTreeDef, which type checkers take for a variable


def stop_gradients(tree: Tree) -> Tree:
    """Return a tree of the same values, whose derivatives are zero."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)
