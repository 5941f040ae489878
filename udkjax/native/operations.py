"""The operations of machine code: a class for each, with its module and the shapes of its outputs.

An operation is all that its code depends on but the number of lanes. Inputs and outputs have the members first; an input that
all members share has only one.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from udkjax.equations.scene_programs import ScenePrograms
from udkjax.native.backpropagation import Reverse
from udkjax.native.closing import Closing
from udkjax.native.closing_derivatives import ClosingForward, ClosingReverse, ClosingTwice
from udkjax.native.conditions import Conditions
from udkjax.native.event_states import EventStates
from udkjax.native.formulations import FormulationCode
from udkjax.native.layout import FORMULATION_SETTINGS, INFO, INPUTS, OUTPUTS, SETTINGS, SHARE, Plan
from udkjax.native.marching import Marching
from udkjax.native.module import Module
from udkjax.native.pseudoinverses.dense import DenseMethod
from udkjax.native.record import STORED, record_length
from udkjax.native.row_marks import RowMarks
from udkjax.native.state_functions import StateAccelerations, StateFunction, StateProjection, StateTangentPart
from udkjax.native.tableau import Method
from udkjax.native.tangents import Forward, ForwardTwice
from udkjax.native.trajectory import Trajectory
from udkjax.native.watching import Watching

Shape = tuple[int, ...]


class Tableau:
    """A method, to be looked up by its numbers."""

    def __init__(self, method: Method):
        self.method = method
        self._key = tuple(np.asarray(x).tobytes() for x in method)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tableau) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@dataclass(frozen=True)
class Operation(ABC):
    """An operation on members of a scene."""

    code: ScenePrograms

    settings: ClassVar[tuple[str, ...]] = SETTINGS  # settings of this kind of operation
    in_lanes: ClassVar[bool] = True  # whether members run side by side
    results: ClassVar[int] = len(OUTPUTS)  # the first outputs, which have no directions
    share: ClassVar[int] = SHARE  # members of a thread, at least
    is_reverse: ClassVar[bool] = False  # whether it runs and walks back in two passes, each without what the other finds

    @property
    def all_settings(self) -> tuple[str, ...]:
        """The names of the settings that it takes."""
        return self.settings

    @property
    def tangents(self) -> int:
        """The number of the last inputs, which have directions."""
        return 0

    @abstractmethod
    def module(self, width: int, beside: int, vector: int) -> Module:
        """Return the module in so many lanes.

        Args:
            width: The number of lanes.
            beside: Number of directions of a single member side by side.
            vector: Number of float64 numbers in a register.
        """

    @abstractmethod
    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        """Return the shapes of the outputs."""

    def shapes(self, inputs: Sequence[Any], times: int) -> list[Shape]:
        """Return the shapes of the outputs, from inputs."""
        return self.outputs(inputs, max([x.shape[0] for x in inputs]), times)

    @property
    def coordinates(self) -> int:
        """The number of coordinates n."""
        return self.code.coordinate_count


@dataclass(frozen=True)
class RunStates(Operation):
    """Integrate: q, v, the violation of Psi, and how the run ended."""

    method: Tableau
    projected: bool
    breaks: bool  # whether there are times, or pieces of the state, where the motion is not smooth
    sampled: tuple[int, ...] = ()  # places of the numbers that have samples
    pseudoinverse: DenseMethod | None = None  # None: elimination
    formulation: FormulationCode | None = None  # None: the Udwadia-Kalaba equation

    @property
    def all_settings(self) -> tuple[str, ...]:
        return (*self.settings, *(FORMULATION_SETTINGS if self.formulation else ()))

    def plan(self, width: int, vector: int) -> Plan:
        """Return what the module's code depends on."""
        return Plan(
            code=self.code,
            method=self.method.method,
            projected=self.projected,
            breaks=self.breaks,
            width=width,
            vector=vector,
            written_out=self.code.is_small,
            sampled=self.sampled,
            pseudoinverse=self.pseudoinverse,
            formulation=self.formulation,
        )

    def with_tangents(self, active: tuple[bool, ...]) -> "RunTangents":
        """Return the operation that integrates along directions of what is active of the numbers of the scene, too."""
        return RunTangents(**self._for_derivatives, active=active)

    def with_second_tangents(self, active: tuple[bool, ...]) -> "RunSecondTangents":
        """Return the operation that finds second derivatives along pairs of directions of what is active."""
        return RunSecondTangents(**self._for_derivatives, active=active)

    def with_cotangents(self, active: tuple[bool, ...], points: int) -> "RunCotangents":
        """Return the operation that walks back to the numbers that are active, by a record of so many points."""
        return RunCotangents(**self._for_derivatives, active=active, points=points)

    def watching(self, conditions: Conditions) -> "RunWatched":
        """Return the operation that integrates up to the first crossing of conditions."""
        return RunWatched(**{each.name: getattr(self, each.name) for each in fields(self)}, conditions=conditions)

    @property
    def _for_derivatives(self) -> dict[str, Any]:
        """The fields of the same operation with derivatives."""
        return {each.name: getattr(self, each.name) for each in fields(self)} | {"code": self.code.for_derivatives}

    def module(self, width: int, beside: int, vector: int) -> Module:
        return Trajectory(self.plan(width, vector))

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        n = self.coordinates
        return [(members, times, n), (members, times, n), (members, times), (members, len(INFO) + 2 * n)]


