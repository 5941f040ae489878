"""The balance of Psi_q: units of rows and coordinates in which the slow and the fast wheel of a gear move equally far.

In the units of `Scales`, L and one radian, a wheel that turns a million times as fast as another enters their row with a
millionth of the other's coefficient. Singular values then say how far gears reduce a motion, not whether rows depend on each
other, and no threshold separates the two. So ranks are counted with rows and columns multiplied by factors,

    diag(exp r) J diag(exp c),        r and c minimize  sum_ik w_ik (log |J_ik| + r_i + c_k)^2,

which make the coefficients about one (Curtis and Reid 1972). The rank is the same, and so are the null spaces, in other units.
A coefficient counts by w, its size relative to the largest of its row. c is zero for an angle on which coefficients depend: a
link that turns by more than a radian moves along arcs, and its unit is one radian. It is free for displacements, and for wheels
that turn about their centres. Coefficients are the largest of several random positions, so that none is small by chance.

Source:
    A. R. Curtis, J. K. Reid, On the automatic scaling of matrices for Gaussian elimination, IMA J. Appl. Math. 10 (1972) 118-124.
"""

from typing import NamedTuple

import numpy as np

from udkjax.arrays import ROUNDING
from udkjax.equations.programs.scales import concrete_scales
from udkjax.equations.programs.scene_arrays import arrays_in_time
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism

# Factors are powers of ten, so that small changes of numbers do not change them; if all are within a decade of each other, which
# no threshold of a rank notices, they are one.
LEAST_SPREAD = 2
RANDOM_POSITIONS = 2  # within L and one radian of the guess: a coefficient that is small there and at the guess is small anywhere
# Relative difference of coefficients that do not depend on positions: far above rounding errors of angles of any usual size, and
# far below what a radian changes.
CONSTANT_COEFFICIENT_TOL = 1e-6
# Weight that ends the freedom to multiply all rows and divide all columns of a part of the scene; the weights of coefficients are
# at most one.
ANCHOR_WEIGHT = 1e-9
MANY_UNKNOWNS = 400  # rows and groups above which sparse matrices are used


class BalancedUnits(NamedTuple):
    """Factors of the units of rows and coordinates, powers of ten."""

    rows: tuple[float, ...]
    coordinates: tuple[float, ...]


@cached_by_identity
def balance_of(mechanism: Mechanism) -> BalancedUnits | None:
    """Return the balance of Psi_q of a mechanism with concrete numbers; None if the units of `Scales` are balanced enough."""
    sizes = _Coefficients(mechanism)
    if not sizes.rows.size:
        return None
    powers = np.round(_solve(sizes) / np.log(10.0))
    r, c = powers[: sizes.row_count], powers[sizes.row_count :]
    c = np.where(sizes.is_free, c, 0.0)
    if np.ptp(r) < LEAST_SPREAD and np.ptp(c) < LEAST_SPREAD:
        return None
    return BalancedUnits(tuple((10.0**-r).tolist()), tuple((10.0 ** c[sizes.group_of_coordinate]).tolist()))


class _Coefficients:
    """The sizes of the coefficients of Psi_q, by rows and groups of coordinates: a body's two displacements, and its angle."""

    def __init__(self, mechanism: Mechanism):
        programs = scene_programs(mechanism)
        i, k = (np.asarray(x) for x in programs.psi_q_entries[:2])
        n, self.row_count = programs.coordinate_count, programs.row_count
        self.group_of_coordinate = 2 * (np.arange(n) // 3) + (np.arange(n) % 3 == 2)
        self.group_count = 2 * (n // 3)
        scales, arrays = concrete_scales(mechanism), arrays_in_time(mechanism)(0.0)
        length, of_rows = float(scales.length), np.asarray(scales.rows, float)
        unit = np.tile([length, length, 1.0], n // 3)
        place = i * self.group_count + self.group_of_coordinate[k]
        places, inverse = np.unique(place, return_inverse=True)
        random = np.random.default_rng(0).uniform(-1.0, 1.0, (RANDOM_POSITIONS, n))
        q = np.asarray(mechanism.q0, float).ravel() + unit * np.concatenate([np.zeros((1, n)), random])
        entries = arrays.jacobian(np.zeros(len(q)), q.T).T * (unit[k] / of_rows[i])
        squares = np.where(np.isfinite(entries), entries, 0.0) ** 2
        found = np.sqrt([np.bincount(inverse, x, len(places)) for x in squares])
        size = np.max(found, axis=0)
        rows, groups = np.divmod(places, max(self.group_count, 1))
        largest = np.zeros(self.row_count)
        np.maximum.at(largest, rows, size)
        moves = size > ROUNDING * largest[rows]
        varies = np.ptp(found, axis=0) > CONSTANT_COEFFICIENT_TOL * size
        self.is_free = np.ones(self.group_count, bool)
        self.is_free[groups[moves & varies]] = False
        self.rows, self.groups, self.size = rows[moves], groups[moves], size[moves]
        self.weight = self.size / largest[self.rows]


def _solve(sizes: _Coefficients) -> np.ndarray:
    """Return r of the rows, followed by c of the groups, which is zero if a group is not free, by the normal equations."""
    m, logs, w = sizes.row_count, np.log(sizes.size), sizes.weight
    free = sizes.is_free[sizes.groups]
    columns = m + sizes.groups
    count = m + sizes.group_count
    diagonal = ANCHOR_WEIGHT + np.bincount(sizes.rows, w, count) + np.bincount(columns, w, count)
    right = -np.bincount(sizes.rows, w * logs, count) - np.bincount(columns, w * logs, count)
    right[m:][~sizes.is_free] = 0.0
    i, k, off = sizes.rows[free], columns[free], w[free]
    if count <= MANY_UNKNOWNS:
        matrix = np.diag(diagonal)
        matrix[i, k] = matrix[k, i] = off
        return np.linalg.solve(matrix, right)
    from scipy.sparse import csc_array  # small scenes do not need SciPy
    from scipy.sparse.linalg import spsolve

    everything = np.arange(count)
    values, places = np.concatenate([diagonal, off, off]), (np.r_[everything, i, k], np.r_[everything, k, i])
    return spsolve(csc_array((values, places), shape=(count, count)), right)
