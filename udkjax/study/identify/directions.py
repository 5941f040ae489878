"""Directions of several parameters: linear algebra on them as rows, and how they are said."""

from collections.abc import Sequence
from typing import Any

import numpy as np

# Of the largest coefficient of a direction: what counts as zero. Directions are found from derivatives that are good to 1e-8.
COEFFICIENT = 1e-5
LISTED = 8  # names in a message


def null_space(matrix: np.ndarray, tol: float) -> np.ndarray:
    """An orthonormal basis, as rows, of what a matrix maps to zero, where singular values up to `tol` count as zero."""
    _, sigma, vt = np.linalg.svd(matrix)
    return vt[int(np.sum(sigma > tol)) :]


def row_space(matrix: np.ndarray, tol: float) -> np.ndarray:
    """The span of the rows of a matrix, in reduced echelon form."""
    _, sigma, vt = np.linalg.svd(matrix, full_matrices=False)
    return reduced(vt[: int(np.sum(sigma > tol))])


def reduced(rows: np.ndarray, tol: float = COEFFICIENT) -> np.ndarray:
    """Independent rows in reduced echelon form; what is below `tol`, relative to a row's largest entry, is made zero."""
    rows, done = np.array(rows, float), 0
    for column in range(rows.shape[1]):
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) <= tol:
            continue
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        others = np.arange(len(rows)) != done
        rows[others] -= np.outer(rows[others, column], rows[done])
        done += 1
    rows = rows[:done]
    return np.where(np.abs(rows) > tol * np.abs(rows).max(axis=1, keepdims=True, initial=0.0), rows, 0.0)


def connected(relations: np.ndarray) -> list[list[int]]:
    """The sets of columns that rows connect; columns of zeros are in none."""
    sets: list[set[int]] = []
    for row in relations:
        members = set(np.flatnonzero(row).tolist())
        apart = [s for s in sets if not s & members]
        sets = [*apart, members.union(*(s for s in sets if s & members))]
    return sorted(sorted(members) for members in sets if members)


# --- words


def ratio(values: Any) -> str:
    """Some numbers relative to the first, such as 1 : 2 : 0.5."""
    return " : ".join(f"{v / values[0]:.4g}" for v in values)


def listed(names: Sequence[str]) -> str:
    """Some names as they stand in a sentence."""
    if len(names) > LISTED:
        return f"{', '.join(names[:LISTED])} and {len(names) - LISTED} more"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
