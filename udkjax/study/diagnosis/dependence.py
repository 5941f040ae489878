"""Minimal sets of dependent constraints: circuits of the matroid of the rows, grouped by constraint.

N spans the null space of J^T. The rows of a set S of constraints are dependent if and only if a combination y of the columns of N
vanishes outside S, N[outside] y = 0; the number of redundant rows is nullity(N[outside]). S is minimal if no constraint can be
removed from it. One set is found around each constraint; the smallest are taken until their combinations y span all of N. Further
combinations are searched for after leaving out one row of each that was found.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from udkjax.pinv.row_spaces import null_space

DEPENDS = 1e-6  # norm of a row of N, whose columns are orthonormal, from which it is nonzero: far above rounding


class Dependency(NamedTuple):
    """A minimal set of constraints whose rows are dependent."""

    constraints: tuple[str, ...]
    redundancy: int  # number of their redundant rows


def dependencies(N: np.ndarray, owners: Sequence[str], attached: dict[str, tuple[str, ...]]) -> list[Dependency]:
    """Return minimal dependent sets whose combinations together span N (m, k), the smallest first.

    `owners` is the constraint of each row, `attached` the bodies of each constraint: neighbouring constraints are preferred.
    """
    owner, found = np.array(owners), []
    spanned = np.zeros((N.shape[1], 0))  # basis of the combinations of columns of the sets found so far
    remaining = N
    while spanned.shape[1] < N.shape[1]:
        involved = list(dict.fromkeys(owner[np.linalg.norm(remaining, axis=1) > DEPENDS].tolist()))
        candidates = [_minimal_set_around(seed, involved, remaining, owner, attached) for seed in involved]
        for members in sorted(candidates, key=len):
            own = null_space(N[~np.isin(owner, members)], DEPENDS).T
            both = np.linalg.svd(np.concatenate([spanned, own], axis=1), full_matrices=False)
            rank = int(np.sum(both[1] > DEPENDS))
            if rank > spanned.shape[1]:
                found.append(Dependency(tuple(members), rank - spanned.shape[1]))
                spanned = both[0][:, :rank]
        # Combinations that no set accounts for yet: those that vanish in one row for each combination already spanned.
        remaining = N
        rest = N @ spanned
        while rest.shape[1]:
            row = int(np.argmax(np.linalg.norm(rest, axis=1)))
            remaining = remaining @ np.linalg.svd(remaining[row : row + 1])[2][1:].T
            rest = rest @ np.linalg.svd(rest[row : row + 1])[2][1:].T
    return sorted(found, key=lambda dependency: len(dependency.constraints))


def redundant_by(N: np.ndarray, owners: Sequence[str], members: Iterable[str]) -> int:
    """Return the number of redundant rows of a set of constraints on its own."""
    return len(null_space(N[~np.isin(np.array(owners), list(members))], DEPENDS))


def stress_of(N: np.ndarray, owners: Sequence[str], members: Iterable[str]) -> np.ndarray:
    """Return combinations of a set's rows that vanish, (m, redundancy): its states of self-stress."""
    return N @ null_space(N[~np.isin(np.array(owners), list(members))], DEPENDS).T


def _minimal_set_around(
    seed: str, involved: list[str], N: np.ndarray, owner: np.ndarray, attached: dict[str, tuple[str, ...]]
) -> list[str]:
    """Return a minimal dependent set around one constraint: starting from all, the farthest are removed first."""
    far = _distances(seed, involved, attached)
    members = list(involved)
    for name in sorted(involved, key=lambda name: -far[name]):
        rest = [other for other in members if other != name]
        if redundant_by(N, owner.tolist(), rest):
            members = rest
    return members


def _distances(seed: str, names: list[str], attached: dict[str, tuple[str, ...]]) -> dict[str, int]:
    """Return the number of bodies between one constraint and each of the others."""
    far, edge = {seed: 0}, [seed]
    while edge:
        reached = {body for name in edge for body in attached[name]}
        near = [name for name in names if name not in far and reached & set(attached[name])]
        far |= dict.fromkeys(near, max(far.values()) + 1)
        edge = near
    return {name: far.get(name, len(names)) for name in names}
