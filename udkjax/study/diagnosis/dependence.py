"""Minimal sets of constraints that depend on each other: circuits of the matroid of the rows, constraint by constraint.

N spans the null space of J^T. The rows of a set S of constraints are dependent if and only if a combination y of the columns of N
vanishes outside S, N[outside] y = 0, and redundant by nullity(N) - rank(N[outside]). S is minimal if no constraint can be taken
out of it. One set is grown around each constraint; the smallest are taken until their combinations y span all of N. Further
combinations are searched for without a row of each that is known.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from udkjax.pinv.row_spaces import null_space

DEPENDS = 1e-6  # the length of rows of N, whose columns are orthonormal: rounding leaves far less


class Dependency(NamedTuple):
    """A minimal set of constraints whose rows depend on each other."""

    constraints: tuple[str, ...]
    redundancy: int  # number of their redundant rows


def dependencies(N: np.ndarray, owners: Sequence[str], attached: dict[str, tuple[str, ...]]) -> list[Dependency]:
    """Return minimal dependent sets that together say all that N (m, k) does, the smallest first.

    `owners` is the constraint of each row, `attached` the bodies of each constraint, by which near ones come first into a set.
    """
    owner, found = np.array(owners), []
    spanned = np.zeros((N.shape[1], 0))  # the combinations of columns that the sets found so far are made of
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
        # Combinations that no set accounts for yet: those of N that vanish in one row for each that the sets span.
        remaining = N
        rest = N @ spanned
        while rest.shape[1]:
            row = int(np.argmax(np.linalg.norm(rest, axis=1)))
            remaining = remaining @ np.linalg.svd(remaining[row : row + 1])[2][1:].T
            rest = rest @ np.linalg.svd(rest[row : row + 1])[2][1:].T
    return sorted(found, key=lambda dependency: len(dependency.constraints))


def redundant_by(N: np.ndarray, owners: Sequence[str], members: Iterable[str]) -> int:
    """Return by how many rows a set of constraints is redundant in itself."""
    return len(null_space(N[~np.isin(np.array(owners), list(members))], DEPENDS))


def stress_of(N: np.ndarray, owners: Sequence[str], members: Iterable[str]) -> np.ndarray:
    """Return combinations of a set's rows that vanish, (m, redundancy): forces by which it balances itself."""
    return N @ null_space(N[~np.isin(np.array(owners), list(members))], DEPENDS).T


def _minimal_set_around(
    seed: str, involved: list[str], N: np.ndarray, owner: np.ndarray, attached: dict[str, tuple[str, ...]]
) -> list[str]:
    """Return a minimal dependent set around one constraint: of all, the farthest are taken out first."""
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
