"""User-defined constrained systems by the same equation, with any coordinates and masses and with nonholonomic constraints."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int
from typing_extensions import TypeAliasType

from udkjax.annotations import NumberLike, Numbers, NumericArray, Time, Vector
from udkjax.arrays import is_traced, number, number_called
from udkjax.equations.laws.abstract_system import ConstrainedRows, TangentPart
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.programs.scales import Scales, UnitScales
from udkjax.equations.systems.function_causes import cause_at
from udkjax.equations.systems.system_numbers import number_fields, with_numbers
from udkjax.equations.systems.system_programs import system_programs
from udkjax.equations.systems.traced_system import TracedSystem, joined_rows, load, trace_system
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.pinv import Auto, Elimination, Plus, Pseudoinverse
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.printing import PrintsLine
from udkjax.requirements import ArgumentError, require_function
from udkjax.scene.model import Model
from udkjax.scene.numbers.number_fields import NumberField

# The functions of a `ConstrainedSystem`, with their arguments.
FUNCTION_ARGUMENTS = {
    "mass": "(q)",
    "force": "(t, q, v)",
    "constraint": "(t, q)",
    "velocity_constraint": "(t, q, v)",
    "potential": "(t, q)",
}
ConstraintRows = TypeAliasType("ConstraintRows", Float[ArrayLike, "m"] | Mapping[str, ArrayLike])  # also by name


class ConstrainedSystem(PrintsLine, Model):
    """M(q) a = F(t, q, v) + constraint forces, subject to Psi(t, q) = 0 and phi(t, q, v) = 0.

    `mass(q)` returns M (n, n), symmetric positive definite; `force(t, q, v)` returns F (n,); `constraint(t, q)` returns Psi (m,),
    or is None; `velocity_constraint(t, q, v)` returns phi (k,), nonholonomic or not, or is None. All of them are differentiated:
    write them in jax.numpy. Numbers that they close over, or that are fields of the equinox module whose methods they are, may be
    traced and differentiated. Simulate it from a `State` with q and v (n,); these and the rows should be of order one.

    Args:
        mass: q -> M (n, n).
        force: (t, q, v) -> F (n,), or None.
        constraint: (t, q) -> Psi (m,), or None. Rows may be given by name, as a dict, for `diagnose`.
        velocity_constraint: (t, q, v) -> phi (k,), or None; rows by name as well.
        breakpoints: times (s) where force or constraints are not smooth.
        potential: (t, q) -> V (); -V_q is added to F, and `energy` returns V.
        q0: coordinates (n,) from which `assemble` starts, or None: states are then given.
        v0: velocities (n,) with them; by default zero.
    """

    mass: Callable[[Vector], Float[ArrayLike, "n n"]]
    force: Callable[[Time, Vector, Vector], Float[ArrayLike, "n"]] | None = None
    constraint: Callable[[Time, Vector], ConstraintRows] | None = None
    velocity_constraint: Callable[[Time, Vector, Vector], ConstraintRows] | None = None
    breakpoints: Float[Array, "k"] | None = eqx.field(converter=number_called("breakpoints", optional=True), default=None)

    potential: Callable[[Time, Vector], Float[ArrayLike, ""]] | None = None
    q0: Vector | None = eqx.field(converter=number_called("q0", optional=True), default=None)
    v0: Vector | None = eqx.field(converter=number_called("v0", optional=True), default=None)

    def __post_init__(self):
        for name, arguments in FUNCTION_ARGUMENTS.items():
            if (function := getattr(self, name)) is not None:
                require_function(name, function, arguments)
        if self.q0 is not None and self.v0 is None:
            self.v0 = number(np.zeros(np.shape(self.q0)))
        if self.q0 is not None and np.shape(self.v0) != np.shape(self.q0):
            raise ArgumentError(f"v0 must have the shape of q0, {np.shape(self.q0)}; it has the shape {np.shape(self.v0)}")

    @classmethod
    def of_energy(
        cls,
        kinetic: Callable[[Vector, Vector], Float[ArrayLike, ""]],
        force: Callable[[Time, Vector, Vector], Float[ArrayLike, "n"]] | None = None,
        **others: Any,
    ) -> "ConstrainedSystem":
        """Return the system of a kinetic energy T = v^T M(q) v / 2, by Lagrange's equations: M = T_vv, F = T_q - (T_v)_q v.

        Args:
            kinetic: (q, v) -> T (), quadratic in v, in jax.numpy.
            force: (t, q, v) -> generalized forces (n,), or None.
            others: The other functions of a `ConstrainedSystem`, such as `potential` and `constraint`.
        """
        return cls(MassOfEnergy(kinetic), ForceOfEnergy(kinetic, force), **others)

    cure: ClassVar[str] = ", which has no bodies and joints"
    has_programs: ClassVar[bool] = False  # but those of `traced`

    def parameters(self) -> dict[str, Array]:
        """Return the numbers of the system by name: arrays that are fields of the modules whose methods its functions are.

        A field has its own name, `length`, and the field of a field a name with a dot, `rod.length`. Where functions of different
        modules have fields of the same name, it begins with the function: `force.length`. `q0` and `v0` are the initial guess.
        Arrays that plain functions close over have no names.
        """
        return super().parameters()

    def with_parameters(self, values: Mapping[str, Numbers]) -> "ConstrainedSystem":
        """Return the system with new values of some numbers, or of their entries (`q0[2]`). The values may be traced.

        Raises `SceneError` if a name is unknown, or a value has another shape.
        """
        return with_numbers(self, values)

    def number_fields(self) -> dict[str, NumberField]:
        return number_fields(self)

    @property
    def is_concrete(self) -> bool:
        """True if no number is traced, neither a field nor a number that a function closes over."""
        if is_traced(self):
            return False
        traced = self if self.q0 is None else self.traced(np.size(self.q0))
        return traced is self or bool(getattr(traced, "is_concrete", True))

    def state_shape(self, state: Any = None) -> tuple[int, ...]:
        q = self.q0 if state is None else getattr(getattr(state, "state", state), "q", None)
        return () if q is None else np.shape(q)

    def with_guess(self, q: NumericArray, v: NumericArray) -> "ConstrainedSystem":
        return self.with_parameters({"q0": q, "v0": v})

    def cause_at(self, t: NumberLike, q: NumericArray, v: NumericArray) -> str:
        """Return why the system can neither be closed nor integrated at a state: what its functions show, or ""."""
        return cause_at(self.traced(np.size(q)), t, q, v)

    def traced(self, n: int) -> Any:
        """Return the `TracedSystem` from which programs are made, for n coordinates; without float64 the system itself.

        All numbers of a `TracedSystem` are leaves, also those that functions hold in their closures.
        """
        return trace_system(self, n) if jax.config.jax_enable_x64 else self


class MassOfEnergy(eqx.Module):
    """The mass matrix of a kinetic energy, T_vv."""

    kinetic: Callable[[Vector, Vector], Any]

    def __call__(self, q: Vector) -> Float[Array, "n n"]:
        return jax.hessian(self.kinetic, 1)(q, jnp.zeros_like(q))


class ForceOfEnergy(eqx.Module):
    """Forces of Lagrange's equations other than M a: T_q - (T_v)_q v, plus the applied forces."""

    kinetic: Callable[[Vector, Vector], Any]
    force: Callable[[Time, Vector, Vector], Any] | None

    def __call__(self, t: Time, q: Vector, v: Vector) -> Vector:
        slope, change = jax.grad(self.kinetic)(q, v), jax.jvp(lambda q: jax.grad(self.kinetic, 1)(q, v), (q,), (v,))[1]
        total = slope - change
        return total if self.force is None else total + jnp.asarray(self.force(t, q, v))


