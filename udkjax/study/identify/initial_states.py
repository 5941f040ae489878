"""The unknowns of a fit that are initial states of records: coordinates and rates that parametrize the closed states."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from udkjax.equations.dense_rows import KinematicRows
from udkjax.equations.scales import known_scales
from udkjax.integrate.assembly import State, assemble
from udkjax.scene.bodies import COORDINATES
from udkjax.scene.checks import SceneError, quote
from udkjax.scene.mechanism import Mechanism
from udkjax.study.channels import RATES, UNITS
from udkjax.study.identify.records import Estimated, IdentificationError, Record, Start
from udkjax.study.identify.unknowns import Unknowns, apply_values

READABLE = 1e-3  # of the largest: how much of a free motion the coordinates that are taken as its unknowns must show at least


class InitialStateUnknowns(NamedTuple):
    """The S unknowns of one initial state, which tied records share. They are dimensionless, over the scales of the scene.

    `sizes` (S,) are changes of the named coordinates and rates by one of each, in `units`; `basis` those of all q and v (n,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    sizes: Float[np.ndarray, "S"]
    basis: Float[np.ndarray, "2 n S"]


def initial_state_unknowns(
    mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record]
) -> tuple[tuple[InitialStateUnknowns, ...], Int[np.ndarray, "records S"], Float[np.ndarray, "records 2 n S"]]:
    """Return the unknowns of all initial states; where in z those of each record are (-1: none), and what they change."""
    found: list[InitialStateUnknowns] = []
    of_record: list[tuple[int, InitialStateUnknowns] | None] = []
    tied: dict[str, tuple[Start, tuple[int, InitialStateUnknowns]]] = {}
    at, problems = len(unknowns.names), []
    for k, record in enumerate(records):
        start = record.start
        if start.estimate == "nothing":
            of_record.append(None)
        elif start.name and start.name in tied:
            first, own = tied[start.name]
            if first.estimate != start.estimate or (first.state is not start.state and not _same(first.state, start.state)):
                problems.append(
                    f"{record.place}start {quote(start.name)} is another one in an earlier record: give one Start to both"
                )
            of_record.append(own)
        else:
            label = start.name or record.name or (f"record {k + 1}" if len(records) > 1 else "start")
            try:
                mech = apply_values(with_conditions(mechanism, record), unknowns.targets, unknowns.guess)
                state = state_unknowns(mech, record.t0, start.state, start.estimate, label)
            except SceneError as problem:
                raise IdentificationError([f"{record.place}{problem}"]) from None
            tied[start.name] = start, (at, state)
            of_record.append((at, state))
            found.append(state)
            at += len(state.names)
    if problems:
        raise IdentificationError(problems)
    S = max((len(state.names) for state in found), default=0)
    columns, bases = np.full((len(records), S), -1), np.zeros((len(records), 2, 3 * len(mechanism.body_names), S))
    for k, own in enumerate(of_record):
        if own is not None:
            at, state = own
            count = len(state.names)
            columns[k, :count], bases[k, ..., :count] = at + np.arange(count), state.basis
    return tuple(found), columns, bases


def _same(one: State | None, two: State | None) -> bool:
    return one is not None and two is not None and np.array_equal(one.q, two.q) and np.array_equal(one.v, two.v)


def with_conditions(mechanism: Mechanism, record: Record) -> Mechanism:
    """Return the mechanism as it was in a record."""
    return mechanism.with_parameters(record.conditions) if record.conditions else mechanism


def state_unknowns(mech: Mechanism, t0: float, guess: State | None, estimate: Estimated, label: str) -> InitialStateUnknowns:
    """Choose coordinates that parametrize the closed states beside a guess: angles where they do.

    Args:
        mech: with its parameters.
        t0: the time of the state (s).
        guess: the state that is closed; None: the scene's own.
        estimate: what of it is unknown.
        label: what names of the unknowns begin with.
    """
    rows, q = KinematicRows(mech), np.asarray(assemble(mech, t0, guess).q, float).ravel()
    free = np.eye(len(q))
    if rows.count:
        position = rows.close(t0, q)
        assert position is not None, "what has been assembled is closed"
        free = rows.metric[:, None] * position.vt[position.rank :].T
    chosen, scales = _independent_rows(free), known_scales(mech)
    size = np.where(np.array(chosen) % 3 == 2, 1.0, float(scales.length))  # angles are in rad
    rate = float(scales.rate) or 1.0  # of what rests without any load, in 1/s
    basis = free @ np.linalg.inv(free[chosen]) * size
    names: list[str] = []
    units: list[str] = []
    sizes, parts, nothing = [], [], np.zeros_like(basis)
    kinds = ("position", COORDINATES, 1.0, (basis, nothing)), ("velocity", RATES, rate, (nothing, rate * basis))
    for what, fields, factor, part in kinds:
        if estimate in (what, "both"):
            sizes.append(factor * size)
            names += [f"{label}: body.{mech.body_names[k // 3]}.{fields[k % 3]}" for k in chosen]
            units += [UNITS[fields[k % 3]] for k in chosen]
            parts.append(np.stack(part))
    return InitialStateUnknowns(tuple(names), tuple(units), np.concatenate(sizes), np.concatenate(parts, axis=2))


def _independent_rows(free: np.ndarray) -> list[int]:
    """Choose as many rows as there are columns, far from dependent on each other: of angles alone if possible."""
    for rows in (np.arange(2, len(free), 3), np.arange(len(free))):
        left, chosen = free / np.linalg.norm(free, 2), []
        for _ in range(free.shape[1]):
            sizes = np.linalg.norm(left[rows], axis=1)
            k = int(rows[np.argmax(sizes)])
            if sizes.max() < READABLE:
                break
            chosen.append(k)
            unit = left[k] / np.linalg.norm(left[k])
            left = left - np.outer(left @ unit, unit)
        else:
            return sorted(chosen)
    return sorted(chosen)
