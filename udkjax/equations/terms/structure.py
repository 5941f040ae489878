"""The structure of a scene and of its elements: everything except the values of numbers.

Elements of the same structure, such as all revolute joints, are traced once and evaluated together, whichever bodies they
connect.
"""

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from itertools import groupby
from typing import NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int

from udkjax.annotations import Number, NumericArray, Time, TreeDef
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME, GROUND_FRAME_AT_REST, Frame
from udkjax.scene.elements.forces import ForceElement, Wrench
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import Constraint, Joint
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.element_setup import attached_bodies

LeafShapes: TypeAlias = tuple[tuple[tuple[int, ...], np.dtype], ...]  # shape and dtype of each leaf of a tree
Structure: TypeAlias = tuple[TreeDef, LeafShapes]


class RubbingJoint(eqx.Module):
    """A joint, and the friction of this joint that depends on its load. The names of bodies and joints are removed from both.

    Args:
        bodies: the names of the bodies of the joint.
        friction: the friction.
        joint: the joint.
    """

    bodies: tuple[str, ...] = eqx.field(static=True)
    friction: Friction
    joint: Joint

    def loads(self, multipliers: Sequence[Number], t: Number, *frames: Frame) -> Sequence[Wrench]:
        """Return the loads of the friction on the frames of the joint, from the multipliers of its rows."""
        return self.friction.rubbing_loads(self.joint, multipliers, t, *frames)


Element: TypeAlias = Constraint | ForceElement | RubbingJoint
Result = TypeVar("Result")
AnyElement = TypeVar("AnyElement", bound=eqx.Module)


def structure(mechanism: Mechanism) -> Structure:
    """Return the tree of a mechanism, and the shape and dtype of each number. It does not depend on the number of samples."""
    return _structure_of_elements(mechanism.without_origin)


@cached_by_identity  # also for traced numbers: the result contains no numbers
def _structure_of_elements(mechanism: Mechanism) -> Structure:
    return _structure(mechanism.without_samples)


def _structure(mechanism: Mechanism) -> tuple[TreeDef, LeafShapes]:
    leaves, tree = jax.tree.flatten(mechanism)
    return tree, tuple((np.shape(leaf), np.dtype(getattr(leaf, "dtype", float))) for leaf in leaves)


def whole_structure(mechanism: Mechanism) -> tuple[TreeDef, LeafShapes]:
    """Return the structure of a mechanism with all of its samples and their knots.

    Programs of this structure are given all samples at once; those of `structure` only the samples of one interval of time.
    """
    return _whole_structure_of_elements(mechanism.without_origin)


_whole_structure_of_elements = cached_by_identity(lambda mechanism: _structure(mechanism))


def numbers_as_vector(numbers: Sequence[ArrayLike]) -> NumericArray:
    """Return numbers and arrays as one vector, in order; by NumPy if they are concrete."""
    vectors = [
        jnp.ravel(jnp.asarray(x, float)) if isinstance(x, Tracer) else np.asarray(x) for x in join_concrete_numbers(numbers)
    ]
    if len(vectors) < 2:
        return vectors[0] if vectors else np.zeros(0)
    return jnp.concatenate(vectors)


def join_concrete_numbers(numbers: Sequence[ArrayLike]) -> list[ArrayLike]:
    """Return a list in which each run of successive concrete numbers is one NumPy vector; traced numbers stay as they are."""
    joined = []
    for traced, group in groupby(numbers, lambda x: isinstance(x, Tracer)):
        if traced:
            joined += group
        else:
            joined.append(np.concatenate([np.ravel(np.asarray(x, float)) for x in group]))
    return joined


def concrete_numbers(mechanism: Mechanism, t: Time = 0.0) -> np.ndarray:
    """Return the concrete numbers of a mechanism as one vector, which callers must not change.

    Sampled numbers are those of the interval that contains the time t (s).
    """
    return whole_numbers(mechanism.at(t) if mechanism.samples else mechanism.without_origin)


@cached_by_identity
def whole_numbers(mechanism: Mechanism) -> np.ndarray:
    """Return the concrete numbers of a mechanism, including all samples, as one vector, which callers must not change."""
    return np.concatenate([np.asarray(x, float).ravel() for x in mechanism.numbers])


class ElementStructure(NamedTuple):
    """An element without the names of its bodies and the values of its numbers: elements of equal structure are traced once."""

    tree: TreeDef
    shapes: LeafShapes
    ground: tuple[bool, ...]  # for each of its frames, whether it is the ground

    @property
    def body_count(self) -> int:
        """The number of frames that are not the ground."""
        return len(self.ground) - sum(self.ground)


def element_structure(element: Element, frames: Sequence[str]) -> ElementStructure:
    """Return the structure of a constraint or force element attached to `frames`, names of bodies or the ground."""
    leaves, tree = jax.tree.flatten(nameless(element, frames))
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    return ElementStructure(tree, shapes, tuple(name == GROUND for name in frames))