class GeneralEquations(ConstrainedRows):
    """The equations of a `ConstrainedSystem` by one method, with the interface of a mechanism's equations.

    The rows of Psi come first, then those of phi. With M = L L^T and D = A L^(-T) for the rows A = (Psi_q; phi_v):
    a = a_F + L^(-T) D^+ b, which is a_F + M^(-1/2) D^+ b in other coordinates of the same metric.
    """

    mechanism: Any  # the system
    method: Pseudoinverse
    baumgarte: Baumgarte | None
    redundant: tuple[int, ...] | None = eqx.field(static=True, default=None)  # rows are known when a run begins

    @property
    def programs(self) -> RunPrograms | None:
        """The programs of a traced system: `Elimination` drops dependent rows, all other methods need marks of rows as input."""
        if not self.mechanism.has_programs:
            return None
        marks_rows, policy = not isinstance(self.method, Elimination), RankPolicy.of(self.method)
        return system_programs(self.mechanism, marks_rows, self.baumgarte is not None, policy)

    @property
    def programs_of_rows(self) -> RunPrograms | None:
        return system_programs(self.mechanism, False).with_all_rows if self.mechanism.has_programs else None

    @property
    def programs_of_marked_rows(self) -> RunPrograms:
        return system_programs(self.mechanism, True, policy=RankPolicy.FALL_BACK)

    @property
    def scales(self) -> Scales:
        """The scales of a system: all units are one, since its coordinates are of order one."""
        one: Any = np.ones(())  # NumPy's numbers, since each run asks for them
        rows: Any = np.ones(sum(self.mechanism.functions.row_counts) if self.mechanism.has_programs else 0)
        tol: Any = np.asarray(RANK_TOL)
        return UnitScales(length=one, arm=one, rate=one, mass=one, rows=rows, rank_tol=tol)

    def accelerations(self, t: Time, q: Vector, v: Vector) -> Vector:
        free, weight, plus, b = self._equation(t, q, v)
        return free if plus is None else free + weight(plus @ b)

    def multipliers(self, t: Time, q: Vector, v: Vector) -> Float[Array, "m"]:
        _, _, plus, b = self._equation(t, q, v)
        return jnp.zeros(0) if plus is None else -(plus.T @ (plus @ b))

    def project(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v after two Newton steps in position and two in velocity, because phi may be nonlinear."""
        for _ in range(2):
            q = self.correct_position(t, q)
        for _ in range(2):
            v = self.correct_velocity(t, q, v)
        return q, v

    def correct(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v after a Newton step in position and a Newton step in velocity.

        For a state on the manifold the result has the derivatives of a projection.
        """
        q = self.correct_position(t, q)
        return q, self.correct_velocity(t, q, v)

    def correct_position(self, t: Time, q: Vector) -> Vector:
        """Return q after a Newton step to Psi = 0."""
        if self.mechanism.constraint is None:
            return q
        plus, weight = self._plus(q, jax.jacfwd(self._psi, 1)(t, q))
        return q - weight(plus @ self._psi(t, q))

    def correct_velocity(self, t: Time, q: Vector, v: Vector) -> Vector:
        """Return v after a Newton step to Psi_dot = 0 and phi = 0."""
        if not self.constrained:
            return v
        plus, weight = self._plus(q, self._slopes(t, q, v))
        return v - weight(plus @ jnp.concatenate([self._psi_dot(t, q, v), self._phi(t, q, v)]))

    def tangent_part(self, t: Time, q: Vector, v: Vector, dq: Vector, dv: Vector) -> TangentPart:
        """Return (I - L^(-T) D^+ A) dq and (I - L^(-T) D^+ A) dv, with A = Psi_q for dq and A = (Psi_q; phi_v) for dv.

        If there is a phi, the change of Psi_dot and phi by the tangent part of dq is added to A dv.
        """
        if self.mechanism.constraint is not None:
            slopes = jax.jacfwd(self._psi, 1)(t, q)
            plus, weight = self._plus(q, slopes)
            dq = dq - weight(plus @ (slopes @ dq))
        if self.constrained:
            slopes = self._slopes(t, q, v)
            plus, weight = self._plus(q, slopes)
            rates = slopes @ dv
            if self.restricts_velocities:
                rates += jax.jvp(lambda q: jnp.concatenate([self._psi_dot(t, q, v), self._phi(t, q, v)]), (q,), (dq,))[1]
            dv = dv - weight(plus @ rates)
        return TangentPart(dq, dv)

    def unit_impulse_response(self, t: Time, q: Vector, v: Vector, normal: Vector) -> tuple[Vector, Vector]:
        """Return the changes of velocities by a unit impulse along n = `normal`: M^(-1) n, and its tangent part.

        The first is that of the unconstrained system, the second obeys the constraints.
        """
        factor = jax.scipy.linalg.cho_factor(jnp.asarray(self.mechanism.mass(q)), lower=True)
        change = jax.scipy.linalg.cho_solve(factor, normal)
        return change, self.tangent_part(t, q, v, jnp.zeros_like(q), change).dv

    def energy(self, t: Time, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Return the kinetic energy v^T M v / 2 and the potential energy V, zero without a potential."""
        potential = self.mechanism.potential
        kinetic = v @ jnp.asarray(self.mechanism.mass(q)) @ v / 2
        return kinetic, jnp.zeros_like(kinetic) if potential is None else jnp.asarray(potential(t, q))

    def residuals(self, t: Time, q: Vector, v: Vector) -> Float[Array, "m"]:
        return jnp.concatenate([self._psi(t, q), self._phi(t, q, v)])

    def jacobian(self, t: Time, q: Vector, v: Vector) -> Float[Array, "m n"]:
        """Return A = (Psi_q; phi_v)."""
        return self._slopes(t, q, v)

    def rank(self, t: Time, q: Vector, v: Vector) -> Int[Array, ""]:
        """Return the rank of A M^(-1/2), by the method."""
        rows = self._slopes(t, q, v)
        return self._plus(q, rows)[0].rank if len(rows) else jnp.zeros((), int)

    def loads(self, t: Time, q: Vector, v: Vector) -> Float[Array, "2 n"]:
        """Return the loads of the constraints, -Psi_q^T lambda and -phi_v^T lambda."""
        rows, multipliers, m = self._slopes(t, q, v), self.multipliers(t, q, v), len(self._psi(t, q))
        return -jnp.stack([rows[:m].T @ multipliers[:m], rows[m:].T @ multipliers[m:]])

    def is_finite(self, t: Time, q: Vector, v: Vector) -> Bool[Array, ""]:
        return jnp.all(jnp.isfinite(self.accelerations(t, q, v)))

    def violation(self, t: Time, q: Vector, v: Vector) -> tuple[Array, Array]:
        return self._psi(t, q), jnp.concatenate([self._psi_dot(t, q, v), self._phi(t, q, v)])

    @property
    def constrained(self) -> bool:
        return self.mechanism.constraint is not None or self.mechanism.velocity_constraint is not None

    @property
    def stabilized(self) -> bool:
        return self.baumgarte is not None

    @property
    def restricts_velocities(self) -> bool:
        return self.mechanism.velocity_constraint is not None

    @property
    def row_weights(self) -> Float[Array, "m"]:
        return jnp.ones(())  # rows are of order one

    @property
    def rank_tol(self) -> Float[Array, ""]:
        return self.scales.rank_tol

    def weighted_rows(self, t: Time, q: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """Return Psi_q and Psi with coordinates in units of M_ii^(-1/2), and these units."""
        root = self._units(q)
        return jax.jacfwd(self._psi, 1)(t, q) * root, self._psi(t, q), root

    def weighted_rates(self, t: Time, q: Vector, v: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """Return A = (Psi_q; phi_v), and Psi_dot followed by phi, with coordinates in units of M_ii^(-1/2), and these units."""
        root = self._units(q)
        return self._slopes(t, q, v) * root, self.violation(t, q, v)[1], root

    def _units(self, q: Vector) -> Vector:
        return 1 / jnp.sqrt(jnp.diag(jnp.asarray(self.mechanism.mass(q))))

    def matrices(self, t: Time, q: Vector, v: Vector) -> tuple[Array, Vector, Array, Array]:
        return jnp.asarray(self.mechanism.mass(q)), load(self.mechanism, t, q, v), *self._rows(t, q, v)

    def _rows(self, t: Time, q: Vector, v: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"]]:
        """Return the rows A = (Psi_q; phi_v) and the right-hand side c of A a = c, the constraints of the accelerations a."""
        rate = lambda t, q: self._psi_dot(t, q, v)  # noqa: E731
        gamma = -jax.jvp(rate, (t, q), (jnp.ones_like(t), v))[1]
        bend = jax.jvp(lambda t, q: self._phi(t, q, v), (t, q), (jnp.ones_like(t), v))[1]
        c = jnp.concatenate([gamma, -bend])
        if self.baumgarte is not None:
            alpha, beta = self.baumgarte.alpha, self.baumgarte.beta
            psi = self._psi(t, q)
            c = c - 2 * alpha * jnp.concatenate([self._psi_dot(t, q, v), self._phi(t, q, v)])
            c = c.at[: len(psi)].add(-(beta**2) * psi)
        return self._slopes(t, q, v), c

    def _equation(
        self, t: Time, q: Vector, v: Vector
    ) -> tuple[Vector, Callable[[Vector], Vector], Plus | None, Float[Array, "m"]]:
        free = self._free(t, q, v)
        if not self.constrained:
            return free, lambda x: x, None, jnp.zeros(0)
        slopes, c = self._rows(t, q, v)
        plus, weight = self._plus(q, slopes)
        return free, weight, plus, c - slopes @ free

    def _plus(self, q: Vector, slopes: Float[Array, "m n"]) -> tuple[Plus, Callable[[Vector], Vector]]:
        """Return D^+ of D = A L^(-T), and the function x -> L^(-T) x, for the mass matrix L L^T."""
        L = jnp.linalg.cholesky(jnp.asarray(self.mechanism.mass(q)))
        D = jax.scipy.linalg.solve_triangular(L, slopes.T, lower=True).T
        return self.method.plus(D), lambda x: jax.scipy.linalg.solve_triangular(L, x, lower=True, trans=1)

    def _free(self, t: Time, q: Vector, v: Vector) -> Vector:
        factor = jax.scipy.linalg.cho_factor(jnp.asarray(self.mechanism.mass(q)), lower=True)
        return jax.scipy.linalg.cho_solve(factor, load(self.mechanism, t, q, v))

    def _slopes(self, t: Time, q: Vector, v: Vector) -> Float[Array, "m n"]:
        return jnp.concatenate([jax.jacfwd(self._psi, 1)(t, q), jax.jacfwd(self._phi, 2)(t, q, v)])

    def _psi(self, t: Time, q: Vector) -> Array:
        constraint = self.mechanism.constraint
        return jnp.zeros(0) if constraint is None else jnp.atleast_1d(jnp.asarray(joined_rows(constraint(t, q))))

    def _phi(self, t: Time, q: Vector, v: Vector) -> Array:
        constraint = self.mechanism.velocity_constraint
        return jnp.zeros(0) if constraint is None else jnp.atleast_1d(jnp.asarray(joined_rows(constraint(t, q, v))))

    def _psi_dot(self, t: Time, q: Vector, v: Vector) -> Array:
        return jax.jvp(self._psi, (t, q), (jnp.ones_like(t), v))[1]


def prepare_general(system: Any, method: Pseudoinverse | None, baumgarte: Baumgarte | None) -> GeneralEquations:
    """Prepare the equations of motion of a user-defined system by a pseudoinverse.

    The default method is `Auto`, which is `SVD` for dense rows. The `rank_tol` of a method without one is `RANK_TOL`.
    """
    system = replace(system, breakpoints=None) if isinstance(system, TracedSystem) else system  # the run has them
    method = Auto() if method is None else method
    tol = number(RANK_TOL) if method.rank_tol is None else method.rank_tol
    return GeneralEquations(system, eqx.tree_at(lambda m: m.rank_tol, method, tol, is_leaf=lambda x: x is None), baumgarte)
