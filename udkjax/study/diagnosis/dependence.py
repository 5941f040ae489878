"""Minimal sets of constraints that depend on each other: circuits of the matroid of the rows, constraint by constraint.

N spans the null space of J^T. The rows of a set S of constraints are dependent if and only if a combination y of the columns of N
vanishes outside S, N[outside] y = 0, and redundant by nullity(N) - rank(N[outside]). S is minimal if no constraint can be taken
out of it. Sets are looked for one after another: of the candidates, one grown around each constraint, the smallest; then as many
of its rows as are redundant are left out, until nothing depends on anything.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

DEPENDS = 1e-6  # the length of rows of N, whose columns are orthonormal: rounding leaves far less


class Dependency(NamedTuple):
    """A minimal set of constraints whose rows depend on each other."""

    constraints: tuple[str, ...]
    redundancy: int  # how many of their rows are redundant
    stress: dict[str, np.ndarray]  # of each, the multipliers (rows, redundancy) that keep each other in balance: N of its rows


def dependencies(N: np.ndarray, owners: Sequence[str], attached: dict[str, tuple[str, ...]]) -> list[Dependency]:
    """Return minimal dependent sets that together say all that N (m, k) does, the smallest first.

    `owners` is the constraint of each row, `attached` the bodies of each constraint, by which near ones are kept in a set first.
    """
    owner, kept, found = np.array(owners), np.ones(len(owners), bool), []
    while N.shape[1]:
        involved = list(dict.fromkeys(owner[np.linalg.norm(N, axis=1) > DEPENDS].tolist()))
        if not involved:
            break
        candidates = [_around(seed, involved, N, owner, attached) for seed in involved]
        members = min(candidates, key=len)
        inside, outside = np.isin(owner, members), ~np.isin(owner, members)
        y = _vanishing(N[outside])
        stress = N @ y
        found.append(Dependency(tuple(members), y.shape[1], {name: stress[owner == name] for name in members}))
        for _ in range(y.shape[1]):  # leave out a row of it, and with it a column of N
            row = int(np.argmax(np.where(inside & kept, np.linalg.norm(N @ y, axis=1), -1.0)))
            N = N @ np.linalg.svd(N[row : row + 1])[2][1:].T
            y = _vanishing(N[outside])
            kept[row] = False
    return found


def redundant_by(N: np.ndarray, owners: Sequence[str], members: Iterable[str]) -> int:
    """By how many rows a set of constraints is redundant in itself."""
    return N.shape[1] - _rank(N[~np.isin(np.array(owners), list(members))])


def _around(seed: str, involved: list[str], N: np.ndarray, owner: np.ndarray, attached: dict[str, tuple[str, ...]]) -> list[str]:
    """A minimal dependent set that is grown around one constraint: the farthest are taken out first."""
    far = _distances(seed, involved, attached)
    members = list(involved)
    for name in sorted(involved, key=lambda name: -far[name]):
        rest = [other for other in members if other != name]
        if redundant_by(N, owner.tolist(), rest):
            members = rest
    return members


def _distances(seed: str, names: list[str], attached: dict[str, tuple[str, ...]]) -> dict[str, int]:
    """How many bodies lie between one constraint and each of the others."""
    far, edge = {seed: 0}, [seed]
    while edge:
        reached = {body for name in edge for body in attached[name]}
        near = [name for name in names if name not in far and reached & set(attached[name])]
        far |= dict.fromkeys(near, max(far.values()) + 1)
        edge = near
    return {name: far.get(name, len(names)) for name in names}


def _rank(matrix: np.ndarray) -> int:
    return int(np.sum(np.linalg.svd(matrix, compute_uv=False) > DEPENDS)) if matrix.size else 0


def _vanishing(matrix: np.ndarray) -> np.ndarray:
    """The combinations of columns that vanish, orthonormal."""
    if not matrix.size:
        return np.eye(matrix.shape[1])
    return np.linalg.svd(matrix)[2][_rank(matrix) :].T