def nameless(element: AnyElement, frames: Sequence[str]) -> AnyElement:
    """Return an element whose bodies are named by their indices in `frames`, and whose references to joints are empty."""
    numbers = {name: GROUND if name == GROUND else str(k) for k, name in enumerate(frames)}
    renamed = object.__new__(type(element))
    for name, value in vars(element).items():
        object.__setattr__(renamed, name, value)
    for field in dataclasses.fields(element):
        if field.name == "bodies" or "names" in field.metadata:
            value = getattr(element, field.name)
            new = numbers.get(value, "") if isinstance(value, str) else tuple(numbers.get(name, "") for name in value)
            object.__setattr__(renamed, field.name, new)
    return renamed


def rubbing_joints(mechanism: Mechanism) -> list[RubbingJoint | None]:
    """Return the joints with friction that depends on their load, in the order of the constraints; None for all others."""
    frictions = {f.joint: f for f in mechanism.forces.values() if isinstance(f, Friction) and f.rubs}
    found: list[RubbingJoint | None] = [None] * len(mechanism.constraints)
    for k, (name, joint) in enumerate(mechanism.joints.items()):
        if name in frictions:
            bodies = joint.frame_names
            found[k] = RubbingJoint(bodies, nameless(frictions[name], ()), nameless(joint, bodies))
    return found


class ElementKind(NamedTuple):
    """All elements of one structure."""

    structure: ElementStructure
    members: Int[np.ndarray, "elements"]  # indices among the sorted elements
    bodies: Int[np.ndarray, "bodies_of_each elements"]  # indices of their bodies


def element_kinds(
    mechanism: Mechanism, elements: Sequence[Element], labels: Sequence[Hashable] | None = None
) -> list[ElementKind]:
    """Return the kinds of elements: those of equal structure and, if `labels` are given, one for each element, equal label."""
    body_index, joints = {name: k for k, name in enumerate(mechanism.body_names)}, mechanism.joints
    kinds: dict[tuple[ElementStructure, Hashable], list[tuple[int, list[int]]]] = {}
    for i, element in enumerate(elements):
        # Called once: a method call on a large module visits all of its leaves.
        frames = element.bodies if isinstance(element, RubbingJoint) else attached_bodies(element, joints)
        key = element_structure(element, frames), labels[i] if labels else None
        kinds.setdefault(key, []).append((i, [body_index[name] for name in frames if name in body_index]))
    result = []
    for (kind, _), members in kinds.items():
        bodies = np.array([b for _, b in members], int).reshape(len(members), -1).T
        result.append(ElementKind(kind, np.array([i for i, _ in members]), bodies))
    return result


def entries(x: Float[Array, "m"], which: Int[np.ndarray, "n"]) -> Float[Array, "n"]:
    """Return x[which] by one operation, also in derivatives; `which` is within the bounds of x and not empty."""
    start, count = int(which[0]), len(which)
    if np.array_equal(which, np.arange(start, start + count)):  # as in chains
        return x if count == len(x) else x[start : start + count]
    each = jax.lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    return jax.lax.gather(x, np.asarray(which, np.int32)[:, None], each, slice_sizes=(1,), mode="promise_in_bounds")


def evaluate_by_kind(
    function: Callable[..., Result], mechanism: Mechanism, elements: Sequence[Element], *states: Float[Array, "bodies 3"]
) -> list[tuple[ElementKind, Result]]:
    """Evaluate `function(element, *frames)` for elements of each kind together.

    Args:
        function: Its result may be None.
        mechanism: The scene.
        elements: Constraints or force elements of the mechanism.
        states: q and, where the elements depend on velocities, v, each (bodies, 3).

    Returns:
        The kinds, each with its results; the first axis is that of the elements.
    """
    results: list[tuple[ElementKind, Result]] = []
    x, y, angle = (states[0][:, k] for k in range(3))
    # the fields of `Frame` of each body
    fields = [x, y, angle, jnp.cos(angle), jnp.sin(angle), *(v[:, k] for v in states[1:] for k in range(3))]
    ground = GROUND_FRAME if len(states) == 1 else GROUND_FRAME_AT_REST
    for kind in element_kinds(mechanism, elements):

        def evaluate(leaves: Sequence[Array], moving: Sequence[Frame], kind: ElementStructure = kind.structure) -> Result:
            moving_frames = iter(moving)
            element = jax.tree.unflatten(kind.tree, leaves)
            return function(element, *(ground if fixed else next(moving_frames) for fixed in kind.ground))

        columns = zip(*(jax.tree.leaves(elements[i]) for i in kind.members), strict=True)
        leaves = [jnp.asarray(numbers_as_vector(column)).reshape(-1, *np.shape(column[0])) for column in columns]
        moving = [Frame(*(entries(field, which) for field in fields)) for which in kind.bodies]
        results.append((kind, jax.vmap(evaluate, axis_size=len(kind.members))(leaves, moving)))
    return results
