"""Uniqueness of multipliers by equilibrium alone (Wojtyra 2009), and the rank of the constraints in the scene's units.

If N spans the null space of Psi_q^T, lambda + N y satisfies M a + Psi_q^T lambda = F for every y as lambda does. So c^T lambda is
unique if and only if c^T N = 0, and a single multiplier if its row of N is zero.

Rank and null space are those of the scaled Jacobian J = diag(1 / rows) Psi_q diag(L, L, 1, ...) (`Scales`), with lengths in units
of the characteristic length, angles in radians, and each row divided by its scale; masses do not enter. Where gears make some
coordinates move much further than others, the units are balanced (balance.py). All functions are pure
and may be mapped over states (`jax.vmap`); without an `analysis` the scales are computed from the mechanism.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.annotations import NumberLike
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.terms import constraints
from udkjax.equations.terms.constraints import BodyArray
from udkjax.scene.mechanism import Mechanism

# Rank tolerance of statics, relative to the largest singular value. The tolerance of motion, `RANK_TOL`, is larger because runs
# have to cross singular configurations. There, a rounding error of 1e-16 in Psi allows a displacement of its square root, 1e-8,
# and the singular value that should vanish has that size; the tolerance of statics is a hundred times larger.
STATIC_RANK_TOL = 1e-6
# A row of N, whose columns are orthonormal, counts as zero up to this length; rounding errors reach 1e-15 / STATIC_RANK_TOL.
UNIQUE_TOL = 1e-6


class Uniqueness(NamedTuple):
    """Marks of unique multipliers, the degree of indeterminacy of each multiplier, and the rank."""

    unique: Bool[Array, "m"]
    share: Float[Array, "m"]  # the length of each row of N, 0 (unique) to 1 (arbitrary)
    rank: Int[Array, ""]


class LeftNullSpace(NamedTuple):
    """N (m, m) of the scaled rows, with orthonormal columns; columns beyond the nullity are zero."""

    basis: Float[Array, "m m"]
    rank: Int[Array, ""]


def scaled_jacobian(mechanism: Mechanism, t: NumberLike, q: BodyArray, analysis: Analysis | None = None) -> Float[Array, "m n"]:
    """Return the dimensionless J = diag(1 / rows) Psi_q diag(L, L, 1, ...).

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        analysis: The mechanism's `Analysis`, for its scales; by default computed here.

    Returns:
        J (m, n).
    """
    found = analyse(mechanism) if analysis is None else analysis
    return constraints.psi_q(mechanism, t, q) * found.coordinate_units / found.row_units[:, None]


def singular_values(mechanism: Mechanism, t: NumberLike, q: BodyArray, analysis: Analysis | None = None) -> Float[Array, "k"]:
    """Return the singular values of the scaled Jacobian J = diag(1 / rows) Psi_q diag(L, L, 1, ...), largest first.

    Derivatives take L and the sizes of the rows, which are those of `analysis`, as constants.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        analysis: The mechanism's `Analysis`, for its scales; by default computed here.

    Returns:
        min(m, n) singular values, dimensionless.
    """
    J = scaled_jacobian(mechanism, t, q, analysis)
    return jnp.linalg.svd(J, compute_uv=False) if J.size else jnp.zeros(0)


def left_null_space(
    mechanism: Mechanism, t: NumberLike, q: BodyArray, analysis: Analysis | None = None, rank_tol: NumberLike = STATIC_RANK_TOL
) -> LeftNullSpace:
    """Return N with J^T N = 0, and the rank of J; singular values up to `rank_tol` times the largest count as zero."""
    J = scaled_jacobian(mechanism, t, q, analysis)
    rows, columns = J.shape
    if not J.size:
        return LeftNullSpace(jnp.eye(rows), jnp.zeros((), int))
    u, sigma, _ = jnp.linalg.svd(jnp.pad(J, ((0, 0), (0, max(0, rows - columns)))), full_matrices=False)
    zero = sigma <= rank_tol * sigma[0]
    return LeftNullSpace(jnp.where(zero, u, 0.0), rows - zero.sum())


def uniqueness(
    mechanism: Mechanism, t: NumberLike, q: BodyArray, analysis: Analysis | None = None, rank_tol: NumberLike = STATIC_RANK_TOL
) -> Uniqueness:
    """Return marks of the rows of Psi whose multipliers are unique: their rows of N are zero.

    Args:
        mechanism: its numbers may be traced.
        t: time (s).
        q: coordinates of a closed position, (bodies, 3) or flat.
        analysis: the mechanism's `Analysis`, for its scales; by default computed here.
        rank_tol: singular values of J up to this fraction of the largest count as zero.

    Returns:
        `Uniqueness`, one entry for each row: joints in their order, then drivers.

    Source:
        M. Wojtyra, Joint reactions in rigid body mechanisms with dependent constraints, Mech. Mach. Theory 44 (2009) 2265-2278.
    """
    basis, rank = left_null_space(mechanism, t, q, analysis, rank_tol)
    share = jnp.linalg.norm(basis, axis=1)
    return Uniqueness(share <= UNIQUE_TOL, share, rank)


def unique_direction(null_rows: np.ndarray) -> float | None:
    """Return the only direction (rad, 0 to pi) in which a planar force is unique; None if all directions are or none is.

    `null_rows` (2, k) are the rows of N that belong to the components of the force, in the same unit.
    """
    u, sigma, _ = np.linalg.svd(np.pad(null_rows, ((0, 0), (0, 2))))
    loose = int(np.sum(sigma > UNIQUE_TOL))
    return float(np.arctan2(u[1, 1], u[0, 1]) % np.pi) if loose == 1 else None
