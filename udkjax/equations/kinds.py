"""Elements that are alike: of one structure, whatever bodies they hold and whatever their numbers are.

However many revolute joints a scene has, what a joint says of itself is traced once, and evaluated for all of them together.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.scene.bodies import GROUND, Frame
from udkjax.scene.mechanism import Mechanism, attached


class Alike(NamedTuple):
    """What elements have in common that are traced once: all but the names of their bodies and the values of their numbers."""

    tree: Any
    shapes: tuple
    ground: tuple[bool, ...]  # which of its frames are the ground's

    @property
    def moving(self) -> int:
        """How many bodies move in it."""
        return len(self.ground) - sum(self.ground)


def alike(element: Any, frames: Sequence[str]) -> Alike:
    """Return an element's structure; `frames` are the names of the bodies that it sees."""
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
    return Alike(tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves), tuple(name == GROUND for name in frames))


class Kind(NamedTuple):
    """All elements of one structure: their places among those given, and the bodies that move in each."""

    structure: Alike
    members: np.ndarray  # (elements,)
    bodies: np.ndarray  # (moving, elements)


def kinds(mechanism: Mechanism, elements: Sequence[Any], split: Sequence[Any] | None = None) -> list[Kind]:
    """Sort elements by their structure, and by what `split` says of each of them."""
    place, joints = {name: k for k, name in enumerate(mechanism.body_names)}, mechanism.joints
    found: dict[Any, list[tuple[int, list[int]]]] = {}
    for i, element in enumerate(elements):
        frames = attached(element, joints)  # a method of a large module takes a look at all of its leaves
        key = alike(element, frames), split[i] if split else None
        found.setdefault(key, []).append((i, [place[name] for name in frames if name in place]))
    result = []
    for (structure, _), members in found.items():
        bodies = np.array([b for _, b in members], int).reshape(len(members), -1).T
        result.append(Kind(structure, np.array([i for i, _ in members]), bodies))
    return result


def of_each(say: Callable[..., Any], mechanism: Mechanism, elements: Sequence[Any], *states: Any) -> list[tuple[Kind, Any]]:
    """`say(element, *frames)` of elements by their kinds: arrays with the elements first, or None where it says None.

    `states` are q and, where the elements see velocities, v, each (bodies, 3).
    """
    q, found = states[0], []
    sines = jnp.cos(q[:, 2:]), jnp.sin(q[:, 2:])
    seen = jnp.concatenate([q, *sines, *states[1:]], axis=1)  # what a frame holds of each body
    still = (0.0, 0.0, 0.0, 1.0, 0.0, *(0.0 for _ in states[1:] for _ in range(3)))
    for kind in kinds(mechanism, elements):
        tree, _, ground = kind.structure

        def one(leaves: Sequence[Any], bodies: Any, tree: Any = tree, ground: tuple[bool, ...] = ground) -> Any:
            rest = iter(bodies)
            return say(jax.tree.unflatten(tree, leaves), *(Frame(*(still if fixed else next(rest))) for fixed in ground))

        columns = zip(*(jax.tree.leaves(elements[i]) for i in kind.members), strict=True)
        leaves = [jnp.stack([jnp.asarray(x) for x in column]) for column in columns]
        found.append((kind, jax.vmap(one)(leaves, seen[kind.bodies.T])))
    return found
