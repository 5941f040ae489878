"""The interface of equations of motion: the functions that an integrator calls."""

from abc import abstractmethod
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from udkjax.annotations import Time, Vector
from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.pinv import SVD


class HasStates(Protocol):
    """Times and states, such as those of a `Solution`."""

    @property
    def ts(self) -> Float[ArrayLike, "T"]:
        """Times (s)."""
        ...

    @property
    def q(self) -> Float[ArrayLike, "T bodies 3"]:
        """Coordinates (m, rad)."""
        ...

    @property
    def v(self) -> Float[ArrayLike, "T bodies 3"]:
        """Velocities (m/s, rad/s)."""
        ...


HistoryLike: TypeAlias = HasStates | SimpleNamespace  # anything with these attributes


def times_of(solution: HistoryLike) -> Any:
    """Return the times (s) at which loads on the states of a solution are evaluated.

    They are all zero for a `Kinematics` over the values of a driver, whose `ts` are these values.
    """
    return solution.ts if getattr(solution, "values_of", None) is None else np.zeros(np.shape(solution.ts))


class TangentPart(NamedTuple):
    """The parts of small changes of q and v within the constraint manifold."""

    dq: Vector
    dv: Vector


class AbstractSystem(eqx.Module):
    """The equations of motion of one system. Coordinates and velocities are flat vectors (n,)."""

    @property
    @abstractmethod
    def constrained(self) -> bool:
        """True if there are any constraints."""

    @property
    def textbook(self) -> Any:
        """The equations of the mechanism or user-defined system itself, for equations that wrap others, too."""
        return self

    @property
    def programs(self) -> RunPrograms | None:
        """The programs of the equations for machine code; None if there are none."""
        return None

    @property
    def programs_of_rows(self) -> RunPrograms | None:
        """The programs that find independent rows among all rows; None if there are none."""
        return None

    def size(self, dq: Vector) -> Float[Array, ""]:
        """Return the largest component of a change of coordinates, relative to the system's units, which are 1 by default."""
        return jnp.max(jnp.abs(dq), initial=0.0)

    def violation_size(self, psi: Float[Array, "m"]) -> Float[Array, ""]:
        """Return the largest violation of any row of Psi, relative to the system's units, which are 1 by default."""
        return jnp.max(jnp.abs(psi), initial=0.0)

    @abstractmethod
    def accelerations(self, t: Time, q: Vector, v: Vector) -> Vector:
        """Return the accelerations a (n,)."""

    @abstractmethod
    def multipliers(self, t: Time, q: Vector, v: Vector) -> Float[Array, "m"]:
        """Return the multipliers lambda of all rows, of minimum norm."""

    @abstractmethod
    def matrices(
        self, t: Time, q: Vector, v: Vector
    ) -> tuple[Float[Array, "n n"], Vector, Float[Array, "m n"], Float[Array, "m"]]:
        """Return M, F, A and c of M a + A^T lambda = F and A a = c, with Baumgarte's terms in c."""

    def mass(self, t: Time, q: Vector, v: Vector) -> Float[Array, "n n"]:
        """Return M."""
        return self.matrices(t, q, v)[0]

    def least_change(self, t: Time, q: Vector, v: Vector, residual: Float[Array, "k"], count: int) -> Vector:
        """Return the least change w in the metric of M with A w = residual, for the first `count` rows of A."""
        M, _, A, _ = self.matrices(t, q, v)
        rows, scales = A[:count], getattr(self.textbook, "scales", None)
        if not count:
            return jnp.zeros_like(q)
        weights = jnp.ones(count) if scales is None or len(scales.rows) < count else scales.weights[:count]
        L = jnp.linalg.cholesky(M)
        D = jax.scipy.linalg.solve_triangular(L, rows.T, lower=True).T * weights[:, None]
        plus = SVD(RANK_TOL if scales is None else scales.rank_tol).plus(D)
        return jax.scipy.linalg.solve_triangular(L, plus @ (weights * residual), lower=True, trans=1)

    @abstractmethod
    def project(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v projected onto the constraint manifold."""

    def tangent_part(self, t: Time, q: Vector, v: Vector, dq: Vector, dv: Vector) -> TangentPart:
        """Return the parts of small changes dq and dv that a projection at q preserves; by default the changes themselves."""
        return TangentPart(dq, dv)

    @abstractmethod
    def violation(self, t: Time, q: Vector, v: Vector) -> tuple[Float[Array, "m"], Float[Array, "k"]]:
        """Return Psi, and the residuals of velocities in all rows: Psi_dot, and phi if there is one."""

    @abstractmethod
    def is_finite(self, t: Time, q: Vector, v: Vector) -> Bool[Array, ""]:
        """Return whether all terms of the equations are finite."""

    # The members below are for formulations that integrate only some of the coordinates. By default all are integrated.

    solves_constraints: ClassVar[bool] = False  # True: dependent coordinates are solved for, so every state is projected

    def rates(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return the time derivatives of q and v that are integrated: by default v and the accelerations."""
        return v, self.accelerations(t, q, v)

    def fix_partition(self, t: Time, q: Vector, v: Vector) -> Self:
        """Return the same system with the partition of coordinates that is chosen at this state, for one step.

        By default there is no partition.
        """
        return self

    @property
    def independent(self) -> Bool[Array, "2n"] | None:
        """A mask of the coordinates and velocities that are integrated and under error control; None: all are."""
        return None


class ConstrainedRows(AbstractSystem):
    """A system whose rows of positions and of velocities are known, for formulations that solve them."""

    @property
    @abstractmethod
    def programs_of_marked_rows(self) -> RunPrograms:
        """The programs that find independent rows among those that numbers mark."""

    def residuals(self, t: Time, q: Vector, v: Vector) -> Float[Array, "m"]:
        """Return Psi of all rows, then phi if there is one."""
        return self.violation(t, q, v)[0]

    @abstractmethod
    def jacobian(self, t: Time, q: Vector, v: Vector) -> Float[Array, "m n"]:
        """Return the coefficients of accelerations in all rows: Psi_q, or (Psi_q; phi_v)."""

    @abstractmethod
    def energy(self, t: Time, q: Vector, v: Vector) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the kinetic and the potential energy (J)."""

    @property
    @abstractmethod
    def stabilized(self) -> bool:
        """True if Baumgarte's stabilization terms are included."""

    @property
    @abstractmethod
    def restricts_velocities(self) -> bool:
        """True if there are rows that restrict velocities alone: nonholonomic ones."""

    @property
    @abstractmethod
    def row_weights(self) -> Float[Array, "m"]:
        """The weights that make rows of different units comparable."""

    @property
    @abstractmethod
    def rank_tol(self) -> Float[Array, ""]:
        """The default threshold of dependence among rows."""

    @abstractmethod
    def weighted_rows(self, t: Time, q: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """Return D and Psi of all rows of positions, weighted, and the units of coordinates: M^(-1/2) if M is diagonal."""

    @abstractmethod
    def weighted_rates(self, t: Time, q: Vector, v: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """Return D and the residuals of all rows of velocities, weighted, and the units of coordinates, as in `weighted_rows`."""
