"""Directions in the space of unknowns, as rows of matrices: null spaces, simplest bases, and how a direction is worded."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.study.wording import join_names

# Of the largest singular value of a Jacobian: directions below it do not show in what was measured. A change that leaves the
# equations of motion as they are has 1e-16, whatever the tolerance; derivatives integrated at 1e-7 have errors of 1e-8.
INVISIBLE = 1e-8
# Of the largest coefficient of a direction: unknowns with less of it take no part. Directions are that exact where their singular
# value is that much above the errors of the Jacobian.
PART = 1e-3
COEFFICIENT = 1e-5  # of the largest coefficient: zero, in directions found from differences that are good to 1e-8
COMMON = 1e-2  # relative: by how much factors may differ that are called a common one


class UnknownValues(NamedTuple):
    """The K unknowns at an estimate: parameters first, then those that nobody asked for.

    `kinds` are "positive", "bounded" or "free", as in `parameters`; `dx_dz` are derivatives by the dimensionless unknowns.
    """

    names: Sequence[str]
    units: Sequence[str]
    x: Float[np.ndarray, "K"]
    dx_dz: Float[np.ndarray, "K"]
    kinds: Sequence[str]

    def typical(self, k: int) -> float:
        """Return what a standard error is compared with: the value; of a parameter of either sign, its scale."""
        return float(abs(self.x[k]) or abs(self.dx_dz[k])) if self.kinds[k] == "bounded" else float(abs(self.dx_dz[k]))


class Direction(NamedTuple):
    """A change of unknowns that no measured quantity shows: the coefficients in z (N,), and the same in words."""

    names: tuple[str, ...]
    coefficients: Float[np.ndarray, "N"]
    text: str


def null_space(matrix: Float[np.ndarray, "R K"], tol: float) -> Float[np.ndarray, "D K"]:
    """Return an orthonormal basis, as rows, of what a matrix maps to zero; singular values up to `tol` count as zero."""
    _, sigma, vt = np.linalg.svd(matrix)
    return vt[int(np.sum(sigma > tol)) :]


def row_space(matrix: Float[np.ndarray, "R K"], tol: float) -> Float[np.ndarray, "D K"]:
    """Return the span of the rows of a matrix, in reduced echelon form."""
    _, sigma, vt = np.linalg.svd(matrix, full_matrices=False)
    return echelon(vt[: int(np.sum(sigma > tol))])


def echelon(rows: Float[np.ndarray, "R K"], tol: float = COEFFICIENT) -> Float[np.ndarray, "D K"]:
    """Return independent rows in reduced echelon form; what is below `tol`, relative to a row's largest entry, is made zero."""
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
    """Return the sets of columns that rows connect; columns of zeros are in none."""
    sets: list[set[int]] = []
    for row in relations:
        members = set(np.flatnonzero(row).tolist())
        separate = [s for s in sets if not s & members]
        sets = [*separate, members.union(*(s for s in sets if s & members))]
    return sorted(sorted(members) for members in sets if members)


def simplest_basis(
    free: Float[np.ndarray, "D K"], x: Float[np.ndarray, "K"], dx_dz: Float[np.ndarray, "K"], kinds: Sequence[str]
) -> Float[np.ndarray, "D K"]:
    """Return rows of few unknowns each that span the same as the orthonormal rows `free`; a common factor first, if it is one."""
    found = echelon(free, PART)
    relative = np.array([kind != "free" for kind in kinds], bool) & (x != 0.0) & np.any(found != 0.0, axis=0)
    if len(found) < 2 or not relative.any():
        return found
    factor = np.where(relative, x / dx_dz, 0.0)
    outside = factor - free.T @ (free @ factor)
    if np.linalg.norm(outside) > PART * np.linalg.norm(factor):
        return found
    # The factor takes the place of the direction that it is most of.
    share = np.abs(np.linalg.lstsq(found.T, factor, rcond=None)[0]) * np.linalg.norm(found, axis=1)
    return np.concatenate([factor[None], np.delete(found, int(np.argmax(share)), axis=0)])


def describe(values: UnknownValues, coefficients: Float[np.ndarray, "K"]) -> Direction:
    """Word a direction of z: as a common factor where it is one, else with one percent of the unknown that changes most."""
    there = np.flatnonzero(coefficients).tolist()
    x, change = (np.asarray(a, float)[there] for a in (values.x, values.dx_dz))
    change = change * coefficients[there]
    names, kinds = [values.names[k] for k in there], [values.kinds[k] for k in there]
    relative = np.array([kind != "free" and value != 0.0 for kind, value in zip(kinds, x, strict=True)])
    factors = np.where(relative, change / np.where(relative, x, 1.0), 0.0)
    if len(there) > 1 and relative.all() and np.all(np.abs(factors / factors[0] - 1.0) < COMMON):
        text = f"{join_names(names)} by a common factor"
    else:
        reference = factors if relative.any() else coefficients[there]
        unit = 0.01 / reference[np.argmax(np.abs(reference))]
        parts = [
            f"{name} {100 * unit * f:+.3g} %" if percent else f"{name} {unit * dx:+.3g} {values.units[k]}".rstrip()
            for name, percent, f, dx, k in zip(names, relative, factors, change, there, strict=True)
        ]
        text = parts[0] + (f" with {join_names(parts[1:])}" if len(parts) > 1 else "")
    return Direction(tuple(names), coefficients[there] / np.abs(coefficients).max(), text)
