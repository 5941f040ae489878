"""What an integrator asks of equations of motion, whoever writes them."""

from abc import abstractmethod
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.equations.rank_policy import RankPolicy
from udkjax.equations.scales import Scales
from udkjax.straightline import Loop

Vector = Float[Array, "n"]

STEPS = 3  # of Newton's method in a projection, at most: the last of which usually finds nothing to do
# The distance from a singular configuration that counts as near: the root of a pivot relative to its row's diagonal entry, which
# is an angle of this size, or so. Rounding errors of accelerations grow with the third power of its reciprocal: to some 1e-10.
NEAR = 0.03
# Of the characteristic length, and rad: a Newton step that moves q by less leaves rounding errors, since it converges
# quadratically.
FAR = 1e-8


class Tangential(NamedTuple):
    """The parts of small changes of q and v within the constraint manifold."""

    dq: Vector
    dv: Vector
    distance: Any = jnp.inf  # from singular configurations, as `NEAR` measures it; infinite where the method does not know it


class Closed(NamedTuple):
    """A state that Newton's method has brought to the constraint manifold, or as close as its steps went."""

    q: Vector
    v: Vector
    moving: Any = False  # whether the last step still moved it by more than rounding, as far as the method knows


class Motion(eqx.Module):
    """The equations of motion of one system, ready to be evaluated. Coordinates and velocities are flat vectors (n,)."""

    @property
    @abstractmethod
    def left_out(self) -> tuple[int, ...]:
        """The rows that the method does not see."""

    @property
    @abstractmethod
    def constrained(self) -> bool:
        """Whether there are any constraints."""

    @property
    @abstractmethod
    def branches(self) -> bool:
        """Whether evaluating them takes a branch to a rank-revealing method."""

    def with_policy(self, policy: RankPolicy) -> "Motion":
        """The same with another decision where the rank is in question. By default there is none to make."""
        del policy
        return self

    @property
    def rank_revealing(self) -> "Motion":
        """The same by a rank-revealing method on all rows, for states that `refuse` says nothing of. By default, as they are."""
        return self

    @property
    def plain(self) -> "Motion":
        """The same in the form that is differentiated more than once. By default, as they are."""
        return self

    def within(self, loop: Loop) -> "Motion":
        """The same, to be evaluated in that loop, which XLA compiles into one function."""
        del loop
        return self

    def size(self, dq: Vector) -> Any:
        """The largest of a change of coordinates, in units of the system's own. By default these are one."""
        return jnp.max(jnp.abs(dq), initial=0.0)

    def excess(self, psi: Vector) -> Any:
        """The largest violation of any row of Psi, in units of the system's own. By default these are one."""
        return jnp.max(jnp.abs(psi), initial=0.0)

    @abstractmethod
    def accelerations(self, t: Any, q: Vector, v: Vector) -> Vector:
        """a."""

    @abstractmethod
    def multipliers(self, t: Any, q: Vector, v: Vector) -> Float[Array, "m"]:
        """lambda of all rows, of minimum norm."""

    @abstractmethod
    def matrices(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Vector, Array, Array]:
        """M (n, n), F (n,), A (m, n) and c (m,) of M a + A^T lambda = F and A a = c, with Baumgarte's terms in c."""

    @abstractmethod
    def project(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """q and v returned to the constraint manifold."""

    def arrived(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector, Vector]:
        """`project` at the end of a step: q and v, and the accelerations there."""
        q, v = self.project(t, q, v)
        return q, v, self.accelerations(t, q, v)

    @property
    def finishes(self) -> bool:
        """Whether there is a `finished` that takes less than `arrived` and `tangential`."""
        return False

    def finished(self, t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> tuple[Vector, Vector, Vector, Tangential]:
        """`arrived`, and `tangential` there, which has no derivative."""
        raise NotImplementedError

    def closed(self, t: Any, q: Vector, v: Vector, steps: int) -> Closed:
        """`project`, from farther away: by at most so many steps of Newton's method.

        By default it is projected until that moves nothing, at most so many times.
        """

        def again(state: Any) -> Any:
            k, q, v, _ = state
            q1, v1 = self.project(t, q, v)
            fastest = jnp.max(jnp.abs(v1), initial=0.0)
            return k + 1, q1, v1, (self.size(q1 - q) > FAR) | (jnp.max(jnp.abs(v1 - v), initial=0.0) > FAR * fastest)

        return Closed(*jax.lax.while_loop(lambda s: (s[0] < steps) & s[-1], again, (0, q, v, jnp.array(True)))[1:])

    def as_projected(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """A state on the manifold, with the derivatives of a projection that returns it. By default it is projected again."""
        return self.project(t, q, v)

    def tangential(self, t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> Tangential:
        """What projection at q leaves of small changes of positions and velocities. By default: all of them."""
        return Tangential(dq, dv)

    @abstractmethod
    def violation(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Psi and the residuals of the velocities, of all rows."""

    @abstractmethod
    def is_finite(self, t: Any, q: Vector, v: Vector) -> Bool[Array, ""]:
        """Whether everything that the equations are made of is a number."""

    # Where only some coordinates are integrated. By default it is all of them.

    def rates(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """What an integrator integrates: the rates of q and of v."""
        return v, self.accelerations(t, q, v)

    def held(self, t: Any, q: Vector, v: Vector) -> Self:
        """The same, with what is chosen at the start of a step held until its end."""
        return self

    @property
    def independent(self) -> Any:
        """Which coordinates and velocities are integrated, and so under error control: booleans (n,), or None: all."""
        return None


class MechanismMotion(Motion):
    """The equations of motion of a mechanism, whose coordinates and velocities are x, y, angle of each body in turn."""

    scales: eqx.AbstractVar[Scales]

    def size(self, dq: Vector) -> Any:
        """The largest of a change of coordinates: lengths over the characteristic length, angles in rad."""
        return self.scales.size(dq)

    def excess(self, psi: Vector) -> Any:
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
    def energy(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Kinetic and potential energy (J)."""

    @abstractmethod
    def jacobian(self, t: Any, q: Vector) -> Float[Array, "m n"]:
        """Psi_q of all rows."""

    @abstractmethod
    def weighted(self, t: Any, q: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """D and Psi, their rows weighted by `Scales.weights`, and M^(-1/2), of all rows."""

    @abstractmethod
    def linearized(self, name: str, t: Any, q: Any, v: Any) -> tuple[Any, Array, Vector]:
        """D^+ by the method, what it is to be applied to (`b`, `psi` or `psi_dot`), and M^(-1/2); rows are weighted."""
