"""Analysis of a mechanism before it moves: rank, redundant rows, and characteristic length, time and mass.

Every threshold of the package that compares lengths, times or rows in different units takes its unit from here, so that a
mechanism of a micrometre and one of a kilometre behave alike.

The length L is the longest lever arm of a constraint at the initial guess, |dPsi/dangle| / |dPsi/d(x, y)|, or the largest radius
of gyration sqrt(I/m) if that is longer. It does not depend on the origin. T is the shortest time in which anything changes at the
guess: the time in which a velocity moves a body by L, the half period pi sqrt(L / a_F) of a pendulum of length L under a free
acceleration a_F, and the corresponding times of the drivers. The scale of a row is its change by a displacement of L or a turn of
one radian.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from contextlib import nullcontext
from dataclasses import replace
from threading import Lock
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from udkjax.argument_types import checks_instances
from udkjax.arrays import is_traced, make_module, number
from udkjax.equations.programs.scales import Scales, concrete_scales, traced_scales
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.rows.balance import BalancedUnits
from udkjax.equations.rows.dense_rows import DenseRows
from udkjax.equations.rows.redundancy import FoundRows, examine_rows
from udkjax.equations.rows.stationary_rows import HeldPin, with_held_pins
from udkjax.equations.terms.structure import structure
from udkjax.printing import PrintedTable, PrintsTable, format_numbers, has_numbers
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.requirements import ArgumentError, GivenArguments
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.model import Model, RunModel

# Rank tolerance, relative to the smallest nonzero singular value of a generic position, where gears make it small. As in a scene
# without gears, it is then about a hundredth of the usual values.
GEARED_SHARE = 1e-2
ANALYSIS_CACHE_SIZE = 256  # stored analyses; the least recently used one is dropped


class Analysis(PrintsTable):
    """The result of `analyse`. A pytree: its scales are arrays, everything else is static.

    Attributes:
        scales: characteristic length, time and mass, to which thresholds are relative.
        coordinates: number of coordinates.
        row_names: for each row of Psi, its constraint and its index within that constraint.
        redundant_rows: indices of the rows that depend on others; None: unknown.
        balance: factors, powers of ten, of the units of rows and coordinates in which ranks are counted; None: all are one.
        only_switched: whether all dependent rows belong to constraints that are switched off.
    """

    scales: Scales
    coordinates: int = eqx.field(static=True)
    row_names: tuple[tuple[str, int], ...] = eqx.field(static=True)  # for each row of Psi: its constraint, its index in it
    # Rows of Psi to leave out; None if unknown: the guess cannot be closed or moved, or all numbers are traced.
    redundant_rows: tuple[int, ...] | None = eqx.field(static=True)
    balance: BalancedUnits | None = eqx.field(static=True)
    only_switched: bool = eqx.field(static=True, default=False)

    def _table(self) -> PrintedTable:
        rows = {
            "coordinates": self.coordinates,
            "constraint equations": len(self.row_names),
            "rank": "not known" if self.rank is None else self.rank,
            "degrees of freedom": "not known" if self.degrees_of_freedom is None else self.degrees_of_freedom,
            "redundant constraints": ", ".join(f"{name} (equation {row + 1})" for name, row in self.redundant) or "none",
        }
        if self.redundant_rows is None:
            rows["redundant constraints"] = "not known"
        scales = self.scales
        rows["length, mass"] = f"{format_numbers(scales.length, 'm')}, {format_numbers(scales.mass, 'kg')}"
        rows["time"] = format_numbers(self.time if has_numbers(scales.rate) else scales.rate, "s")
        return PrintedTable("analysis", list(rows.items()))

    _shapes = _table

    @property
    def redundant(self) -> tuple[tuple[str, int], ...]:
        """The redundant rows: the name of the constraint, and the index of the row within it."""
        return tuple(self.row_names[i] for i in self.redundant_rows or ())

    @property
    def independent_rows(self) -> tuple[int, ...]:
        """The rows that are not known to be redundant."""
        return tuple(i for i in range(len(self.row_names)) if i not in (self.redundant_rows or ()))

    @property
    def rank(self) -> int | None:
        """The rank of Psi_q outside singular configurations; None if unknown."""
        return None if self.redundant_rows is None else len(self.row_names) - len(self.redundant_rows)

    @property
    def degrees_of_freedom(self) -> int | None:
        """The number of coordinates minus the rank; None if unknown."""
        return None if self.rank is None else self.coordinates - self.rank

    @property
    def row_units(self) -> Any:
        """The units of rows (m,) in which ranks are counted."""
        return self.scales.rows if self.balance is None else self.scales.rows * np.asarray(self.balance.rows)

    @property
    def coordinate_units(self) -> Any:
        """The units of coordinates (n,) in which ranks are counted: L, L and one radian for each body, by the balance."""
        units = self.scales.coordinates(self.coordinates)
        return units if self.balance is None else units * np.asarray(self.balance.coordinates)

    @property
    def length(self) -> Float[Array, ""]:
        """The characteristic length (m)."""
        return self.scales.length

    @property
    def time(self) -> Float[Array, ""]:
        """The characteristic time (s); infinite without velocities and loads."""
        return 1 / self.scales.rate

    @property
    def mass(self) -> Float[Array, ""]:
        """The characteristic mass (kg), the mass of the heaviest body."""
        return self.scales.mass

    @staticmethod
    def require_masses(model: RunModel, asked_by: str) -> None:
        """Raise `ArgumentError` if links of a model lack masses, unless drivers determine its motion.

        `asked_by` are the results that depend on masses, as in `RunModel.require_masses`.
        """
        found = analysis_of(model) if model.massless else None
        if found is not None and (found.rank is None or found.coordinates > found.rank):
            model.require_masses(asked_by, "let motors determine the motion")

    def with_numbers_of(self, mechanism: Mechanism) -> "Analysis":
        """Return this analysis with the scales of `mechanism`, the same mechanism with other, traced numbers."""
        own = traced_scales(mechanism)
        if self.balance is not None:
            own = own._replace(rank_tol=jnp.minimum(own.rank_tol, self.scales.rank_tol))
        return replace(self, scales=own)

    def with_rows_of(self, mechanism: Mechanism, only_switched: bool = False) -> "Analysis":
        """Return the analysis of the same mechanism with more constraints; redundant rows and balance are unknown in it.

        Its lengths, times and masses stay those of the original mechanism.

        Args:
            mechanism: The mechanism with more constraints.
            only_switched: Whether all dependent rows belong to constraints that are switched off.
        """
        own = (concrete_scales if mechanism.is_concrete else traced_scales)(mechanism)
        xp = jnp if is_traced((self.scales, own)) else np
        scales = self.scales._replace(rows=own.rows, rank_tol=xp.minimum(self.scales.rank_tol, own.rank_tol))
        return Analysis(jax.tree.map(number, scales), self.coordinates, _row_names(mechanism), None, None, only_switched)


@checks_instances(Analysis)
def _check_analysis(name: str, value: Analysis, given: GivenArguments) -> None:
    mechanism: Any = given.get("mechanism")
    if not getattr(mechanism, "has_bodies", False):
        return
    owners = list(dict.fromkeys(owner for owner, _ in value.row_names))
    if value.coordinates != 3 * len(mechanism.body_names) or owners != list(mechanism.constraints):
        raise ArgumentError(f"{name} belongs to another mechanism: give udk.analyse(mechanism), or leave it out")


@checked
def analyse(mechanism: Mechanism) -> Analysis:
    """Find the rank, the redundant rows and the scales of a mechanism; results are cached by structure and numbers.

    Redundancy depends on numbers (three equal cranks). If `with_parameters` made a mechanism with traced numbers from a concrete
    one, its redundant rows are those of the concrete mechanism, and its scales follow from its own numbers; a run checks the rows
    that are left out and reports if one of them has become independent. A mechanism whose geometry is traced as an argument of a
    function under `jit` has no such origin: its redundant rows are unknown here, and a run finds them when it begins.

    Args:
        mechanism: The scene; its numbers may be traced.

    Returns:
        The `Analysis`; `rank` and `redundant_rows` are None if unknown.
    """
    if not mechanism.is_concrete:
        if mechanism.origin is not None:
            return analyse(mechanism.origin.mechanism).with_numbers_of(mechanism)
        mechanism = mechanism.without_origin
        count, names = 3 * len(mechanism.body_names), _row_names(mechanism)
        return Analysis(traced_scales(mechanism), count, names, *_rows_of_concrete_geometry(mechanism))
    return _analyse_concrete(mechanism)


def analysis_of(model: RunModel) -> Analysis | None:
    """Return the analysis of a mechanism; None for a model without bodies, whose coordinates and rows are of order one."""
    return analyse(model) if isinstance(model, Mechanism) else None


@cached_by_identity
def _analyse_concrete(mechanism: Mechanism) -> Analysis:
    mechanism = mechanism.without_origin
    kind = structure(mechanism)
    return _analyses.get((kind, _bytes_of(mechanism)), lambda: _analyse(mechanism, kind))


Stored = TypeVar("Stored")


class _Cache(Generic[Stored]):
    """A cache of the `ANALYSIS_CACHE_SIZE` most recently used values."""

    def __init__(self):
        self._found: OrderedDict[Hashable, Stored] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable, make: Callable[[], Stored]) -> Stored:
        with self._lock:
            if key in self._found:
                self._found.move_to_end(key)
                return self._found[key]
        value = make()
        with self._lock:
            self._found[key] = value
            while len(self._found) > ANALYSIS_CACHE_SIZE:
                self._found.popitem(last=False)
        return value


_analyses: _Cache[Analysis] = _Cache()
_found_rows: _Cache[FoundRows] = _Cache()


def _analyse(mechanism: Mechanism, kind: Hashable) -> Analysis:
    with jax.ensure_compile_time_eval():  # also during a trace
        found = _rows_of(mechanism, kind)
        scales = _with_rank_tol(mechanism, concrete_scales(mechanism), found)
        names, count = _row_names(mechanism), 3 * len(mechanism.body_names)
        return make_module(
            Analysis,
            scales=scales,
            coordinates=count,
            row_names=names,
            redundant_rows=found.redundant,
            balance=found.balance,
            only_switched=False,
        )


def _with_rank_tol(mechanism: Mechanism, scales: Scales, found: FoundRows) -> Scales:
    """Return the scales; where gears make singular values of D small in any position, with a rank tolerance below these."""
    if found.position is None or found.redundant is None:
        return scales
    rows = DenseRows(mechanism, scales)
    sigma = np.linalg.svd(rows.weights[:, None] * rows.jacobian(0.0, found.position) * rows.metric, compute_uv=False)
    smallest = sigma[rows.count - len(found.redundant) - 1] / sigma[0]
    return scales._replace(rank_tol=number(min(float(scales.rank_tol), GEARED_SHARE * smallest)))


def _rows_of(mechanism: Mechanism, kind: Hashable) -> FoundRows:
    # Redundancy does not depend on masses and loads: mechanisms that differ only in these share the result.
    return _found_rows.get((kind, _bytes_of(_geometry(mechanism))), lambda: examine_rows(mechanism))


class Holding(NamedTuple):
    """A mechanism in which the angles of pins that do not turn are held, and these pins."""

    mechanism: Mechanism
    pins: tuple[HeldPin, ...]


@cached_by_identity  # the result must not contain the mechanism, or the cache would keep it in memory
def hold_pins(mechanism: Model) -> Holding | None:
    """Return the mechanism with the angles of pins held that constraints hold only to second order (stationary_rows.py).

    None if there are no such pins, if no concrete numbers are known by which to find them, or if the model has no bodies.
    """
    if not isinstance(mechanism, Mechanism):
        return None
    source = mechanism if mechanism.is_concrete else mechanism.origin and mechanism.origin.mechanism
    pins = () if source is None else _held_pins(source)
    with jax.ensure_compile_time_eval() if mechanism.is_concrete else nullcontext():
        return Holding(with_held_pins(mechanism, pins), pins) if pins else None


@cached_by_identity
def _held_pins(mechanism: Mechanism) -> tuple[HeldPin, ...]:
    with jax.ensure_compile_time_eval():
        mechanism = mechanism.without_origin
        return _rows_of(mechanism, structure(mechanism)).held


def _rows_of_concrete_geometry(mechanism: Mechanism) -> tuple[tuple[int, ...] | None, BalancedUnits | None]:
    """Return the redundant rows and the balance of a mechanism with traced masses or loads.

    Both are None, that is, unknown, if the geometry is traced as well.
    """
    with jax.ensure_compile_time_eval():
        if is_traced(_geometry(mechanism)):
            return None, None
        concrete = jax.tree.map(lambda x: np.ones(np.shape(x)) if isinstance(x, Tracer) else x, mechanism)
        found = _analyse(concrete, structure(mechanism))
        return found.redundant_rows, found.balance


def _geometry(mechanism: Mechanism) -> PyTree[Array]:
    return list(mechanism.constraints.values()), [(body.position, body.angle) for body in mechanism.bodies.values()]


def _row_names(mechanism: Mechanism) -> tuple[tuple[str, int], ...]:
    return tuple(scene_programs(mechanism).row_names)


def _bytes_of(tree: PyTree[Array]) -> bytes:
    return b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree))
