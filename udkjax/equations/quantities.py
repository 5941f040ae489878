"""Quantities of a motion: accelerations, multipliers, energies and violations of the constraints."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from udkjax.equations.abstract_system import AbstractSystem, MechanismSystem, StateHistory, Vector
from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.formulations import Formulation
from udkjax.equations.general import ConstrainedSystem, prepare_general
from udkjax.equations.textbook import prepare
from udkjax.equations.udwadia_kalaba import Baumgarte
from udkjax.pinv import SVD, Pseudoinverse
from udkjax.scene.mechanism import Mechanism

Result = TypeVar("Result")


class Energy(NamedTuple):
    """Energies (J) at each time. Potential: of gravity, zero at the origin, and of the force elements that have one."""

    kinetic: Float[Array, "T"]
    potential: Float[Array, "T"]

    @property
    def total(self) -> Float[Array, "T"]:
        return self.kinetic + self.potential


def equations_of(
    system: Mechanism | ConstrainedSystem,
    method: Pseudoinverse | None = None,
    baumgarte: Baumgarte | None = None,
    formulation: Formulation | None = None,
    analysis: Analysis | None = None,
) -> AbstractSystem:
    """Prepare the equations of motion of a mechanism or a system, by the Udwadia-Kalaba equation or another formulation."""
    if isinstance(system, ConstrainedSystem):
        equations: AbstractSystem = prepare_general(system, method, baumgarte)
    else:
        equations = prepare(system, method, baumgarte, analysis)
    return equations if formulation is None else formulation.formulate(equations)


def accelerations(
    mechanism: Mechanism | ConstrainedSystem,
    t: ArrayLike,
    q: Float[ArrayLike, "bodies 3"],
    v: Float[ArrayLike, "bodies 3"],
    method: Pseudoinverse | None = None,
    stabilization: Baumgarte | None = None,
    multipliers: bool = False,
    formulation: Formulation | None = None,
    analysis: Analysis | None = None,
) -> Float[Array, "bodies 3"] | tuple[Float[Array, "bodies 3"], Float[Array, "m"]]:
    """Return a (bodies, 3) at time t (s), coordinates q and velocities v; with `multipliers` also lambda, one a row of Psi.

    a = a_F + M^(-1/2) D^+ b and lambda = -(D^+)^T D^+ b, of minimum norm where constraints are redundant (m/s^2, rad/s^2; N, N m,
    in the rows' order and with the sign of M a + Psi_q^T lambda = F). The state need not be closed. `Auto` takes singular values.
    A `formulation` finds a in another way, but not lambda. `analysis` is that of `analyse`. For a `ConstrainedSystem` q, v and a
    are (n,).
    """
    if isinstance(mechanism, Mechanism):
        analysis, mechanism = analyse(mechanism) if analysis is None else analysis, mechanism.without_origin
    t, q, v = (jnp.asarray(x, jnp.result_type(float)) for x in (t, q, v))
    return _accelerations(mechanism, analysis, t, q, v, method, stabilization, formulation, multipliers)


def violation(mechanism: Mechanism | ConstrainedSystem, solution: StateHistory) -> Float[Array, "T m"]:
    """Return Psi (m, rad) at each output time, one column a row: joints in their order, then drivers.

    `solution` is anything with ts (T,), q and v (T, bodies, 3).
    """
    return _evaluate_along(mechanism, solution, _psi)


def energy(mechanism: Mechanism, solution: StateHistory) -> Energy:
    """Return kinetic energy v^T M v / 2 and potential energy (J) at each output time."""
    return _evaluate_along(mechanism, solution, _energy)


# Functions of their own: what is compiled for one call serves the next.


@eqx.filter_jit
def _accelerations(mechanism, analysis, t, q, v, method, baumgarte, formulation, multipliers):
    equations, flat = equations_of(mechanism, method, baumgarte, formulation, analysis), (q.ravel(), v.ravel())
    a = equations.accelerations(t, *flat).reshape(q.shape)
    return (a, equations.multipliers(t, *flat)) if multipliers else a


def _psi(equations: AbstractSystem, t: Array, q: Vector, v: Vector) -> Array:
    return equations.violation(t, q, v)[0]


def _energy(equations: MechanismSystem, t: Array, q: Vector, v: Vector) -> Energy:
    return Energy(*equations.energy(t, q, v))


def _evaluate_along(mechanism: Mechanism | ConstrainedSystem, solution: StateHistory, quantity: Callable[..., Result]) -> Result:
    analysis = None
    if isinstance(mechanism, Mechanism):
        analysis, mechanism = analyse(mechanism), mechanism.without_origin
    return _evaluate(mechanism, analysis, solution.ts, solution.q, solution.v, quantity)


@eqx.filter_jit
def _evaluate(mechanism, analysis, ts, q, v, quantity):
    equations = equations_of(mechanism, SVD(), analysis=analysis)
    ts, q, v = jnp.asarray(ts), jnp.asarray(q).reshape(len(ts), -1), jnp.asarray(v).reshape(len(ts), -1)
    return jax.vmap(lambda t, q, v: quantity(equations, t, q, v))(ts, q, v)
