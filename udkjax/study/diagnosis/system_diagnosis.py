"""Diagnosis of a user-defined system by J = (Psi_q; phi_v): degrees of freedom, redundant rows, rank and unique multipliers."""

from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.equations import determinacy
from udkjax.equations.rows.position_rows import PositionRows
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.positions.assembling.assembly import State, close, require_closed
from udkjax.positions.assembling.channels import StateHistory
from udkjax.printing import PrintedTable, html_table
from udkjax.study.diagnosis.configuration import N_NEIGHBOURS, NEIGHBOUR_STEP, SMALLEST_MOVE, Configuration, count_rank
from udkjax.study.diagnosis.dependence import dependencies_at
from udkjax.study.diagnosis.diagnosis import LABEL_WIDTH
from udkjax.study.diagnosis.timeline import Timeline, timeline
from udkjax.study.quantities import jacobians_at
from udkjax.study.report import plain
from udkjax.wording import plural


class RowSet(NamedTuple):
    """A minimal set of dependent rows."""

    rows: tuple[str, ...]
    count: int  # number of its redundant rows
    permanent: bool  # True if the set is dependent in nearby states, too


class SystemDiagnosis(NamedTuple):
    """Degrees of freedom, redundant rows and unique multipliers of a `ConstrainedSystem` in one state.

    Attributes:
        q: closed coordinates (n,); `v` closed velocities.
        rows: the labels of the rows of Psi, then of phi: names that the functions give, or `constraint[0]`.
        rank: rank of J = (Psi_q; phi_v) in this state.
        ordinary_rank: rank in nearby closed states: the generic rank.
        position_rank: rank of Psi_q alone in this state.
        redundancies: minimal sets of dependent rows.
        redundant: rows that can be left out together without any effect.
        unique: by row, True if its multiplier is unique.
        singular_values: singular values of J, largest first.
        timeline: rank and singular values along a solution; None if no solution was given.
    """

    t: float  # s
    q: np.ndarray
    v: np.ndarray
    rows: tuple[str, ...]
    rank: int
    ordinary_rank: int
    position_rank: int
    can_move: bool  # True if closed states nearby were found
    redundancies: tuple[RowSet, ...]
    redundant: tuple[str, ...]
    unique: dict[str, bool]
    singular_values: np.ndarray
    timeline: Timeline | None = None

    @property
    def coordinates(self) -> int:
        """Number n of coordinates."""
        return len(self.q)

    @property
    def degrees_of_freedom(self) -> int:
        """Number of independent velocities, n minus the generic rank."""
        return self.coordinates - self.ordinary_rank

    @property
    def position_freedoms(self) -> int:
        """Number of independent changes of coordinates, n minus the rank of Psi_q.

        If phi is nonholonomic, it exceeds `degrees_of_freedom`.
        """
        return self.coordinates - self.position_rank

    @property
    def is_singular(self) -> bool:
        """True if the rank is lower in this state than nearby."""
        return self.rank < self.ordinary_rank

    @property
    def conditioning(self) -> float:
        """Condition number of J: the ratio of its largest to its smallest nonzero singular value."""
        return float(self.singular_values[0] / self.singular_values[self.rank - 1]) if self.rank else 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and strings, for JSON."""
        further = ("coordinates", "degrees_of_freedom", "position_freedoms", "is_singular", "conditioning")
        return plain(self) | {name: plain(getattr(self, name)) for name in further}

    def _sections(self) -> list[tuple[str, str]]:
        """Return the lines of the text, each with a title, which is empty in continuation lines."""
        n, loose = self.coordinates, [name for name, is_unique in self.unique.items() if not is_unique]
        freedoms = plural(self.degrees_of_freedom, "degree")
        lines = [("mobility", f"{n} coordinates - rank {self.ordinary_rank} = {freedoms} of freedom")]
        if self.position_freedoms != n - self.rank:
            lines.append(("positions", f"{self.position_freedoms} of {n} coordinates are independent: phi restricts their rates"))
        for found in self.redundancies:
            when = "everywhere" if found.permanent else "in this state only"
            lines.append(("redundancy", f"{', '.join(found.rows)}: {plural(found.count, 'redundant row')} {when}"))
        if self.redundant:
            lines.append(("left out", f"{', '.join(self.redundant)}: can be left out together without any effect"))
        if self.is_singular:
            lines.append(("singular", f"the rank is {self.rank} here, and {self.ordinary_rank} nearby"))
        if self.rows:
            lines.append(("multipliers", f"not unique: {', '.join(loose)}" if loose else "all unique"))
        lines.append(("conditioning", f"{self.conditioning:.4g}: the largest over the smallest nonzero singular value"))
        if self.timeline is not None:
            time, smallest = self.timeline.closest
            lines.append(("timeline", f"smallest nonzero singular value: {smallest:.3g} of the largest, at {time:.6g} s"))
            lines += [("", f"rank {c.rank} at {c.time:.10g} s") for c in self.timeline.changes]
        return lines

    def __str__(self) -> str:
        return "\n".join(["system", *(f"  {title:<{LABEL_WIDTH}}  {line}" for title, line in self._sections())])

    def __repr__(self) -> str:
        return f"SystemDiagnosis(rank {self.rank}, {self.degrees_of_freedom} degrees of freedom)"

    def _repr_html_(self) -> str:
        return html_table(PrintedTable("system", self._sections()))


def diagnose_system(
    system: ConstrainedSystem,
    state: State | None,
    t: float,
    rank_tol: float,
    solution: StateHistory | None,
    time_tol: float | None,
) -> SystemDiagnosis:
    """Return the diagnosis of a system in the closed state near `state`, or, if it is None, near the system's own guess.

    The other arguments are those of `diagnose`.

    Raises:
        AssemblyError: the state cannot be closed.
        ValueError: float64 is off in JAX.
    """
    if not jax.config.jax_enable_x64:
        raise ValueError("the rank of a ConstrainedSystem needs float64, which is off in JAX: leave JAX_ENABLE_X64 unset")
    closure = close(system, t, state)
    require_closed(system, closure, t)
    q, v = (np.asarray(x, float) for x in (closure.state.q, closure.state.v))
    traced = system.traced(q.size)
    here, of_positions = _configuration(traced, t, q, v, rank_tol), jacobians_at(traced, t, q, v)[0]
    neighbours = _neighbours(system, traced, here, v, rank_tol)
    ordinary_rank = max(c.rank for c in (here, *neighbours))
    generic = [c for c in (here, *neighbours) if c.rank == ordinary_rank]
    labels = traced.row_labels
    used = [np.flatnonzero(row) for row in max(generic, key=lambda c: c.smallest).J]
    attached = {label: tuple(f"q[{k}]" for k in places) for label, places in zip(labels, used, strict=True)}
    permanent, momentary = dependencies_at(attached, here, generic, labels) if labels else ([], [])
    sets = [RowSet(d.constraints, d.redundancy, kind) for kind, found in ((True, permanent), (False, momentary)) for d in found]
    spared = PositionRows.dispensable([c.left for c in generic]) if labels else ()
    share = np.linalg.norm(here.left, axis=1)
    return SystemDiagnosis(
        t=t,
        q=q,
        v=v,
        rows=labels,
        rank=here.rank,
        ordinary_rank=ordinary_rank,
        position_rank=_rank_of(of_positions, rank_tol),
        can_move=bool(neighbours),
        redundancies=tuple(sets),
        redundant=tuple(labels[k] for k in spared),
        unique=dict(zip(labels, (share <= determinacy.UNIQUE_TOL).tolist(), strict=True)),
        singular_values=here.sigma,
        timeline=None if solution is None else timeline(system, solution, rank_tol, time_tol),
    )


def _rank_of(rows: np.ndarray, rank_tol: float) -> int:
    return count_rank(np.linalg.svd(rows, compute_uv=False), rank_tol) if rows.size else 0


def _configuration(system: Any, t: float, q: np.ndarray, v: np.ndarray, rank_tol: float) -> Configuration:
    return Configuration(t, q, np.asarray(jacobians_at(system, t, q, v)[1], float), rank_tol)


def _neighbours(
    system: ConstrainedSystem, traced: Any, start: Configuration, v: np.ndarray, rank_tol: float
) -> list[Configuration]:
    """Return closed states along a random motion from the state `start` with velocities v; `traced` is the traced system."""
    random, found, last = np.random.default_rng(0), [], start
    for _ in range(N_NEIGHBOURS if len(start.J) else 0):
        allowed = last.allowed(random.standard_normal(len(start.q)))
        size = np.linalg.norm(allowed)
        if not size:
            break
        closure = close(system, start.t, State(last.q + NEIGHBOUR_STEP * allowed / size, v))
        q = np.asarray(closure.state.q, float)
        if bool(closure.is_closed) and np.linalg.norm(q - last.q) > SMALLEST_MOVE * NEIGHBOUR_STEP:
            last = _configuration(traced, start.t, q, np.asarray(closure.state.v, float), rank_tol)
            found.append(last)
    return found