@dataclass(frozen=True)
class RunWatched(RunStates):
    """Integrate up to the first crossing of conditions, or to where one cannot be ruled out."""

    conditions: Conditions | None = None

    def module(self, width: int, several: bool, vector: int) -> Module:
        assert self.conditions is not None
        return Watching(self.plan(width, vector), self.conditions)

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        assert self.conditions is not None
        return [*super().outputs(inputs, members, times), (members, self.conditions.output_count(self.coordinates))]


@dataclass(frozen=True)
class RunTangents(RunStates):
    """Integrate, with the changes of the states and of the end along directions."""

    active: tuple[bool, ...] = ()  # of the numbers of the scene: along which there are derivatives

    @property
    def tangents(self) -> int:
        return 4 if self.sampled else 3

    def module(self, width: int, beside: int, vector: int) -> Module:
        return Forward(self.plan(width, vector), self.active, max(width, beside))

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        directions, n = inputs[-1].shape[1], self.coordinates
        changes = [(members, directions, times, 2 * n), (members, directions, 2 * n)]
        return [*super().outputs(inputs, members, times), *changes]


@dataclass(frozen=True)
class RunSecondTangents(RunTangents):
    """Integrate, with the second derivatives of the states and of the end along pairs of directions."""

    @property
    def tangents(self) -> int:
        return 2 * super().tangents

    def module(self, width: int, beside: int, vector: int) -> Module:
        return ForwardTwice(self.plan(width, vector), self.active, max(width, beside))


@dataclass(frozen=True)
class RunCotangents(RunStates):
    """Integrate and leave a record; or, with cotangents of the states and of the end, walk back to those of all numbers."""

    active: tuple[bool, ...] = ()
    points: int = STORED  # capacity of the record of a run
    is_reverse: ClassVar[bool] = True

    def module(self, width: int, beside: int, vector: int) -> Module:
        return Reverse(self.plan(width, vector), self.active)

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        n, is_first = self.coordinates, not inputs[-1].shape[0]  # without cotangents
        bars: list[Shape] = [(members, self.code.number_count), (members, n), (members, n)]
        if self.sampled:
            bars.append((members, 0 if is_first else inputs[INPUTS.index("breaks")].shape[1] + 1, len(self.sampled)))
        record = (members, record_length(n, self.points) if is_first else 0)
        return [*super().outputs(inputs, members, times), *bars, record]


@dataclass(frozen=True)
class Close(Operation):
    """Close a mechanism: its state, what is left of Psi and Psi_dot, and the rank of Psi_q."""

    settings: ClassVar[tuple[str, ...]] = Closing.settings
    in_lanes: ClassVar[bool] = False
    results: ClassVar[int] = len(Closing.results)

    def module(self, width: int, beside: int, vector: int) -> Module:
        return Closing(self.code, vector)

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        return [(members, 2 * self.coordinates), (members, 2 * self.code.row_count), (members, 1)]


