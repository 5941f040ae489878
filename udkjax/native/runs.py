"""The operations of machine code that integrate: a run, a run up to an event, and runs with derivatives."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

from udkjax.native.derivatives import record
from udkjax.native.derivatives.backpropagation import Reverse
from udkjax.native.derivatives.second_tangents import ForwardTwice
from udkjax.native.derivatives.state_tangents import StateTangents
from udkjax.native.derivatives.tangents import Forward
from udkjax.native.module.layout import INFO_NAMES, INPUTS, Plan
from udkjax.native.module.module import Module
from udkjax.native.module.tableau import EULER, KVAERNO5, Method
from udkjax.native.operations import Accelerate, Operation
from udkjax.native.parts.formulations import FormulationCode
from udkjax.native.parts.own_stabilization import StabilizationCode
from udkjax.native.pseudoinverses.dense import DenseMethod
from udkjax.native.run.trajectory import Trajectory
from udkjax.native.watching.conditions import Conditions
from udkjax.native.watching.passed_events import Passing, SlideLock, Sliding, Turning
from udkjax.native.watching.watching import Watching


@dataclass(frozen=True)
class RunStates(Operation):
    """The operation that integrates.

    Its outputs are q, v and the violation of Psi at each output time, and the numbers `INFO_NAMES` that describe the end of the
    run.
    """

    method: Method
    projected: bool
    breaks: bool  # whether there are breakpoints, or pieces of the state
    sampled: tuple[int, ...] = ()  # indices of the numbers that have samples
    pseudoinverse: DenseMethod | None = None  # None: elimination
    formulation: FormulationCode | None = None  # None: the Udwadia-Kalaba equation
    changes: bool = False  # whether a run goes on by an implicit method, Kvaerno's, where stability limits an explicit one
    leaves: bool = False  # whether it does so by the module of `later`
    stabilization: StabilizationCode | None = None  # the user's own

    info_names: ClassVar[tuple[str, ...]] = INFO_NAMES  # names of the first numbers of the output "info", before the last q and v

    @property
    def all_settings(self) -> tuple[str, ...]:
        parts = self.formulation, self.stabilization
        return (*self.settings, *(name for part in parts if part is not None for name in part.settings))

    @property
    def closes(self) -> bool:
        """True if the formulation closes the state at each stage, as coordinate partitioning does.

        Derivatives are then those of a run by the Udwadia-Kalaba equation.
        """
        return self.formulation is not None and self.formulation.closes

    def plan(self, width: int, vector: int) -> Plan:
        """Return the plan of the module, for `width` lanes and registers of `vector` numbers."""
        return Plan(
            code=self.code,
            method=self.method,
            projected=self.projected,
            breaks=self.breaks,
            width=width,
            vector=vector,
            unrolled=self.code.is_small,
            sampled=self.sampled,
            pseudoinverse=self.pseudoinverse,
            formulation=self.formulation,
            stiff=KVAERNO5 if self.changes and not self.leaves else None,
            leaves=self.leaves,
            stabilization=self.stabilization,
        )

    def stabilized(self, stabilization: Any, methods: Mapping[str, Callable[..., Any]]) -> "RunStates":
        """Return this operation with a user-defined stabilization (`udkjax.integrate.stabilization`).

        Args:
            stabilization: The stabilization.
            methods: The methods that the user has defined, by name: "rates", "end_of_step" or both.

        Raises:
            UnsupportedError: A method uses an operation without machine code; the message names it.
        """
        return replace(self, changes=False, stabilization=StabilizationCode.of(stabilization, methods, self.code))

    @property
    def first(self) -> "RunStates":
        return replace(self, leaves=self.changes)

    @property
    def later(self) -> "RunStates | None":
        return replace(self, leaves=False) if self.leaves else None

    @property
    def accelerations(self) -> Accelerate:
        """The operation that computes accelerations at single states, by the same pseudoinverse and formulation."""
        return Accelerate(self.code, self.pseudoinverse, self.formulation)

    @property
    def acceleration_tangents(self) -> "AccelerateTangents":
        """The operation that computes accelerations at single states with their tangents."""
        return AccelerateTangents(self.code)

    def with_tangents(self, active: tuple[bool, ...]) -> "RunTangents":
        """Return the operation that also computes tangents along directions.

        Directions are changes of the numbers of the scene marked in `active`, and of the initial state.
        """
        return RunTangents(**self._for_derivatives, active=active)

    def with_second_tangents(self, active: tuple[bool, ...]) -> "RunSecondTangents":
        """Return the operation that also computes second derivatives along pairs of directions (see `with_tangents`)."""
        return RunSecondTangents(**self._for_derivatives, active=active)

    def with_cotangents(self, active: tuple[bool, ...], breakpoints: int = 0, points: int | None = None) -> "RunCotangents":
        """Return the operation that backpropagates to the active numbers along a record.

        Args:
            active: for each number of the scene, True if its derivative is needed.
            breakpoints: number of times where the motion is not smooth.
            points: capacity of the record of a run, in accepted states; None: a capacity that is sufficient for most runs.
        """
        points = points or record.STORED_POINTS + record.PER_BREAKPOINT * breakpoints
        return RunCotangents(**self._for_derivatives, active=active, points=points)

    def watching(
        self, conditions: Conditions, kinks: dict[str, Any] | None = None, slides: dict[str, Any] | None = None, **passing: Any
    ) -> "RunWatched":
        """Return the operation that integrates up to the first crossing of conditions.

        Args:
            conditions: The conditions.
            kinks: The fields of `Turning`; None: each kink ends the run.
            slides: The fields of `Sliding`; None: each event of a joint that may stick ends the run.
            passing: The other fields of `Passing`.
        """
        own = {item.name: getattr(self, item.name) for item in fields(self)}
        turning = None if kinks is None else Turning(**kinks)
        sliding = None if slides is None else _sliding(**slides)
        passes = turning is not None or sliding is not None
        return RunWatched(**own, conditions=conditions, passing=Passing(turning, sliding, **passing) if passes else None)

    @property
    def _for_derivatives(self) -> dict[str, Any]:
        """The fields, by name, of the operation that is differentiated: without a formulation that `closes` states."""
        changed = {"code": self.code.for_derivatives} | ({"formulation": None} if self.closes else {})
        return {item.name: getattr(self, item.name) for item in fields(self)} | changed

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return Trajectory(self.plan(width, vector))

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        n = self.code.coordinate_count
        return [(times, n), (times, n), (times,), (len(INFO_NAMES) + 2 * n,)]


@dataclass(frozen=True)
class RunWatched(RunStates):
    """The operation that integrates up to the first crossing of conditions, or until a crossing cannot be ruled out."""

    conditions: Conditions | None = None
    passing: Passing | None = None  # events that are recorded, and do not end the run

    @property
    def unwatched(self) -> RunStates:
        """The operation that integrates to the last time, without watching conditions."""
        return RunStates(**{item.name: getattr(self, item.name) for item in fields(RunStates)})

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        assert self.conditions is not None
        return Watching(self.plan(width, vector), self.conditions, self.passing)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        assert self.conditions is not None
        n = self.code.coordinate_count
        passed = [(self.passing.record_length(n),)] if self.passing else []
        return [*super().outputs(inputs, times), (self.conditions.output_count(n),), *passed]


@dataclass(frozen=True)
class RunTangents(RunStates):
    """The operation that integrates and computes the tangents of all output states, and of the last state, along directions."""

    active: tuple[bool, ...] = ()  # for each number of the scene, whether derivatives with respect to it are needed

    @property
    def tangents(self) -> int:
        return 4 if self.sampled else 3

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return Forward(self.plan(width, vector), self.active, max(width, tangent_lanes))

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        directions, n = inputs[-1].shape[1], self.code.coordinate_count
        changes = [(directions, times, 2 * n), (directions, 2 * n)]
        return [*super().outputs(inputs, times), *changes]


@dataclass(frozen=True)
class AccelerateTangents(Accelerate):
    """The operation that computes the accelerations of states with their tangents.

    Directions are changes of all numbers of the scene, and of the state.
    """

    @property
    def tangents(self) -> int:
        return 3

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        code = self.code.for_derivatives
        plan = Plan(code, EULER, projected=False, breaks=False, width=width, vector=vector, unrolled=code.is_small)
        return StateTangents(plan, (True,) * code.number_count, max(width, tangent_lanes))

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        return [*super().outputs(inputs, times), (inputs[-1].shape[1], self.code.coordinate_count)]


@dataclass(frozen=True)
class RunSecondTangents(RunTangents):
    """The operation that integrates and computes second derivatives of the states, and of the end, along pairs of directions."""

    @property
    def tangents(self) -> int:
        return 2 * super().tangents

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return ForwardTwice(self.plan(width, vector), self.active, max(width, tangent_lanes))


@dataclass(frozen=True)
class RunCotangents(RunStates):
    """The operation of reverse mode, which a gradient calls twice.

    Without cotangents, the first pass integrates and returns a record. With cotangents of the states and of the end, the second
    pass backpropagates along the record to all numbers. Outputs that belong to the other pass are empty.
    """

    active: tuple[bool, ...] = ()
    points: int = record.STORED_POINTS  # capacity of the record of a run; without capacity, runs are integrated again

    @property
    def record_length(self) -> int:
        """The length of the record of one member, in numbers; 0 if records are not stored."""
        return self.points and record.record_length(self.code.coordinate_count, self.points)

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return Reverse(self.plan(width, vector), self.active)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        n, results = self.code.coordinate_count, super().outputs(inputs, times)
        bars: list[tuple[int, ...]] = [(self.code.number_count,), (n,), (n,)]
        if self.sampled:
            bars.append((inputs[INPUTS.index("breaks")].shape[1] + 1, len(self.sampled)))
        if goes_back(inputs):
            return [*map(_empty, results), *bars, (0,)]
        return [*results, *map(_empty, bars), (self.record_length,)]


def _sliding(locks: Sequence[dict[str, Any]], **others: Any) -> Sliding:
    return Sliding(locks=tuple(SlideLock(**x) for x in locks), **others)


def goes_back(inputs: Sequence[Any]) -> bool:
    """Return True if the inputs of reverse mode are those of its second pass, with cotangents."""
    return inputs[-1].shape[-2] > 0


def _empty(shape: tuple[int, ...]) -> tuple[int, ...]:
    return (0, *shape[1:])
