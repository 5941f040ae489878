"""Positions of batches of mechanisms that differ in free numbers, with exact derivatives, by machine code in SIMD lanes."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from udkjax.equations.programs.position_programs import PositionPrograms, TracedModel, trace_model
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.native.closing.positions import PositionCode
from udkjax.native.language.program import UnsupportedError
from udkjax.positions.following.drive import Drive, Driven, drive
from udkjax.positions.following.free_numbers import FreeNumbers, position_model
from udkjax.printing import PrintedTable, PrintsTable, prints_table, units
from udkjax.requirements import concrete_only, require_finite
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError


class BatchPositions(PrintsTable):
    """Positions of M members at T values; NaN where a member does not reach a value on its branch.

    Attributes:
        q: x, y (m) and angle (rad) of each body, (M, T, bodies, 3).
        dq: derivatives of q with respect to the value, (M, T, bodies, 3); None if not requested.
        by_parameters: derivatives of q with respect to the free numbers, (M, T, bodies, 3, P), in the order of `entries`; None if
            not requested.
        reached: whether a member reached a value (M, T).
        transmission: distance of a position from a meeting of branches (M, T), from 0 to 1, with the sign of the branch; for a
            four-bar the sine of the transmission angle.
        entries: the names of the P entries of the free numbers.
        bodies: the names of the bodies.
    """

    q: Float[np.ndarray, "M T bodies 3"]
    dq: Float[np.ndarray, "M T bodies 3"] | None
    by_parameters: Float[np.ndarray, "M T bodies 3 P"] | None
    transmission: Float[np.ndarray, "M T"]
    reached: Bool[np.ndarray, "M T"]
    entries: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[str, ...] = eqx.field(static=True)

    _units = units(q="m, m, rad")

    def _table(self) -> PrintedTable:
        M, T = self.reached.shape
        rows = [("reached", f"{int(self.reached.sum())} of {M * T}"), ("bodies", ", ".join(self.bodies))]
        return PrintedTable(f"positions of {M} members at {T} values", [*rows, ("free", ", ".join(self.entries))])


@prints_table
class PositionBatch:
    """Positions of a driven mechanism for batches of its numbers, compiled once.

    Each member follows its branch from its closed initial guess as far as the branch extends; members run in vector lanes and
    on all cores. Psi(s, q) = 0 is solved to machine precision; with E = Psi_q, dq/ds = -E^+ Psi_s and dq/dx = -E^+ Psi_x, by one
    elimination. Constraints may be redundant.

    Args:
        mechanism: a mechanism of one degree of freedom once its drivers hold.
        driver: a driver or coordinate, as for `kinematics`.
        free: names of the numbers in which members differ: `pin.A`, `pin.C[0]`, `joint.B.points`.
        derivatives: whether to compute derivatives with respect to the value and the free numbers.

    Raises:
        SceneError: no such driver or number, positions do not follow from the driver, or machine code cannot evaluate an
            element of the mechanism.
    """

    @checked
    @concrete_only()
    def __init__(self, mechanism: Mechanism, driver: Drive, free: Sequence[str], derivatives: bool = False):
        self.free = FreeNumbers(mechanism, free)
        self._driven = drive(mechanism, driver)
        coordinates = 3 * len(mechanism.body_names)
        model = position_model(self.free, driver, lambda *_: jnp.zeros(0))
        traced = trace_model(model, self.free.count, coordinates)
        self._programs, self._code = compile_positions(
            mechanism, traced, self.free.count, coordinates, positions=True, derivatives=derivatives,
            rows=np.asarray(self._driven.analysis.scales.rows),
        )  # fmt: skip
        self._unit = coordinate_units(self._driven)

    def __call__(
        self,
        parameters: Mapping[str, Float[ArrayLike, "M ..."]],
        values: Float[ArrayLike, "T"] | Float[ArrayLike, "M T"] | Sequence[float],
        threads: int | None = None,
    ) -> BatchPositions:
        """Return the positions of all members over the values of the driver.

        Args:
            parameters: the free numbers of each member by name, (M, ...).
            values: values of the driver (rad, m; s if all drivers follow time), shared by all members or one row for each, in the
                order in which they are reached.
            threads: number of threads; by default the number of cores, or `UDKJAX_THREADS`.

        Raises:
            SceneError: a free number is missing or has another shape.
            ValueError: values are not finite, or not of shape (T,) or (M, T).
        """
        x, s = self.free.join(parameters), np.asarray(values, float)
        require_finite("values", s)
        if s.ndim not in (1, 2) or (s.ndim == 2 and len(s) != len(x)):
            raise ValueError(f"values must have the shape (T,), or ({len(x)}, T) for {len(x)} members, not {s.shape}")
        found = self._code(x, s, self._unit, longest=CLOSURE.longest_step * float(self._driven.unit), threads=threads)
        return self._arrange(*found)

    def _table(self) -> PrintedTable:
        rows = [("bodies", ", ".join(self.free.mechanism.body_names)), ("free", ", ".join(self.free.entries()))]
        return PrintedTable("positions in batches", rows)

    _shapes = _table  # the numbers are in compiled code

    def _arrange(self, q: np.ndarray, out: np.ndarray, end: np.ndarray) -> BatchPositions:
        M, T, n = q.shape
        programs, dq, by_parameters = self._programs, None, None
        step = programs.output_count // len(programs.places)
        if step > 1:
            table = out.reshape(M, T, -1, step)[:, :, :n]
            dq = table[..., 1].reshape(M, T, -1, 3)
            by_parameters = table[..., 2:].reshape(M, T, n // 3, 3, step - 2)
        transmission, reached, q = out[..., programs.places[-1].value], np.isfinite(end), q.reshape(M, T, -1, 3)
        bodies = self.free.mechanism.body_names
        return BatchPositions(q, dq, by_parameters, transmission, reached, tuple(self.free.entries()), bodies)


def coordinate_units(driven: Driven) -> Float[np.ndarray, "n"]:
    """Return the units of x, y (the characteristic length) and angle (1 rad) of each body."""
    return np.asarray(driven.analysis.scales.coordinates(driven.analysis.coordinates))


def compile_positions(
    mechanism: Mechanism, model: TracedModel, parameters: int, coordinates: int, **choices: Any
) -> tuple[PositionPrograms, PositionCode]:
    """Return the programs of a model, and their machine code.

    Args:
        mechanism: the mechanism, which errors name.
        model: the traced function of `position_model`.
        parameters: the number of parameters x.
        coordinates: the number of coordinates q.
        **choices: other arguments of `PositionPrograms`.

    Raises:
        SceneError: positions do not follow from the driver, or machine code has no instruction for an operation.
    """
    try:
        programs = PositionPrograms(model, parameters, coordinates, **choices)
    except ValueError as problem:
        raise SceneError([f"positions do not follow from the driver: {problem}"], mechanism.name) from None
    try:
        return programs, PositionCode(programs)
    except UnsupportedError as problem:
        raise SceneError([f"machine code has no instruction for {problem}"], mechanism.name) from None
