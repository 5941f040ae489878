"""The operations of machine code that compute positions: closing with its derivatives, and following the positions of a drive."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from udkjax.native.closing.closing import Closing
from udkjax.native.closing.closing_derivatives import ClosingForward, ClosingReverse, ClosingTwice
from udkjax.native.closing.marching import Marching
from udkjax.native.module.module import Module
from udkjax.native.operations import Operation


@dataclass(frozen=True)
class Close(Operation):
    """The operation that closes a mechanism. Its outputs are the state, the remaining Psi and Psi_dot, and the rank of Psi_q."""

    settings: ClassVar[tuple[str, ...]] = Closing.settings
    in_lanes: ClassVar[bool] = False
    results: ClassVar[int] = len(Closing.results)

    def with_tangents(self, active: tuple[bool, ...]) -> "CloseTangents":
        """Return the operation that also computes tangents of the state along directions of the active numbers."""
        return CloseTangents(self.code, active)

    def with_second_tangents(self, active: tuple[bool, ...]) -> "CloseSecondTangents":
        """Return the operation that computes second derivatives of the state along pairs of directions of the active numbers."""
        return CloseSecondTangents(self.code, active)

    def with_cotangents(self, active: tuple[bool, ...]) -> "CloseCotangents":
        """Return the operation that pulls cotangents back to the active numbers and the guess."""
        return CloseCotangents(self.code, active)

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return Closing(self.code, vector)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        return [(2 * self.code.coordinate_count,), (2 * self.code.row_count,), (1,)]


@dataclass(frozen=True)
class CloseTangents(Close):
    """The operation that closes a mechanism and computes the tangents of the state along directions."""

    active: tuple[bool, ...] = ()

    @property
    def tangents(self) -> int:
        return 3

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return ClosingForward(self.code, vector, self.active)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        return [*super().outputs(inputs, times), (inputs[-1].shape[1], 2 * self.code.coordinate_count)]


@dataclass(frozen=True)
class CloseSecondTangents(CloseTangents):
    """The operation that closes a mechanism and computes the second derivatives of the state along pairs of directions."""

    @property
    def tangents(self) -> int:
        return 6

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return ClosingTwice(self.code, vector, self.active)


@dataclass(frozen=True)
class CloseCotangents(Close):
    """The operation that closes a mechanism and pulls cotangents of the state back to all numbers and to the guess."""

    active: tuple[bool, ...] = ()

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return ClosingReverse(self.code, vector, self.active)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        n = self.code.coordinate_count
        return [*super().outputs(inputs, times), (self.code.number_count,), (n,), (n,)]


@dataclass(frozen=True)
class March(Operation):
    """The operation that follows the positions of a driven mechanism over the values of its driver (closing/marching.py).

    Its outputs are q, q', q'' and the side of the position at each value, the number of sound positions, and the last value that
    was reached.
    """

    settings: ClassVar[tuple[str, ...]] = Marching.settings

    def module(self, width: int, tangent_lanes: int, vector: int) -> Module:
        return Marching(self.code, width, vector)

    def outputs(self, inputs: Sequence[Any], times: int) -> list[tuple[int, ...]]:
        return [*[(times, self.code.coordinate_count)] * 3, (times,), (1,), (1,)]