@dataclass(frozen=True)
class CloseTangents(Close):
    """Close, with the changes of the state along directions."""

    active: tuple[bool, ...] = ()

    @property
    def tangents(self) -> int:
        return 3

    def module(self, width: int, beside: int, vector: int) -> Module:
        return ClosingForward(self.code, vector, self.active)

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        return [*super().outputs(inputs, members, times), (members, inputs[-1].shape[1], 2 * self.coordinates)]


@dataclass(frozen=True)
class CloseSecondTangents(CloseTangents):
    """Close, with the second derivatives of the state along pairs of directions."""

    @property
    def tangents(self) -> int:
        return 6

    def module(self, width: int, beside: int, vector: int) -> Module:
        return ClosingTwice(self.code, vector, self.active)


@dataclass(frozen=True)
class CloseCotangents(Close):
    """Close, and walk back from cotangents of the state to those of all numbers and of the guess."""

    active: tuple[bool, ...] = ()

    def module(self, width: int, beside: int, vector: int) -> Module:
        return ClosingReverse(self.code, vector, self.active)

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        n = self.coordinates
        return [*super().outputs(inputs, members, times), (members, self.code.number_count), (members, n), (members, n)]


@dataclass(frozen=True)
class StateOperation(Operation):
    """A function of single states."""

    pseudoinverse: DenseMethod | None = None  # None: elimination
    formulation: FormulationCode | None = None  # None: the Udwadia-Kalaba equation

    settings: ClassVar[tuple[str, ...]] = StateFunction.settings
    share: ClassVar[int] = 32 * SHARE  # a state takes a microsecond
    function: ClassVar[type[StateFunction]]

    @property
    def all_settings(self) -> tuple[str, ...]:
        return (*self.settings, *(FORMULATION_SETTINGS if self.formulation else ()))

    def module(self, width: int, beside: int, vector: int) -> Module:
        return self.function(self.code, self.pseudoinverse, self.formulation, width, vector)

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        return [(members, len(self.function.found) * self.coordinates)]


class Accelerate(StateOperation):
    """Find the accelerations of states."""

    function = StateAccelerations


class ProjectStates(StateOperation):
    """Return states to the constraint manifold."""

    function = StateProjection


class FindTangentPart(StateOperation):
    """Find the part of small changes of states within the constraint manifold."""

    function = StateTangentPart


@dataclass(frozen=True)
class EvaluateEvents(StateOperation):
    """Find accelerations, conditions and directions of impulses at states."""

    conditions: Conditions | None = None
    impacts: tuple[int, ...] = ()  # of the conditions: those with directions of impulses

    def module(self, width: int, beside: int, vector: int) -> Module:
        assert self.conditions is not None
        plan = self.pseudoinverse, self.formulation, width, vector
        return EventStates(self.code, self.conditions, self.impacts, *plan)

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        assert self.conditions is not None
        directions = len(self.impacts) * self.coordinates
        return [(members, self.coordinates + len(self.conditions.at_state.outputs) + directions)]


@dataclass(frozen=True)
class MarkRows(Operation):
    """Mark the rows of Psi that are independent near a position: one for each that is, zero for others."""

    settings: ClassVar[tuple[str, ...]] = RowMarks.settings

    def module(self, width: int, beside: int, vector: int) -> Module:
        return RowMarks(self.code, width, vector)

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        return [(members, self.code.row_count)]


@dataclass(frozen=True)
class March(Operation):
    """Follow the positions of a driven mechanism over values: q, q', q'', their sides, and how many are to be relied on."""

    settings: ClassVar[tuple[str, ...]] = Marching.settings

    def module(self, width: int, beside: int, vector: int) -> Module:
        return Marching(self.code, width, vector)

    def outputs(self, inputs: Sequence[Any], members: int, times: int) -> list[Shape]:
        return [*[(members, times, self.coordinates)] * 3, (members, times), (members, 1)]
