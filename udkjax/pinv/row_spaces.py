"""Spaces of vectors as the rows of matrices: null spaces, row spaces, and their simplest bases."""

import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components

SMALLEST_COEFFICIENT = 1e-5  # relative to the largest; directions from difference quotients are accurate to 1e-8


def null_space(matrix: Float[np.ndarray, "R K"], tol: float) -> Float[np.ndarray, "D K"]:
    """Return an orthonormal basis of the null space of a matrix, as rows; singular values up to `tol` count as zero."""
    _, sigma, vt = np.linalg.svd(matrix)
    return vt[int(np.sum(sigma > tol)) :]


def row_space(matrix: Float[np.ndarray, "R K"], tol: float) -> Float[np.ndarray, "D K"]:
    """Return a basis of the row space of a matrix, in reduced echelon form."""
    _, sigma, vt = np.linalg.svd(matrix, full_matrices=False)
    return echelon(vt[: int(np.sum(sigma > tol))])


def echelon(rows: Float[np.ndarray, "R K"], tol: float = SMALLEST_COEFFICIENT) -> Float[np.ndarray, "D K"]:
    """Return independent rows in reduced echelon form; entries below `tol` times the largest in their row become zero."""
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


def connected_columns(relations: Float[np.ndarray, "R K"]) -> list[list[int]]:
    """Return the sets of columns that rows connect by nonzero entries, as indices; columns of zeros are in none of the sets."""
    nonzero = np.asarray(relations) != 0.0
    _, label = connected_components(nonzero.T.astype(int) @ nonzero, directed=False)
    return [np.flatnonzero(label == k).tolist() for k in np.unique(label[nonzero.any(0)])]
