"""The unknowns of initial states: coordinates and rates that parametrize the closed states near a guess."""

import math
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import qr

from udkjax.equations import determinacy
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.rows.dense_rows import KinematicRows
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.pinv.row_spaces import null_space
from udkjax.positions.assembling.assembly import State, assemble
from udkjax.positions.assembling.channels import RATES, channel_of
from udkjax.scene.elements.bodies import COORDINATES
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.study.identify.problem.unknowns import Unknowns, apply_values, with_conditions
from udkjax.study.identify.records.records import Estimated, IdentificationError, Record, Start
from udkjax.study.quantities import StudyModel, jacobians_at
from udkjax.wording import quote

SMALLEST_READABLE_PART = 1e-3  # least pivot, relative to the largest, of coordinates that are chosen as unknowns


class InitialStateUnknowns(NamedTuple):
    """The S dimensionless unknowns of one initial state, which records with the same named start share.

    `sizes` (S,) are the changes of the named coordinates and rates per unit of each unknown, in `units`; `basis` has the
    changes of all q and v (n,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    sizes: Float[np.ndarray, "S"]
    basis: Float[np.ndarray, "2 n S"]


def initial_state_unknowns(
    mechanism: StudyModel, unknowns: Unknowns, records: Sequence[Record]
) -> tuple[tuple[InitialStateUnknowns, ...], Int[np.ndarray, "records S"], Float[np.ndarray, "records 2 n S"]]:
    """Return the unknowns of all initial states, their indices in z for each record (-1: unused), and the changes of q and v."""
    by_start: dict[Hashable, tuple[Start, int, InitialStateUnknowns]] = {}  # key: the name of a start, or the index of its record
    index, problems = len(unknowns.names), []
    for k, record in enumerate(records):
        start, key = record.start, record.start.name or k
        if start.estimate == "nothing":
            continue
        if key in by_start:
            if not _same(by_start[key][0], start):
                problems.append(
                    f"{record.place}start {quote(start.name)} differs from that of an earlier record: give the same Start to both"
                )
        else:
            label = start.name or record.name or (f"record {k + 1}" if len(records) > 1 else "start")
            try:
                mech = apply_values(with_conditions(mechanism, record), unknowns.targets, unknowns.guess)
                by_start[key] = start, index, state_unknowns(mech, record.t0, start.state, start.estimate, label)
            except SceneError as problem:
                raise IdentificationError([f"{record.place}{problem}"]) from None
            index += len(by_start[key][2].names)
    if problems:
        raise IdentificationError(problems)
    states = tuple(state for _, _, state in by_start.values())
    S = max((len(state.names) for state in states), default=0)
    columns, bases = np.full((len(records), S), -1), np.zeros((len(records), 2, math.prod(mechanism.state_shape()), S))
    for k, record in enumerate(records):
        if record.start.estimate != "nothing":
            _, first, state = by_start[record.start.name or k]
            count = len(state.names)
            columns[k, :count], bases[k, ..., :count] = first + np.arange(count), state.basis
    return states, columns, bases


def _same(first: Start, second: Start) -> bool:
    a, b = first.state, second.state
    equal = a is b or (a is not None and b is not None and np.array_equal(a.q, b.q) and np.array_equal(a.v, b.v))
    return equal and first.estimate == second.estimate


def state_unknowns(mech: StudyModel, t0: float, guess: State | None, estimate: Estimated, label: str) -> InitialStateUnknowns:
    """Return the unknowns of the closed states near a guess: changes of chosen coordinates, only of angles if possible.

    Args:
        mech: the mechanism or system.
        t0: time of the state (s).
        guess: the guess of the state; None for the scene's own.
        estimate: the parts of the state that are unknown.
        label: beginning of the names of the unknowns.
    """
    if not isinstance(mech, Mechanism):
        return _entries_as_unknowns(mech, t0, guess, estimate, label)
    rows, q = KinematicRows(mech), np.asarray(assemble(mech, t0, guess).q, float).ravel()
    free = np.eye(len(q))
    if rows.count:
        position = rows.close(t0, q)
        assert position is not None, "an assembled state is closed"
        free = rows.metric[:, None] * position.vt[position.rank :].T
    chosen, scales = _independent_rows(free), analyse(mech).scales
    size = np.where(np.array(chosen) % 3 == 2, 1.0, float(scales.length))  # angles in rad
    rate = float(scales.rate) or 1.0  # 1/s for a scene without motion and loads
    basis = free @ np.linalg.inv(free[chosen]) * size
    names: list[str] = []
    units: list[str] = []
    sizes, parts, nothing = [], [], np.zeros_like(basis)
    kinds = ("position", COORDINATES, 1.0, (basis, nothing)), ("velocity", RATES, rate, (nothing, rate * basis))
    for kind, fields, factor, part in kinds:
        if estimate in (kind, "both"):
            sizes.append(factor * size)
            channels = [channel_of(mech, f"body.{mech.body_names[k // 3]}.{fields[k % 3]}") for k in chosen]
            names += [f"{label}: {channel.name}" for channel in channels]
            units += [channel.units for channel in channels]
            parts.append(np.stack(part))
    return InitialStateUnknowns(tuple(names), tuple(units), np.concatenate(sizes), np.concatenate(parts, axis=2))


def _entries_as_unknowns(
    system: ConstrainedSystem, t0: float, guess: State | None, estimate: Estimated, label: str
) -> InitialStateUnknowns:
    """Return the unknowns of closed states of a system: coordinates that determine q, and velocities that determine v."""
    state = assemble(system, t0, guess)
    q, v = (np.asarray(x, float) for x in (state.q, state.v))
    n, parts, names, sizes = len(q), [], [], []
    psi_q, rows = (np.asarray(x, float) for x in jacobians_at(system.traced(n), t0, q, v))
    for place, kind, letter, A in ((0, "position", "q", psi_q), (1, "velocity", "v", rows)):
        if estimate not in (kind, "both"):
            continue
        free = null_space(A, determinacy.STATIC_RANK_TOL).T if len(A) else np.eye(n)
        chosen = _independent_rows(free, has_angles=False)
        basis = np.zeros((2, n, len(chosen)))
        basis[place] = free @ np.linalg.inv(free[chosen])
        parts.append(basis)
        names += [f"{label}: {letter}[{k}]" for k in chosen]
        sizes.append(np.ones(len(chosen)))
    units = ("",) * len(names)
    return InitialStateUnknowns(tuple(names), units, np.concatenate(sizes), np.concatenate(parts, axis=2))


def _independent_rows(free: np.ndarray, has_angles: bool = True) -> list[int]:
    """Return the indices of as many well-conditioned rows as there are columns; only of angles, every third row, if possible."""
    count, all_rows = free.shape[1], np.arange(len(free))
    chosen = all_rows[:0]
    for rows in (all_rows[2::3], all_rows) if has_angles else (all_rows,):
        factors: Any = qr(free[rows].T / np.linalg.norm(free, 2), mode="r", pivoting=True)
        R, order = factors
        chosen, sizes = rows[order[:count]], np.abs(np.diag(R))
        if len(sizes) == count and sizes.min(initial=1.0) >= SMALLEST_READABLE_PART:
            break
    return sorted(chosen.tolist())
