"""Minimal sets of dependent constraints: circuits of the matroid of the rows, grouped by constraint.

N spans the null space of J^T. The rows of a set S of constraints are dependent if and only if a combination y of the columns of N
vanishes outside S, N[outside] y = 0; the number of redundant rows is nullity(N[outside]). S is minimal if no constraint can be
removed from it. A set is searched for around each constraint; the smallest sets are collected until their combinations y span all
of N. To reach further combinations, one row is excluded for each combination already collected.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from udkjax.equations import determinacy
from udkjax.equations.rows.position_rows import PositionRows
from udkjax.pinv.row_spaces import null_space
from udkjax.study.diagnosis.configuration import Configuration

DEPENDENCE_TOL = 1e-6  # norm above which a row of N, whose columns are orthonormal, is nonzero; well above rounding errors


class Dependency(NamedTuple):
    """A minimal set of constraints whose rows are dependent."""

    constraints: tuple[str, ...]
    redundancy: int  # number of their redundant rows


def dependencies(N: np.ndarray, owners: Sequence[str], attached: dict[str, tuple[str, ...]]) -> list[Dependency]:
    """Return minimal sets of dependent constraints whose vanishing combinations span N (m, k), the smallest sets first.

    `owners` is the constraint of each row, `attached` the bodies of each constraint; sets of neighbouring constraints are
    preferred.
    """
    owner, collected = np.array(owners), []
    spanned = np.zeros((N.shape[1], 0))  # basis of the combinations of the collected sets
    remaining = N
    while spanned.shape[1] < N.shape[1]:
        involved = list(dict.fromkeys(owner[np.linalg.norm(remaining, axis=1) > DEPENDENCE_TOL].tolist()))
        candidates = [_minimal_set_around(seed, involved, remaining, owner, attached) for seed in involved]
        for members in sorted(candidates, key=len):
            combinations = null_space(N[~np.isin(owner, members)], DEPENDENCE_TOL).T
            svd = np.linalg.svd(np.concatenate([spanned, combinations], axis=1), full_matrices=False)
            rank = int(np.sum(svd[1] > DEPENDENCE_TOL))
            if rank > spanned.shape[1]:
                collected.append(Dependency(tuple(members), rank - spanned.shape[1]))
                spanned = svd[0][:, :rank]
        # The remaining combinations: those that vanish in one row for each combination already spanned.
        remaining = N
        unexcluded = N @ spanned
        while unexcluded.shape[1]:
            row = int(np.argmax(np.linalg.norm(unexcluded, axis=1)))
            remaining = remaining @ np.linalg.svd(remaining[row : row + 1])[2][1:].T
            unexcluded = unexcluded @ np.linalg.svd(unexcluded[row : row + 1])[2][1:].T
    return sorted(collected, key=lambda dependency: len(dependency.constraints))


def dependencies_at(
    attached: dict[str, tuple[str, ...]], here: Configuration, generic: Sequence[Configuration], owners: Sequence[str]
) -> tuple[list[Dependency], list[Dependency]]:
    """Return the sets of constraints that are dependent in all generic configurations, and those dependent in `here` only.

    `owners` is the constraint of each row, and `attached` the bodies of each constraint.
    """
    best = max(generic, key=lambda c: c.smallest)
    permanent = dependencies(best.left, owners, attached)
    if here.rank == best.rank:
        return permanent, []
    # Combinations of rows that vanish here, without those that vanish everywhere: one row is excluded for each of the latter.
    spared = PositionRows.dispensable([best.left])
    N = here.left
    for row in spared:
        if np.linalg.norm(N[row]) > determinacy.UNIQUE_TOL:
            N = N @ np.linalg.svd(N[row : row + 1])[2][1:].T
    return permanent, dependencies(N, owners, attached)


def stress_of(N: np.ndarray, owners: Sequence[str], members: Iterable[str]) -> np.ndarray:
    """Return the combinations of a set's rows that vanish, (m, redundancy): the states of self-stress of the set."""
    return N @ null_space(N[~np.isin(np.array(owners), list(members))], DEPENDENCE_TOL).T


def _minimal_set_around(
    seed: str, involved: list[str], N: np.ndarray, owner: np.ndarray, attached: dict[str, tuple[str, ...]]
) -> list[str]:
    """Return a minimal dependent set around the constraint `seed`.

    Constraints of `involved` are removed from the set if possible, the farthest first.
    """
    far, members = _distances(seed, involved, attached), list(involved)
    left = N @ null_space(N[~np.isin(owner, involved)], DEPENDENCE_TOL).T  # combinations that vanish outside of the members
    for name in sorted(involved, key=lambda name: -far[name]):
        without = null_space(left[owner == name], DEPENDENCE_TOL)
        if len(without):
            members.remove(name)
            left = left @ without.T
    return members


def _distances(seed: str, names: list[str], attached: dict[str, tuple[str, ...]]) -> dict[str, int]:
    """Return the number of bodies between the constraint `seed` and each of the constraints in `names`, by name.

    Constraints that no bodies connect to `seed` have the distance `len(names)`.
    """
    far, edge = {seed: 0}, [seed]
    while edge:
        reached = {body for name in edge for body in attached[name]}
        near = [name for name in names if name not in far and reached & set(attached[name])]
        far |= dict.fromkeys(near, max(far.values()) + 1)
        edge = near
    return {name: far.get(name, len(names)) for name in names}
