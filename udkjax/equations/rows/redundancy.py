"""Redundant rows of Psi, which `analyse` finds once for all runs, and generic positions (position_rows.py)."""

from typing import NamedTuple

import numpy as np

from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.rows.balance import BalancedUnits, balance_of
from udkjax.equations.rows.dense_rows import KinematicRows
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.equations.rows.position_rows import NEGLIGIBLE_SHARE, PositionRows
from udkjax.equations.rows.stationary_rows import HeldPin, held_pins
from udkjax.scene.mechanism import Mechanism


class FoundRows(NamedTuple):
    """The redundant rows of Psi, pins that rows hold to second order only, and balanced units: the result of `examine_rows`."""

    redundant: tuple[int, ...] | None  # the rows to leave out; None if the guess cannot be closed or moved
    held: tuple[HeldPin, ...]  # the pins that rows hold to second order only
    balance: BalancedUnits | None  # factors of the units in which ranks are counted; None: all are one
    position: np.ndarray | None = None  # with a balance: a closed position with the largest rank


@np.errstate(all="ignore")  # non-finite coordinates are not closed
def examine_rows(mechanism: Mechanism, large: bool | None = None) -> FoundRows:
    """Find the redundant rows of a mechanism with concrete numbers, and the pins that rows hold to second order only.

    `large` decides between dense and sparse matrices: see `kinematic_rows`.
    """
    rows = kinematic_rows(mechanism, large)
    if not rows.count:
        return FoundRows((), (), None)
    q = np.asarray(mechanism.q0, float).ravel()
    positions = rows.sample(q)
    redundant = rows.redundant(positions) if positions else None
    held = held_pins(mechanism, rows, q, len(redundant or ())) if isinstance(rows, KinematicRows) else ()
    balance = balance_of(mechanism)
    return FoundRows(redundant, held, balance, positions[-1].q if positions and balance else None)


def redundant_rows(mechanism: Mechanism, large: bool | None = None) -> tuple[int, ...] | None:
    """Return the rows of Psi to leave out; None if the guess cannot be closed or moved. All numbers are concrete."""
    return examine_rows(mechanism, large).redundant


def dependent_constraints(mechanism: Mechanism, q: np.ndarray) -> tuple[str, ...]:
    """Return the names of the constraints with dependent rows at a closed position near q; none if it cannot be closed."""
    rows = kinematic_rows(mechanism)
    position = rows.close(0.0, np.asarray(q, float).ravel()) if rows.count else None
    if position is None:
        return ()
    involved = np.asarray((abs(position.null_space) > NEGLIGIBLE_SHARE).sum(axis=1)).ravel() > 0
    names = [name for (name, _), is_involved in zip(rows.names, involved, strict=True) if is_involved]
    return tuple(dict.fromkeys(names))


def generic_position(mechanism: Mechanism) -> np.ndarray | None:
    """Return a closed position near the initial guess, which may be singular; None if it cannot be closed.

    All numbers are concrete. The step from the guess is random, so that the position is generic.
    """
    rows = kinematic_rows(mechanism)
    q = np.asarray(mechanism.q0, float).ravel()
    random = np.random.default_rng(0).standard_normal(rows.size)
    if not rows.count:
        return q
    start = rows.close(0.0, q)
    if start is None:
        return None
    step = rows.metric * start.tangent_part(random)
    size = rows.step_size(step)
    moved = rows.close(0.0, start.q + CLOSURE.longest_step * step / size) if size > 0 else None
    return start.q if moved is None else moved.q


def holders_of_driver(mechanism: Mechanism, name: str) -> set[str] | None:
    """Return the constraints that hold the coordinate of a driver, in a generic position of the joints alone.

    These are the constraints on whose rows of Psi_q the row of the driver depends; None if the joints and the other drivers leave
    it free, or the joints cannot be closed. All numbers are concrete.
    """
    q = generic_position(Mechanism(dict(mechanism.bodies), dict(mechanism.joints), gravity=mechanism.gravity))
    return None if q is None else kinematic_rows(mechanism).owners_of_row(0.0, q, name)


def kinematic_rows(mechanism: Mechanism, large: bool | None = None) -> PositionRows:
    """Return the rows of a mechanism with concrete numbers: `SparseRows` if the scene is large, else `KinematicRows`.

    `large` is None if the size of the scene decides.
    """
    if not (large or (large is None and not scene_programs(mechanism).is_small)):
        return KinematicRows(mechanism)
    from udkjax.equations.rows.sparse_rows import SparseRows  # imports SciPy, which small scenes do not need

    return SparseRows(mechanism, kinematic=True)
