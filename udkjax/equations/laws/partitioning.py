"""Coordinate partitioning (Wehage and Haug, ASME J. Mech. Des. 104 (1982) 247): only independent coordinates are integrated.

Pivoting splits the coordinates into dependent ones, as many as D has independent columns, and the independent rest. Given the
independent q_i and v_i, the dependent ones follow from the constraints,

    Psi(t, q_d, q_i) = 0 by Newton's method,        Psi_dot(t, q, v_d, v_i) = 0, which is linear in v_d,

and the equations of motion are projected onto the columns of N, one for each independent coordinate: the velocities of the
mechanism when this coordinate has rate one and the other independent ones rate zero. Rows phi(t, q, v) = 0 of a user-defined
system, which restrict velocities alone, make more velocities dependent than coordinates.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import DTypeLike

from udkjax.annotations import Time, Vector
from udkjax.arrays import number_called
from udkjax.equations.laws.abstract_system import AbstractSystem, ConstrainedRows
from udkjax.equations.laws.formulations import Formulation, WrappedSystem, null_space_accelerations
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.pinv import SVD, Plus
from udkjax.pinv.householder import complete_qr
from udkjax.transforms.newton_steps import repeated_newton


class NewtonLimits(NamedTuple):
    """Limits of Newton's method in dependent coordinates."""

    most_steps: int = 10  # from the predicted state; three or four are usual

    def last_change(self, dtype: DTypeLike) -> float:
        """Return the largest change, relative to the scales, of a step that may be the last: the remaining error is about eps."""
        return float(np.sqrt(jnp.finfo(dtype).eps))


PARTITION_NEWTON = NewtonLimits()


class CoordinatePartitioning(Formulation):
    """Integrate only the independent coordinates and velocities; solve the constraints for the dependent ones at each stage.

    The partition is chosen at the start of every step, by QR of D with column pivoting, and fixed for that step, so the columns
    of the dependent coordinates are well conditioned wherever D is. Dependent coordinates serve only as the initial guess of
    Newton's method and do not enter the error estimate. If Newton's method does not converge at a stage, or ends farther than 0.3
    rad, or 0.3 characteristic lengths, from that guess, the stage is NaN and a shorter step is taken. So the constraints hold
    wherever the equations are evaluated: `Baumgarte` is refused, and `Projection` changes nothing.

    Redundant rows are satisfied in the sense of least squares. In a singular configuration, where the remaining columns of D are
    shorter than `rank_tol` times the longest, a step has more independent coordinates, which later steps constrain again: runs of
    the paper's linkage cross such configurations (20 s at a tolerance of 1e-9 from each of the initial states in
    tests/integrate/test_accuracy.py: errors up to 9e-7).

    Machine code integrates with explicit Runge-Kutta methods. Derivatives are those of a run by the Udwadia-Kalaba equation with
    the same tolerances, which has the same motion.

    Args:
        rank_tol: threshold of dependence, relative to the longest column or the largest singular value; None: `Scales.rank_tol`.
    """

    rank_tol: Float[Array, ""] | None = eqx.field(converter=number_called("rank_tol", optional=True), default=None)

    def formulate(self, equations: AbstractSystem) -> "PartitionedSystem":
        if not isinstance(equations, ConstrainedRows):
            raise ValueError(f"CoordinatePartitioning does not know the rows of {type(equations).__name__}")
        if equations.stabilized:
            raise ValueError(
                "CoordinatePartitioning satisfies the constraints at every stage and takes no Baumgarte stabilization; "
                "use stabilization=None or Projection()"
            )
        return PartitionedSystem(equations, self)


