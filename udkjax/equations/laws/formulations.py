"""Other formulations of the equations of motion (de Falco, Pennestri, Vita 2005, section 7), to compare with Udwadia-Kalaba.

All of them solve, with A = Psi_q and c = gamma - 2 alpha Psi_dot - beta^2 Psi,

    M a + A^T lambda = F,        A a = c,

and return the same a if the rows of A are independent. With redundant rows, and in singular configurations, they make different
assumptions, and some of them fail.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.annotations import Time, Vector
from udkjax.arrays import number, number_called
from udkjax.equations.laws.abstract_system import AbstractSystem, TangentPart
from udkjax.equations.programs.scales import UnitScales
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.pinv import Pseudoinverse
from udkjax.pinv.householder import complete_qr
from udkjax.pinv.rule import exceeds
from udkjax.printing import PrintsLine


class Formulation(PrintsLine):
    """A way to compute the accelerations of a system, for `simulate(..., formulation=...)`."""

    @abstractmethod
    def formulate(self, equations: AbstractSystem) -> AbstractSystem:
        """Return equations of motion that wrap `equations` and compute the accelerations by this formulation."""


class PointwiseFormulation(Formulation):
    """Base of formulations of your own, which only change how a is computed at a given state: override `solve`.

    `solve` is written in jax.numpy, and never differentiated. Arithmetic, products, reductions, indexing, linear systems, loops
    and branches become machine code, also with arrays as fields, if M is diagonal. With other operations, such as
    `jnp.linalg.eigh`, runs are integrated by diffrax, with the equations in plain JAX.
    """

    def formulate(self, equations: AbstractSystem) -> "FormulatedSystem":
        return FormulatedSystem(equations, self)

    @abstractmethod
    def solve(self, M: Float[Array, "n n"], F: Vector, A: Float[Array, "m n"], c: Float[Array, "m"]) -> Vector:
        """Return the accelerations a (n,) that satisfy M a + A^T lambda = F and A a = c."""


class Augmented(PointwiseFormulation):
    """Accelerations and multipliers at once:

        [ M  A^T ] [   a    ]   [ F ]
        [ A   0  ] [ lambda ] = [ c ].

    The default is LU with partial pivoting, the usual method, which requires independent rows. With redundant rows the matrix is
    singular, and a pivot is zero or a rounding error. LU that divides by such a pivot multiplies the inconsistency of the rows by
    1e16, and steps become ever smaller; so here the result is NaN, and a run ends at once with `Result.not_finite`.
    With a pseudoinverse as `method`, for instance `Augmented(udk.SVD())`, a and lambda are the solution of minimum norm:
    redundant constraints share their forces, and the accelerations are right, also in singular configurations with a consistent
    right-hand side. The default `rank_tol` of `method` is the square of the usual one: a singular value sigma of D = A M^(-1/2)
    is about sigma^2 here.

    Args:
        method: a pseudoinverse, such as `SVD()`; None: LU with partial pivoting.
    """

    method: Pseudoinverse | None = None

    def solve(self, M, F, A, c):
        matrix = jnp.block([[M, A.T], [A, jnp.zeros((len(A), len(A)))]])
        right = jnp.concatenate([F, c])
        if self.method is None:
            return solve_regular(matrix, right)[: len(F)]
        tol = RANK_TOL**2 if self.method.rank_tol is None else self.method.rank_tol
        method = eqx.tree_at(lambda m: m.rank_tol, self.method, number(tol), is_leaf=lambda x: x is None)
        return method.solve(matrix, right).x[: len(F)]


def solve_regular(matrix: Float[Array, "n n"], right: Vector) -> Vector:
    """Return x of matrix x = right by LU with partial pivoting, P matrix = L U; NaN if the matrix is singular up to rounding.

    Since entries of L are at most one, a pivot contains rounding errors of the order of the largest entry in its column of U. It
    counts as zero if it is at most n eps times this entry: with redundant rows it is at most 0.03, with independent rows at least
    1e13 times this threshold, in all mechanisms of the library.
    """
    lu, permutation = jax.scipy.linalg.lu_factor(matrix)
    upper = jnp.abs(jnp.triu(lu))
    is_regular = jnp.all(jnp.diag(upper) > len(matrix) * jnp.finfo(matrix.dtype).eps * jnp.max(upper, axis=0))
    return jnp.where(is_regular, jax.scipy.linalg.lu_solve((lu, permutation), right), jnp.nan)


class NullSpaceQR(PointwiseFormulation):
    """Equations of motion along the null space of A, by pivoted QR: with A^T = Q R, Q = (Q_1, N) orthogonal,

        a_p = Q_1 R_1^(-T) c,        N^T M N z = N^T (F - M a_p),        a = a_p + N z.

    Q_1 has as many columns as A has independent rows: pivoting stops when the remainders fall to `rank_tol` times the longest
    row. Redundant rows are left out; which rows these are may change with the position, without effect while they are satisfied.
    So drift is not amplified: without any stabilization, the error of the paper's linkage is 5e-9 after 20 s at a tolerance of
    1e-9. In a singular configuration the rank falls and N gains a column. With `Projection` the run crosses the configuration,
    but takes up to nine times as many steps as with `NullSpaceSVD` if the choice of rows changes nearby.

    Args:
        rank_tol: threshold of dependence, relative to the longest row or the largest singular value.
    """

    rank_tol: Float[Array, ""] = eqx.field(converter=number_called("rank_tol"), default=RANK_TOL)

    def solve(self, M, F, A, c):
        if not len(A):
            return null_space_accelerations(M, F, jnp.eye(len(F)), jnp.zeros_like(F))
        threshold = self.rank_tol * jnp.linalg.norm(A, axis=1).max()
        q, r, order, rank = complete_qr(A.T, threshold)
        inside = jnp.arange(len(order)) < rank
        triangle = jnp.where(inside[:, None] & inside, r[: len(order), order], jnp.eye(len(order)))
        z = jax.scipy.linalg.solve_triangular(triangle, jnp.where(inside, c[order], 0), trans=1)
        a_p = q[:, : len(order)] @ z
        null = jnp.where(jnp.arange(len(F)) < rank, 0, q)
        return null_space_accelerations(M, F, null, a_p)


class NullSpaceSVD(PointwiseFormulation):
    """Equations of motion along the null space of A, by singular values: with A = U S V^T, V = (V_1, N),

        a_p = V_1 S_1^(-1) U_1^T c,        N^T M N z = N^T (F - M a_p),        a = a_p + N z.

    Singular values up to `rank_tol` times the largest count as zero. Inconsistent redundant rows are satisfied in the sense of
    least squares, so without stabilization their drift grows as it does with a truncated pseudoinverse: a run of the paper's
    linkage goes wrong after 18 s. In a singular configuration N gains a column, and with `Projection` the run crosses it. The
    difference from the Udwadia-Kalaba equation by singular values is the metric in which rank and least squares are computed: A
    is not weighted by the masses.

    Args:
        rank_tol: threshold of dependence, relative to the longest row or the largest singular value.
    """

    rank_tol: Float[Array, ""] = eqx.field(converter=number_called("rank_tol"), default=RANK_TOL)

    def solve(self, M, F, A, c):
        if not len(A):
            return null_space_accelerations(M, F, jnp.eye(len(F)), jnp.zeros_like(F))
        u, sigma, vt = jnp.linalg.svd(A, full_matrices=True)
        size = len(sigma)
        counts = exceeds(sigma, self.rank_tol * sigma[0])
        a_p = vt[:size].T @ (jnp.where(counts, 1 / jnp.where(counts, sigma, 1), 0) * (u[:, :size].T @ c))
        null = jnp.where(jnp.arange(len(F)) < counts.sum(), 0, vt.T)
        return null_space_accelerations(M, F, null, a_p)


def null_space_accelerations(M: Float[Array, "n n"], F: Vector, N: Float[Array, "n k"], a_p: Vector) -> Vector:
    """Return a = a_p + N z with N^T M N z = N^T (F - M a_p); the nonzero columns of N are independent."""
    projected = N.T @ M @ N
    missing = jnp.all(N == 0, axis=0)
    z = jnp.linalg.solve(projected + jnp.diag(jnp.where(missing, 1.0, 0.0)), N.T @ (F - M @ a_p))
    return a_p + N @ z


class WrappedSystem(AbstractSystem):
    """Equations of motion that wrap others and compute the accelerations in another way.

    At constant rank both are the same function, so the derivatives are those of the wrapped equations.
    """

    equations: eqx.AbstractVar[AbstractSystem]

    @property
    def textbook(self) -> Any:
        return self.equations.textbook

    def multipliers(self, t: Time, q: Vector, v: Vector) -> Float[Array, "m"]:
        return self.equations.multipliers(t, q, v)

    def matrices(self, t: Time, q: Vector, v: Vector) -> tuple[Array, Vector, Array, Array]:
        return self.equations.matrices(t, q, v)

    def violation(self, t: Time, q: Vector, v: Vector) -> tuple[Array, Array]:
        return self.equations.violation(t, q, v)

    def size(self, dq: Vector) -> Float[Array, ""]:
        return self.equations.size(dq)

    def violation_size(self, psi: Vector) -> Float[Array, ""]:
        return self.equations.violation_size(psi)

    def is_finite(self, t: Time, q: Vector, v: Vector) -> Bool[Array, ""]:
        return jnp.all(jnp.isfinite(self.accelerations(t, q, v)))

    @property
    def constrained(self) -> bool:
        return self.equations.constrained


class FormulatedSystem(WrappedSystem):
    """Equations of motion with accelerations by a formulation; projections are those of the wrapped equations."""

    equations: AbstractSystem
    formulation: PointwiseFormulation

    def accelerations(self, t: Time, q: Vector, v: Vector) -> Vector:
        return _accelerations(self, t, q, v)

    def project(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        return self.equations.project(t, q, v)

    def tangent_part(self, t: Time, q: Vector, v: Vector, dq: Vector, dv: Vector) -> TangentPart:
        return self.equations.tangent_part(t, q, v, dq, dv)


@eqx.filter_custom_jvp
def _accelerations(formulated: FormulatedSystem, t: Time, q: Vector, v: Vector) -> Vector:
    """Return the accelerations by the formulation, which is given M, F, A and c in the scene's units.

    There coordinates, rows and masses are of order one, which suits relative rank tolerances.
    """
    M, F, A, c = formulated.matrices(t, q, v)
    scales = getattr(formulated.equations, "scales", None)
    if scales is None or isinstance(scales, UnitScales):
        return formulated.formulation.solve(M, F, A, c)
    unit = scales.coordinates(len(F))
    inertia = scales.mass * scales.length**2
    M, F = M * unit[:, None] * unit / inertia, unit * F / inertia
    return unit * formulated.formulation.solve(M, F, A * unit / scales.rows[:, None], c / scales.rows)


@_accelerations.def_jvp
def _(primals, tangents):
    plain = lambda formulated, *state: formulated.equations.accelerations(*state)  # noqa: E731
    return _accelerations(*primals), eqx.filter_jvp(plain, primals, tangents)[1]
