"""The operations of machine code: a class for each, with its module and the shapes of its inputs and outputs.

An operation determines its machine code except for the number of lanes. The first axis of all inputs and outputs is the axis of
members; an input that all members share has length one along this axis. runs.py has the operations that integrate,
position_operations.py those that compute positions.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.terms.structure import numbers_as_vector
from udkjax.native.module.layout import INPUTS, MEMBERS_PER_THREAD, OUTPUTS, SETTINGS
from udkjax.native.module.memory import Memory
from udkjax.native.module.module import Module
from udkjax.native.parts.formulations import FormulationCode
from udkjax.native.pseudoinverses.dense import DenseMethod
from udkjax.native.run.row_marks import RowMarks
from udkjax.native.run.state_functions import (
    ScaleCode,
    StateAccelerations,
    StateFunction,
    StateJump,
    StateProjection,
    StateReactions,
    StateTangentPart,
)
from udkjax.native.watching.conditions import Conditions
from udkjax.native.watching.event_states import EventStates


@dataclass(frozen=True)
class Operation(ABC):
    """A computation by machine code for each member of a batch: scenes with the programs `code`, each with its own numbers."""

    code: RunPrograms

    input_names: ClassVar[tuple[str, ...]] = INPUTS  # names of the first inputs
    settings: ClassVar[tuple[str, ...]] = SETTINGS  # names of the settings of this kind of operation
    in_lanes: ClassVar[bool] = True  # whether members run in lanes
    results: ClassVar[int] = len(OUTPUTS)  # number of outputs without directions, which come first
    share: ClassVar[int] = MEMBERS_PER_THREAD  # minimum number of members of a thread

    @property
    def all_settings(self) -> tuple[str, ...]:
        """The names of all settings in the input "settings", in their order, including those of a formulation if there is one."""
        return self.settings

    @property
    def tangents(self) -> int:
        """The number of inputs that have an axis of directions; these inputs are the last. 0: there are no tangents."""
        return 0

    @property
    def first(self) -> "Operation":
        """The operation with which calls begin: this one, or a variant whose module can pass members on to that of `later`."""
        return self

    @property
    def later(self) -> "Operation | None":
        """The operation whose module takes over members that leave the module of this operation; None: members never leave."""
        return None

    @abstractmethod
    def module(self, width: int, tangent_lanes: int, vector: int) -> Memory:
        """Return the module for a number of lanes.

        Args:
            width: The number of lanes.
            tangent_lanes: The number of directions that are computed together, in lanes, if there is a single member.
            vector: The number of float64 numbers in a register.
        """

    @abstractmethod
    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        """Return the shapes of the outputs of one member, without the axis of members; `times`: the number of output times."""

    def shapes(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        """Return the shapes of the outputs of all members, (members, ...)."""
        members = max([x.shape[0] for x in inputs])
        return [(members, *shape) for shape in self.outputs(inputs, times)]

    def pack(
        self,
        numbers: Sequence[ArrayLike],
        ts: ArrayLike,
        q: ArrayLike,
        v: ArrayLike,
        settings: Mapping[str, ArrayLike],
        rows: ArrayLike,
        breaks: ArrayLike | tuple[()] = (),
        xp: ModuleType = jnp,
        further: Sequence[ArrayLike] = (),
    ) -> list[Any]:
        """Return the inputs of one member as arrays, in the order in which the machine code takes them.

        Args:
            numbers: All numbers of the scene and the two thresholds of pivots.
            ts: Times (s).
            q: Positions (n,).
            v: Velocities (n,).
            settings: Settings by name; settings of other operations are ignored.
            rows: The scales of the rows of Psi.
            breaks: Times (s) where the motion is not smooth, in their order.
            xp: The library of the arrays: `jax.numpy`, whose arrays pass on no derivatives, or NumPy for concrete numbers.
            further: The inputs of this operation beyond those above, each without the axis of members.

        Returns:
            Arrays of float64, (1, ...).
        """
        as_vector = partial(np.concatenate, axis=None) if xp is np else numbers_as_vector
        values = [settings[name] for name in self.all_settings]
        inputs = (as_vector(numbers), ts, q, v, as_vector(values), rows, breaks, *further)
        arrays = [xp.asarray(x, float)[None] for x in inputs]
        return arrays if xp is np else jax.lax.stop_gradient(arrays)


@dataclass(frozen=True)
class StateOperation(Operation):
    """An operation that is evaluated at single states, without integration."""

    pseudoinverse: DenseMethod | None = None  # None: elimination
    formulation: FormulationCode | None = None  # None: the Udwadia-Kalaba equation

    settings: ClassVar[tuple[str, ...]] = StateFunction.settings
    share: ClassVar[int] = 32 * MEMBERS_PER_THREAD  # a state takes a microsecond
    function: ClassVar[type[StateFunction]]

    @property
    def all_settings(self) -> tuple[str, ...]:
        return (*self.settings, *(self.formulation.settings if self.formulation else ()))

    @property
    def projection(self) -> "ProjectStates":
        """The operation that projects states onto the constraint manifold."""
        return ProjectStates(self.code, self.pseudoinverse, self.formulation)

    @property
    def reactions(self) -> "FindReactions":
        """The operation that computes the multipliers of states; it requires a dense pseudoinverse."""
        return FindReactions(self.code, self.pseudoinverse, self.formulation)

    @property
    def jump(self) -> "ProjectJump":
        """The operation that projects states after events, and returns by how much velocities then violate the constraints."""
        return ProjectJump(self.code, self.pseudoinverse, self.formulation)

    @property
    def tangent_part(self) -> "FindTangentPart":
        """The operation that computes the tangent part of small changes of states."""
        return FindTangentPart(self.code, self.pseudoinverse, self.formulation)

    def of_events(self, conditions: Conditions, directed: tuple[int, ...]) -> "EvaluateEvents":
        """Return the operation that evaluates conditions and, for those with indices in `directed`, directions of impulses."""
        return EvaluateEvents(self.code, self.pseudoinverse, self.formulation, conditions, directed)

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return self.function(self.code, self.pseudoinverse, self.formulation, width, vector)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        return [(len(self.function.found) * self.code.coordinate_count,)]


class Accelerate(StateOperation):
    """The operation that computes the accelerations of states."""

    function = StateAccelerations


class FindReactions(StateOperation):
    """The operation that computes, for each state, the multipliers of all rows by a dense method, and the entries of Psi_q."""

    function = StateReactions

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        return [(self.code.row_count + self.code.scratch["psi_q"],)]


class ProjectStates(StateOperation):
    """The operation that projects states onto the constraint manifold."""

    function = StateProjection


class ProjectJump(StateOperation):
    """The operation that projects states after events onto the constraint manifold.

    It also returns the largest row of Psi_dot that remains, divided by the scale of the row.
    """

    function = StateJump

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        return [(2 * self.code.coordinate_count + 1,)]


class FindTangentPart(StateOperation):
    """The operation that computes the tangent part of small changes of states."""

    function = StateTangentPart


@dataclass(frozen=True)
class EvaluateEvents(StateOperation):
    """The operation that computes accelerations, conditions, directions of impulses and forces (watching/event_states.py)."""

    conditions: Conditions | None = None
    directed: tuple[int, ...] = ()  # indices of the conditions with directions of impulses

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        assert self.conditions is not None
        plan = self.pseudoinverse, self.formulation, width, vector
        return EventStates(self.code, self.conditions, self.directed, *plan)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        assert self.conditions is not None
        directions = len(self.directed) * self.code.coordinate_count * (2 if self.code.has_mobility else 1)
        values = len(self.conditions.at_state.outputs) + self.conditions.force_count + (self.conditions.forces is not None)
        return [(self.code.coordinate_count + values + directions,)]


@dataclass(frozen=True)
class MarkRows(Operation):
    """The operation that marks the rows of Psi that are independent near a position: one for these rows, zero for others."""

    settings: ClassVar[tuple[str, ...]] = RowMarks.settings

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return RowMarks(self.code, width, vector)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        return [(self.code.row_count,)]


@dataclass(frozen=True)
class FindScales(Operation):
    """The operation that computes the characteristic scales from the numbers of a scene."""

    settings: ClassVar[tuple[str, ...]] = ()
    in_lanes: ClassVar[bool] = False
    results: ClassVar[int] = len(ScaleCode.results)
    share: ClassVar[int] = 32 * MEMBERS_PER_THREAD  # a member takes a microsecond

    def module(self, width: int, tangent_lanes: int, vector: int) -> Memory:
        return ScaleCode(self.code)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        return [(self.code.scale_count,)]
