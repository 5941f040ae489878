"""What an integrator asks of equations of motion, whoever writes them."""

from abc import abstractmethod
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.equations.scales import Scales

Vector = Float[Array, "n"]


class TangentPart(NamedTuple):
    """The parts of small changes of q and v within the constraint manifold."""

    dq: Vector
    dv: Vector


class AbstractSystem(eqx.Module):
    """The equations of motion of one system, ready to be evaluated. Coordinates and velocities are flat vectors (n,)."""

    @property
    @abstractmethod
    def constrained(self) -> bool:
        """Whether there are any constraints."""

    def size(self, dq: Vector) -> Float[Array, ""]:
        """The largest of a change of coordinates, in units of the system's own. By default these are one."""
        return jnp.max(jnp.abs(dq), initial=0.0)

    def violation_size(self, psi: Float[Array, "m"]) -> Float[Array, ""]:
        """The largest violation of any row of Psi, in units of the system's own. By default these are one."""
        return jnp.max(jnp.abs(psi), initial=0.0)

    @abstractmethod
    def accelerations(self, t: Any, q: Vector, v: Vector) -> Vector:
        """a."""

    @abstractmethod
    def multipliers(self, t: Any, q: Vector, v: Vector) -> Float[Array, "m"]:
        """lambda of all rows, of minimum norm."""

    @abstractmethod
    def matrices(
        self, t: Any, q: Vector, v: Vector
    ) -> tuple[Float[Array, "n n"], Vector, Float[Array, "m n"], Float[Array, "m"]]:
        """M, F, A and c of M a + A^T lambda = F and A a = c, with Baumgarte's terms in c."""

    @abstractmethod
    def project(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """q and v returned to the constraint manifold."""

    def tangent_part(self, t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> TangentPart:
        """What projection at q leaves of small changes of positions and velocities. By default: all of them."""
        return TangentPart(dq, dv)

    @abstractmethod
    def violation(self, t: Any, q: Vector, v: Vector) -> tuple[Float[Array, "m"], Float[Array, "k"]]:
        """Psi and the residuals of the velocities, of all rows."""

    @abstractmethod
    def is_finite(self, t: Any, q: Vector, v: Vector) -> Bool[Array, ""]:
        """Whether all terms of the equations are finite."""

    # Where only some coordinates are integrated. By default it is all of them.

    def rates(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """What an integrator integrates: the rates of q and of v."""
        return v, self.accelerations(t, q, v)

    def fix_partition(self, t: Any, q: Vector, v: Vector) -> Self:
        """The same system with what is chosen at the start of a step fixed until its end."""
        return self

    @property
    def independent(self) -> Bool[Array, "n"] | None:
        """Which coordinates and velocities are integrated, and so under error control; None: all."""
        return None


class MechanismSystem(AbstractSystem):
    """The equations of motion of a mechanism, whose coordinates and velocities are x, y, angle of each body in turn."""

    scales: eqx.AbstractVar[Scales]

    def size(self, dq: Vector) -> Float[Array, ""]:
        """The largest of a change of coordinates: lengths over the characteristic length, angles in rad."""
        return self.scales.size(dq)

    def violation_size(self, psi: Float[Array, "m"]) -> Float[Array, ""]:
        """The largest violation of any row of Psi, each over the row's scale."""
        return self.scales.violation(psi)

    @property
    @abstractmethod
    def row_names(self) -> list[tuple[str, int]]:
        """The constraint that each row of Psi belongs to, and its number within it."""

    @property
    @abstractmethod
    def stabilized(self) -> bool:
        """Whether Baumgarte's terms are fed back."""

    @abstractmethod
    def energy(self, t: Any, q: Vector, v: Vector) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Kinetic and potential energy (J)."""

    @abstractmethod
    def jacobian(self, t: Any, q: Vector) -> Float[Array, "m n"]:
        """Psi_q of all rows."""

    @abstractmethod
    def weighted_rows(self, t: Any, q: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """D and Psi, their rows weighted by `Scales.weights`, and M^(-1/2), of all rows."""

    @abstractmethod
    def linearized_position(self, t: Any, q: Vector) -> tuple[Any, Float[Array, "m"], Vector]:
        """D^+ by the method and Psi, their rows weighted, and M^(-1/2)."""

    @abstractmethod
    def linearized_velocity(self, t: Any, q: Vector, v: Vector) -> tuple[Any, Float[Array, "m"], Vector]:
        """D^+ by the method and Psi_dot, their rows weighted, and M^(-1/2)."""