class PartitionedSystem(WrappedSystem):
    """The equations of motion of the independent coordinates of a system.

    Unless a partition is fixed, it is chosen anew at each state.
    """

    solves_constraints = True
    equations: ConstrainedRows
    formulation: CoordinatePartitioning
    dependent: Bool[Array, "2 n"] | None = None  # the dependent coordinates and velocities, if the partition is fixed

    def accelerations(self, t: Time, q: Vector, v: Vector) -> Vector:
        """Return a = a_p + N z at the state, without solving for dependent coordinates."""
        return _accelerations(self.fix_partition(t, q, v), t, q, v)

    def rates(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return v and a at the state that the independent coordinates and velocities determine; v is NaN if q is far from it."""
        fixed = self.fix_partition(t, q, v)
        closed, v = _solve_dependent(fixed, t, q, v)
        # A solution farther from the predicted state might be another assembly mode; NaN makes the integrator shorten the step.
        is_near = self.equations.size(closed - q) <= CLOSURE.longest_step
        return jnp.where(is_near, v, jnp.nan), _accelerations(fixed, t, closed, v)

    def project(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v with the dependent coordinates and velocities solved from the constraints, and the others unchanged."""
        return _solve_dependent(self.fix_partition(t, q, v), t, q, v)

    def fix_partition(self, t: Time, q: Vector, v: Vector) -> "PartitionedSystem":
        """Return the same equations with the partition that pivoting chooses at this state."""
        if self.dependent is not None:
            return self
        of_positions = of_velocities = self._dependent_columns(self.equations.weighted_rows(t, q)[0])
        if self.equations.restricts_velocities:
            of_velocities = self._dependent_columns(self.equations.weighted_rates(t, q, v)[0])
        dependent = jax.lax.stop_gradient(jnp.stack([of_positions, of_velocities]))
        return PartitionedSystem(self.equations, self.formulation, dependent)

    def _dependent_columns(self, D: Float[Array, "m n"]) -> Bool[Array, "n"]:
        """Return a mask of the columns that pivoting chooses, as many as are independent."""
        none = jnp.zeros(D.shape[1], bool)
        if not len(D):
            return none
        _, _, order, rank = complete_qr(D, self._tol * jnp.linalg.norm(D, axis=0).max())
        return none.at[order].set(jnp.arange(len(order)) < rank)

    @property
    def independent(self) -> Bool[Array, "2n"] | None:
        return None if self.dependent is None else ~self.dependent.ravel()

    @property
    def dependent_coordinates(self) -> Bool[Array, "n"]:
        """A mask of the dependent coordinates of the fixed partition."""
        return self._fixed[0]

    @property
    def dependent_velocities(self) -> Bool[Array, "n"]:
        """A mask of the dependent velocities of the fixed partition."""
        return self._fixed[1]

    @property
    def _fixed(self) -> Bool[Array, "2 n"]:
        if self.dependent is None:
            raise ValueError("no partition is fixed: call fix_partition first")
        return self.dependent

    @property
    def _tol(self) -> Float[Array, ""]:
        tol = self.formulation.rank_tol
        return self.equations.rank_tol if tol is None else tol

    def plus(self, D: Float[Array, "m n"], columns: Bool[Array, "n"]) -> Plus:
        """Return the pseudoinverse of the matrix that has only the masked columns of D, and zeros in all others."""
        return SVD(self._tol).plus(jnp.where(columns, D, 0))


# Derivatives. For a fixed partition, Psi(t, q_d, q_i) = 0 defines q_d as a function of t and q_i. One Newton step from a closed
# state does not change the values and has the tangents of that function.


@eqx.filter_custom_jvp
def _solve_dependent(fixed: PartitionedSystem, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    if not fixed.constrained:
        return q, v
    q = _solve(fixed, lambda q: _newton(fixed, t, q), q)
    if fixed.equations.restricts_velocities:  # phi need not be linear in the velocities
        return q, _solve(fixed, lambda v: _velocity(fixed, t, q, v), v)
    return q, _velocity(fixed, t, q, v)


def _solve(fixed: PartitionedSystem, newton: Callable[[Vector], Vector], x: Vector) -> Vector:
    """Return the limit of Newton steps; NaN if they do not converge."""

    def step(x: Vector) -> tuple[Vector, Array, Array]:
        corrected = newton(x)
        return corrected, fixed.equations.size(corrected - x), jnp.ones((), x.dtype)

    most_steps, last_change = PARTITION_NEWTON.most_steps, PARTITION_NEWTON.last_change(x.dtype)
    x, is_open = repeated_newton(step, x, most_steps=most_steps, last_change=last_change)
    return jnp.where(is_open, jnp.nan, x)


@_solve_dependent.def_jvp
def _(primals, tangents):
    fixed, t, q, v = primals
    closed, rate = _solve_dependent(fixed, t, q, v)

    def correct(fixed, t, q, v):
        start = jnp.where(fixed.dependent_coordinates, jax.lax.stop_gradient(closed), q)
        q = _newton(fixed, t, start)
        return q, _velocity(fixed, t, q, jnp.where(fixed.dependent_velocities, jax.lax.stop_gradient(rate), v))

    return (closed, rate), eqx.filter_jvp(correct, (fixed, t, q, v), tangents)[1]


def _newton(fixed: PartitionedSystem, t: Time, q: Vector) -> Vector:
    D, psi, root = fixed.equations.weighted_rows(t, q)
    if not len(psi):
        return q
    columns = fixed.dependent_coordinates
    return jnp.where(columns, q - root * (fixed.plus(D, columns) @ psi), q)  # independent coordinates stay exact


def _velocity(fixed: PartitionedSystem, t: Time, q: Vector, v: Vector) -> Vector:
    D, rate, root = fixed.equations.weighted_rates(t, q, v)
    columns = fixed.dependent_velocities
    return jnp.where(columns, v - root * (fixed.plus(D, columns) @ rate), v)


@eqx.filter_custom_jvp
def _accelerations(fixed: PartitionedSystem, t: Time, q: Vector, v: Vector) -> Vector:
    M, F, A, c = fixed.matrices(t, q, v)
    if not len(A):
        return jnp.linalg.solve(M, F)
    root, w = 1 / jnp.sqrt(jnp.diag(M)), fixed.equations.row_weights
    A, c = (w * A.T).T, w * c
    columns = fixed.dependent_velocities
    plus = fixed.plus(A * root, columns)
    free = jnp.diag(jnp.where(columns, 0.0, 1.0))
    return null_space_accelerations(M, F, free - root[:, None] * (plus @ (A @ free)), root * (plus @ c))


@_accelerations.def_jvp
def _(primals, tangents):
    """Differentiate the Udwadia-Kalaba equation, which has the same accelerations at constant rank."""
    plain = lambda fixed, *state: fixed.equations.accelerations(*state)  # noqa: E731
    return _accelerations(*primals), eqx.filter_jvp(plain, primals, tangents)[1]
