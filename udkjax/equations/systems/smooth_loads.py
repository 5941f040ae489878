"""Smooth loads: the loads of a force element or a user-defined system, with the sides of their comparisons as inputs.

With its sides held, a load is a smooth function of the state, also beyond the crossing of a comparison
(expressions/scalars/kinks.py).
"""

from collections.abc import Collection, Iterable, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from udkjax.equations.systems.traced_system import SystemFunctions
from udkjax.equations.terms.elements import TracedLoads, traced_loads
from udkjax.equations.terms.structure import ElementStructure
from udkjax.expressions import Graph, Scalar, ScalarProgram, smooth_pieces
from udkjax.scene.elements.bodies import Frame
from udkjax.scene.elements.forces import ForceElement


class SmoothLoads:
    """The programs of loads with held sides. Equal loads have the same object, and so share compiled code.

    Args:
        graph: The graph of the loads.
        numbers: The numbers of an element or of a system.
        state: t, q and v.
        loads: The loads.
        moving: The groups of inputs that change during a motion.
        kind: The structure of the element; None for a system.

    Attributes:
        count: The number of sides.
        has_opaque: True if the loads contain loops or branches whose kinks are unknown.
        turns: For each condition, the index of the side that changes where the condition crosses zero, and the factor and the
            shift that make the new side of the old one.
        renewal: Program of the sides at a state.
        by_velocity: True for each condition that depends on velocities.
    """

    def __init__(
        self,
        graph: Graph,
        numbers: Sequence[Scalar],
        state: tuple[Scalar, Sequence[Scalar], Sequence[Scalar]],
        loads: Sequence[Scalar],
        moving: Collection[str],
        kind: ElementStructure | None = None,
    ):
        pieces, (t, q, v) = smooth_pieces(graph, loads, moving), state
        self.kind, self.count, self.has_opaque = kind, len(pieces.sides), pieces.has_opaque
        self._used = [k for k, s in enumerate(numbers) if s.constant is None]  # others are structural zeros
        inputs = [*(numbers[k] for k in self._used), t, *q, *v, *pieces.sides]
        self._loads = ScalarProgram(graph, inputs, pieces.outputs)
        self._conditions = [ScalarProgram(graph, inputs, [way.condition]) for way in pieces.ways]
        self.turns = [(way.side, way.factor, way.shift) for way in pieces.ways]
        self.renewal = ScalarProgram(graph, inputs, pieces.renewed)
        self.by_velocity = [any(map(program.uses, v)) for program in self._conditions]

    def inputs(self, numbers: Sequence[Any], t: Any, q: Iterable[Any], v: Iterable[Any], sides: Iterable[Any]) -> list[Any]:
        """Return the values of the inputs of the programs in their order, without structural zeros among the numbers."""
        return [*(numbers[k] for k in self._used), t, *q, *v, *sides]

    def loads(self, of: Any, sides: Any, t: Any, q: Iterable[Any], v: Iterable[Any]) -> list[Any]:
        """Return the loads at a state with held sides; `of` is the force element, or the numbers of the system."""
        return self._loads(self.inputs(SmoothLoads.numbers(of), t, q, v, sides))

    def condition(self, index: int, of: Any, sides: Any, t: Any, q: Iterable[Any], v: Iterable[Any]) -> Any:
        """Return the value of a condition by its index: where it crosses zero, the loads change their smooth form."""
        return self._conditions[index](self.inputs(SmoothLoads.numbers(of), t, q, v, sides))[0]

    def state(self, frames: Sequence[Frame]) -> tuple[list[Any], list[Any]]:
        """Return q and v of the bodies of an element, from all of its frames; v is zero for frames without velocities."""
        assert self.kind is not None  # loads of an element
        moving = [f for f, fixed in zip(frames, self.kind.ground, strict=True) if not fixed]
        q, v = ([getattr(f, x) for f in moving for x in names] for names in (("x", "y", "angle"), ("vx", "vy", "omega")))
        return q, [0.0 if x is None else x for x in v]

    @staticmethod
    def numbers(tree: Any) -> list[Any]:
        """Return the numbers of an element or of a system, one by one."""
        return [x for leaf in jax.tree.leaves(tree) for x in jnp.ravel(leaf)]

    @classmethod
    def of_element(cls, element: ForceElement, frames: Sequence[str], breaks: bool) -> "SmoothLoads":
        """Return the smooth loads of an element attached to `frames`, names of bodies or the ground.

        `breaks`: breakpoints list all kinks in time, so that comparisons of time alone are not held.
        """
        return _of_element(traced_loads(element, frames), breaks)

    @classmethod
    def of_functions(cls, functions: SystemFunctions, breaks: bool) -> "SmoothLoads":
        """Return the smooth loads of a system; `breaks` is as in `of_element`."""
        return _of_functions(functions, breaks)

    def held(self, functions: SystemFunctions) -> SystemFunctions:
        """Return the functions of a system with its smooth loads, whose sides are one more array of numbers."""
        return _held(self, functions)


@lru_cache(maxsize=256)
def _of_element(traced: TracedLoads, breaks: bool) -> SmoothLoads:
    n = len(traced.velocities)
    place = len(traced.inputs) - 2 * n  # of q
    state = traced.inputs[place - 1], traced.inputs[place : place + n], traced.velocities
    moving = ("q", "v") if breaks else ("q", "v", "time")
    return SmoothLoads(traced.graph, traced.inputs[: place - 1], state, traced.loads, moving, traced.kind)


@lru_cache(maxsize=64)
def _of_functions(functions: SystemFunctions, breaks: bool) -> SmoothLoads:
    numbers = [s for array in functions.numbers for s in array.flat]
    state = functions.t, functions.q, functions.v
    return SmoothLoads(functions.graph, numbers, state, functions.force, functions.moving(breaks))


@lru_cache(maxsize=64)
def _held(smooth: SmoothLoads, functions: SystemFunctions) -> SystemFunctions:
    def force(numbers: Sequence[Any], t: Any, q: Any, v: Any) -> Array:
        *of_system, sides = numbers
        return jnp.stack(smooth.loads(of_system, sides, t, q, v))

    return functions.with_force(force, smooth.count)
