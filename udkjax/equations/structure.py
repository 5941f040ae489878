"""The structure of a scene and of its elements: all that programs depend on but the values of numbers.

Elements of the same structure, such as all revolute joints, are traced once and evaluated together, whatever bodies they hold.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from udkjax.scene.bodies import GROUND, Frame
from udkjax.scene.mechanism import Mechanism, attached_bodies

# Bodies, constraints and force elements beyond which the programs are loops over elements of the same structure. Straight-line
# programs evaluate faster, up to several times this size, but take the longer to trace and compile, the larger the scene is
# (python -m benchmarks scaling).
LARGE_SCENE = 40


def is_large(mechanism: Mechanism) -> bool:
    """Whether a scene has more than `LARGE_SCENE` elements."""
    return len(mechanism.body_names) + len(mechanism.constraints) + len(mechanism.force_names) > LARGE_SCENE


def structure(mechanism: Mechanism) -> tuple[Any, tuple]:
    """Return the tree of a mechanism, and the shape and the type of each of its numbers."""
    leaves, tree = jax.tree.flatten(mechanism.without_origin)
    return tree, tuple((np.shape(leaf), np.dtype(getattr(leaf, "dtype", float))) for leaf in leaves)


def leaves_as_vector(leaves: Sequence[Any]) -> Any:
    """All numbers of some arrays as one vector, in order; by NumPy where they are known."""
    known = not any(isinstance(x, Tracer) for x in leaves)
    parts = [np.ravel(np.asarray(x, float)) if known else jnp.ravel(jnp.asarray(x, float)) for x in leaves]
    return np.concatenate(parts) if known else jnp.concatenate(parts)


def leaves_as_scalars(leaves: Sequence[Any]) -> list[Any]:
    """All numbers of some arrays one by one, in the order in which the graph of a scene counts them."""
    return [x for leaf in leaves for x in _scalars(leaf)]


def _scalars(leaf: Any) -> list[Any]:
    if not np.shape(leaf):
        return [leaf[()] if isinstance(leaf, np.ndarray) else leaf]
    if not isinstance(leaf, Tracer):
        return [leaf[place] for place in np.ndindex(*np.shape(leaf))]
    flat = leaf.reshape(-1)
    return [jax.lax.index_in_dim(flat, k, keepdims=False) for k in range(flat.size)]  # a third of what flat[k] takes to trace


class ElementStructure(NamedTuple):
    """What is traced once for many elements: all of them but the names of their bodies and the values of their numbers."""

    tree: Any
    shapes: tuple
    ground: tuple[bool, ...]  # which of its frames are the ground's

    @property
    def body_count(self) -> int:
        """How many of its frames are those of bodies."""
        return len(self.ground) - sum(self.ground)


def element_structure(element: Any, frames: Sequence[str]) -> ElementStructure:
    """Return the structure of a constraint or force element that is attached to `frames`, names of bodies or the ground."""
    numbers = {name: GROUND if name == GROUND else str(k) for k, name in enumerate(frames)}
    nameless = object.__new__(type(element))
    for name, value in vars(element).items():
        object.__setattr__(nameless, name, value)
    for field in dataclasses.fields(element):
        if field.name == "bodies" or "names" in field.metadata:
            value = getattr(element, field.name)
            renamed = numbers.get(value, "") if isinstance(value, str) else tuple(numbers.get(name, "") for name in value)
            object.__setattr__(nameless, field.name, renamed)
    leaves, tree = jax.tree.flatten(nameless)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    return ElementStructure(tree, shapes, tuple(name == GROUND for name in frames))


class ElementKind(NamedTuple):
    """All elements of one structure."""

    structure: ElementStructure
    members: np.ndarray  # (elements,) their indices among those given
    bodies: np.ndarray  # (bodies of each, elements)


def element_kinds(mechanism: Mechanism, elements: Sequence[Any], labels: Sequence[Any] | None = None) -> list[ElementKind]:
    """Sort elements by their structure, and by their `labels` where there are any."""
    body_index, joints = {name: k for k, name in enumerate(mechanism.body_names)}, mechanism.joints
    found: dict[Any, list[tuple[int, list[int]]]] = {}
    for i, element in enumerate(elements):
        frames = attached_bodies(element, joints)  # a method of a large module takes a look at all of its leaves
        key = element_structure(element, frames), labels[i] if labels else None
        found.setdefault(key, []).append((i, [body_index[name] for name in frames if name in body_index]))
    result = []
    for (kind, _), members in found.items():
        bodies = np.array([b for _, b in members], int).reshape(len(members), -1).T
        result.append(ElementKind(kind, np.array([i for i, _ in members]), bodies))
    return result


def evaluate_by_kind(
    function: Callable[..., Any], mechanism: Mechanism, elements: Sequence[Any], *states: Any
) -> list[tuple[ElementKind, Any]]:
    """Evaluate `function(element, *frames)` for elements of each kind together.

    Args:
        function: Its result may be None.
        mechanism: The scene.
        elements: Some of its constraints or force elements.
        states: q and, where the elements depend on velocities, v, each (bodies, 3).

    Returns:
        The kinds, each with the results, the elements first.
    """
    q, found = states[0], []
    turned = jnp.cos(q[:, 2:]), jnp.sin(q[:, 2:])
    frames = jnp.concatenate([q, *turned, *states[1:]], axis=1)  # the fields of `Frame` of each body
    ground = (0.0, 0.0, 0.0, 1.0, 0.0, *(0.0 for _ in states[1:] for _ in range(3)))
    for kind in element_kinds(mechanism, elements):

        def evaluate(leaves: Sequence[Any], of_bodies: Any, kind: ElementStructure = kind.structure) -> Any:
            rest = iter(of_bodies)
            element = jax.tree.unflatten(kind.tree, leaves)
            return function(element, *(Frame(*(ground if fixed else next(rest))) for fixed in kind.ground))

        columns = zip(*(jax.tree.leaves(elements[i]) for i in kind.members), strict=True)
        leaves = [jnp.stack([jnp.asarray(x) for x in column]) for column in columns]
        found.append((kind, jax.vmap(evaluate)(leaves, frames[kind.bodies.T])))
    return found
