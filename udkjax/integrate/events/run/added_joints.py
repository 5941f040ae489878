"""Joints that events add, for machine code: programs that compute their numbers from the state, and places of these numbers."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from udkjax.expressions import Graph, ScalarProgram
from udkjax.integrate.events.law.conditions import frames_of
from udkjax.integrate.events.law.phases import SCENE, Phases
from udkjax.integrate.events.run.condition_program import input_array, trace_scalars
from udkjax.scene.mechanism import Mechanism


class AddedJoint(NamedTuple):
    """A program that computes the numbers of a joint that an event adds."""

    program: ScalarProgram  # all numbers of the joint, from q and the numbers that do not depend on q
    changing: tuple[int, ...]  # indices of the numbers that depend on q


class NumberOf(NamedTuple):
    """A placeholder for an array of numbers of a joint, with its size."""

    size: int


def joint_numbers(phases: Phases) -> list[Array]:
    """Return the numbers of all joints that events add, except those that depend on the state."""
    return jax.tree.leaves(eqx.filter(phases.added, eqx.is_inexact_array))


def added_joints(phases: Phases) -> tuple[AddedJoint, ...]:
    """Return the programs of the joints that events add."""
    names, joints = phases.mechanisms[SCENE].body_names, []
    for joint in phases.added:
        arrays, rest = eqx.partition(joint, eqx.is_inexact_array)
        leaves, tree = jax.tree.flatten(arrays)

        def numbers(q: list[Array], *numbers: Array, tree=tree, rest=rest) -> list[Array]:
            joint, frames = eqx.combine(jax.tree.unflatten(tree, numbers), rest), frames_of(names, q)
            return jax.tree.leaves(joint.complete(*(frames[name] for name in joint.frame_names)))

        shapes, graph = [(3 * len(names),), *(np.shape(x) for x in leaves)], Graph()
        inputs = [input_array(graph, k, shape) for k, shape in enumerate(shapes)]
        outputs = [x for array in trace_scalars(graph, numbers, inputs, (0,)) for x in array.flat]
        constant = {x.index for array in inputs[1:] for x in array.flat}
        changing = tuple(i for i, x in enumerate(outputs) if x.index not in constant)
        joints.append(AddedJoint(ScalarProgram(graph, [x for array in inputs for x in array.flat], outputs), changing))
    return tuple(joints)


def places_of_joints(mechanism: Mechanism, names: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Return the places of the numbers of each named joint among all numbers of a mechanism.

    The last number of each joint, which switches it on and off, is left out.
    """
    result = []
    for name in names:
        k = mechanism.joint_names.index(name)
        sizes = jax.tree.map(lambda x: NumberOf(np.size(x)), mechanism._joints[k])
        marked = eqx.tree_at(lambda m, k=k: m._joints[k], mechanism, sizes)
        leaves = jax.tree.leaves(marked, is_leaf=lambda x: isinstance(x, NumberOf))
        counts = [x.size if isinstance(x, NumberOf) else np.size(x) for x in leaves]
        starts = np.cumsum([0, *counts])
        of_joint = [range(a, a + x.size) for a, x in zip(starts, leaves, strict=False) if isinstance(x, NumberOf)]
        result.append(tuple(int(i) for places in of_joint[:-1] for i in places))  # `active` is the last field
    return tuple(result)


def evaluate_joint(joint: AddedJoint, q: Float[np.ndarray, "b n"], numbers: Float[np.ndarray, "b k"]) -> Float[np.ndarray, "b m"]:
    """Return all numbers (b, m) of a joint that is added at b positions q; `numbers` do not depend on q."""
    if len(q) == 1:  # Python floats take less time than arrays
        return np.array([joint.program([*q[0].tolist(), *numbers[0].tolist()])], float)
    return np.stack(joint.program.by_numpy([*q.T, *numbers.T]), axis=1)
