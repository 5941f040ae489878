"""The unknowns of a fit that are the states in which records began."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.equations.redundancy import rows_of
from udkjax.integrate.assembly import assemble
from udkjax.scene.checks import SceneError, quoted
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.records import Record, Start
from udkjax.study.identify.unknowns import Unknowns, applied

COORDINATES, RATES = ("x", "y", "angle"), ("vx", "vy", "omega")
READABLE = 1e-3  # coordinates are taken as unknowns of a start where they tell its neighbours apart at least as well as this


class StartUnknowns(NamedTuple):
    """The unknowns of one start, or of several that are tied: how each changes q and v of its guess, and what it is called."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    basis: Float[np.ndarray, "2 n S"]


def starts_of(
    mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record]
) -> tuple[tuple[StartUnknowns, ...], list[tuple[int, StartUnknowns] | None]]:
    """The unknowns of all starts, and for each record which of them are its own: from where in z on."""
    found: list[StartUnknowns] = []
    columns: list[tuple[int, StartUnknowns] | None] = []
    tied: dict[str, tuple[Start, tuple[int, StartUnknowns]]] = {}
    at, problems = len(unknowns.names), []
    for k, record in enumerate(records):
        start = record.start
        if start.estimate == "nothing":
            columns.append(None)
            continue
        if start.name and start.name in tied:
            first, mine = tied[start.name]
            if first.estimate != start.estimate or (first.state is not start.state and not _same(first.state, start.state)):
                problems.append(
                    f"{record.where}start {quoted(start.name)} is another one in an earlier record: give one Start to both"
                )
            columns.append(mine)
            continue
        label = start.name or record.name or (f"record {k + 1}" if len(records) > 1 else "start")
        mine = at, start_unknowns(mechanism, unknowns, record, label)
        found.append(mine[1])
        columns.append(mine)
        at += len(mine[1].names)
        if start.name:
            tied[start.name] = start, mine
    if problems:
        raise IdentificationError(problems)
    return tuple(found), columns


def _same(one: Any, two: Any) -> bool:
    return one is not None and two is not None and np.array_equal(one.q, two.q) and np.array_equal(one.v, two.v)


def start_unknowns(mechanism: Mechanism, unknowns: Unknowns, record: Record, label: str) -> StartUnknowns:
    """Coordinates that tell the closed states beside the guess apart: angles where they do."""
    mech = mechanism.with_parameters(record.conditions) if record.conditions else mechanism
    try:
        mech = applied(mech, unknowns.targets, unknowns.start)
        state = assemble(mech, record.t0, record.start.state)
    except SceneError as problem:
        raise IdentificationError([f"{record.where}{problem}"]) from None
    rows: Any = rows_of(mech)
    q = np.asarray(state.q, float).ravel()
    free = np.eye(len(q))
    if rows.count:
        position = rows.close(record.t0, q)
        free = rows.metric[:, None] * position.vt[position.rank :].T
    chosen = _telling(free)
    basis = free @ np.linalg.inv(free[chosen])
    names: list[str] = []
    units: list[str] = []
    parts = []
    nothing = np.zeros_like(basis)
    for estimated, fields, unit, part in (
        (record.start.position, COORDINATES, ("m", "m", "rad"), np.stack([basis, nothing])),
        (record.start.velocity, RATES, ("m/s", "m/s", "rad/s"), np.stack([nothing, basis])),
    ):
        if estimated:
            names += [f"{label}: body.{mech.body_names[k // 3]}.{fields[k % 3]}" for k in chosen]
            units += [unit[k % 3] for k in chosen]
            parts.append(part)
    return StartUnknowns(tuple(names), tuple(units), np.concatenate(parts, axis=2))


def _telling(free: np.ndarray) -> list[int]:
    """As many rows as there are columns, far from dependent on each other; of angles where they are no worse than that."""
    for rows in (np.arange(2, len(free), 3), np.arange(len(free))):
        left, chosen = free / np.linalg.norm(free, 2), []
        for _ in range(free.shape[1]):
            sizes = np.linalg.norm(left[rows], axis=1)
            k = int(rows[np.argmax(sizes)])
            if sizes.max() < READABLE:
                break
            chosen.append(k)
            away = left[k] / np.linalg.norm(left[k])
            left = left - np.outer(left @ away, away)
        else:
            return sorted(chosen)
    return sorted(chosen)
