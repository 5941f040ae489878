"""The Udwadia-Kalaba equation (de Falco, Pennestri, Vita 2005, section 3).

A mechanism's constraints Psi(t, q) = 0, masses M and loads F give, with

    D = Psi_q M^(-1/2),        a_F = M^(-1) F,        b = gamma - 2 alpha Psi_dot - beta^2 Psi - Psi_q a_F,

    a = a_F + M^(-1/2) D^+ b,        lambda = -(D^+)^T D^+ b,        M a + Psi_q^T lambda = F,

for any rank of D. Of all accelerations that satisfy the constraints, or violate them least, a is nearest to a_F in the metric of
M (Gauss's principle); lambda has the least norm. Each symbol is a function on arrays, differentiable to any order, and the tests
compare every faster form with it; `method` is any pseudoinverse.

Rows of Psi in metres and in radians have singular values of different units. Weights w (m,) of the rows make them comparable, so
that one rank tolerance suffices (`Scales.weights`: 1 for metres, a length for radians): D and b stand for diag(w) D and
diag(w) b, which has the same solutions if the rows are consistent, and lambda = -w (D^+)^T D^+ b, in N and N m. A row with weight
zero is left out.

Arguments and shapes are those of constraints.py: t (s), q and v of n coordinates, m rows. `baumgarte` contains the gains alpha
and beta; None: no stabilization. `w` are the weights (m,); None: all weights are one. `friction` are loads (n,) added to F, those
of friction that depends on lambda (rubbing.py); None: no such friction.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from udkjax.annotations import NumberLike
from udkjax.argument_types import checks_instances, require_thresholds
from udkjax.arrays import number_called
from udkjax.equations.terms import constraints, loads
from udkjax.equations.terms.constraints import BodyArray, vector
from udkjax.pinv import Plus, Pseudoinverse
from udkjax.printing import PrintsLine
from udkjax.scene.mechanism import Mechanism

Weights = Float[ArrayLike, "m"] | None
Loads = Float[Array, "n"] | None


class Baumgarte(PrintsLine):
    """Baumgarte stabilization: Psi_ddot + 2 alpha Psi_dot + beta^2 Psi = 0.

    Gains of 2 to 5 bound the drift caused by redundancy and rounding; gains of several hundred, as in the literature, make the
    problem stiff.

    Args:
        alpha: the gain on Psi_dot (1/s).
        beta: the gain on Psi (1/s).
    """

    alpha: Float[Array, ""]
    beta: Float[Array, ""]

    def __init__(self, alpha: NumberLike = 5.0, beta: NumberLike = 5.0):
        self.alpha, self.beta = number_called("alpha")(alpha), number_called("beta")(beta)


checks_instances(Baumgarte)(require_thresholds)


def D(mechanism: Mechanism, t: NumberLike, q: BodyArray, w: Weights = None) -> Float[Array, "m n"]:
    """Return D = Psi_q M^(-1/2), its rows multiplied by w."""
    return weigh(w, constraints.psi_q(mechanism, t, q) * inverse_sqrt_mass(mechanism))


def a_F(mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray, friction: Loads = None) -> Float[Array, "n"]:
    """Return a_F = M^(-1) F: the accelerations without constraints."""
    F = loads.force(mechanism, t, q, v)
    return (F if friction is None else F + friction) / loads.mass(mechanism)


def b(
    mechanism: Mechanism,
    t: NumberLike,
    q: BodyArray,
    v: BodyArray,
    baumgarte: Baumgarte | None = None,
    w: Weights = None,
    friction: Loads = None,
) -> Float[Array, "m"]:
    """Return b = gamma - 2 alpha Psi_dot - beta^2 Psi - Psi_q a_F: the part of the constraints that a_F does not satisfy."""
    return _terms(mechanism, t, q, v, baumgarte, w, friction).b


class _Terms(NamedTuple):
    """D, b and a_F of a state."""

    D: Float[Array, "m n"]
    b: Float[Array, "m"]
    a_F: Float[Array, "n"]


def _terms(
    mechanism: Mechanism,
    t: NumberLike,
    q: BodyArray,
    v: BodyArray,
    baumgarte: Baumgarte | None,
    w: Weights,
    friction: Loads = None,
) -> _Terms:
    """Return D, b and a_F at a state. Psi_q and F are computed once, since programs of derivatives would have copies of each."""
    slopes, free = constraints.psi_q(mechanism, t, q), a_F(mechanism, t, q, v, friction)
    missing = drift(mechanism, t, q, v, baumgarte) - slopes @ free
    return _Terms(weigh(w, slopes * inverse_sqrt_mass(mechanism)), weigh(w, missing), free)


def drift(
    mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray, baumgarte: Baumgarte | None = None
) -> Float[Array, "m"]:
    """Return gamma - 2 alpha Psi_dot - beta^2 Psi, the right-hand side of the equations Psi_q a = c of the accelerations."""
    found = constraints.gamma(mechanism, t, q, v)
    if baumgarte is not None:
        found = found - 2 * baumgarte.alpha * constraints.psi_dot(mechanism, t, q, v)
        found = found - baumgarte.beta**2 * constraints.psi(mechanism, t, q)
    return found


def accelerations(
    mechanism: Mechanism,
    t: NumberLike,
    q: BodyArray,
    v: BodyArray,
    method: Pseudoinverse,
    baumgarte: Baumgarte | None = None,
    w: Weights = None,
    friction: Loads = None,
) -> Float[Array, "n"]:
    """Return a = a_F + M^(-1/2) D^+ b."""
    terms = _terms(mechanism, t, q, v, baumgarte, w, friction)
    return terms.a_F + inverse_sqrt_mass(mechanism) * (pseudoinverse(method, terms.D) @ terms.b)


def multipliers(
    mechanism: Mechanism,
    t: NumberLike,
    q: BodyArray,
    v: BodyArray,
    method: Pseudoinverse,
    baumgarte: Baumgarte | None = None,
    w: Weights = None,
) -> Float[Array, "m"]:
    """Return lambda = -(D^+)^T D^+ b: without w, the multipliers of least norm with M a + Psi_q^T lambda = F."""
    terms = _terms(mechanism, t, q, v, baumgarte, w)
    D_plus = pseudoinverse(method, terms.D)
    return weigh(w, -(D_plus.T @ (D_plus @ terms.b)))


def project(
    mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray, method: Pseudoinverse, w: Weights = None, steps: int = 2
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Project a state onto the manifold Psi = 0, Psi_dot = 0 by the smallest change in the metric of M.

    Newton steps q - M^(-1/2) D^+ Psi are followed by a single step v - M^(-1/2) D^+ Psi_dot, because Psi_dot is linear in v.
    """

    def newton(_: Array, q: Array) -> Array:
        return q - inverse_sqrt_mass(mechanism) * (
            pseudoinverse(method, D(mechanism, t, q, w)) @ weigh(w, constraints.psi(mechanism, t, q))
        )

    q = vector(q)
    q = newton(q, q) if steps == 1 else jnp.asarray(jax.lax.fori_loop(0, steps, newton, q))
    rate = weigh(w, constraints.psi_dot(mechanism, t, q, v))
    return q, vector(v) - inverse_sqrt_mass(mechanism) * (pseudoinverse(method, D(mechanism, t, q, w)) @ rate)


def tangent_part(
    mechanism: Mechanism,
    t: NumberLike,
    q: BodyArray,
    change: Float[Array, "n"],
    method: Pseudoinverse,
    w: Weights = None,
    of_positions: bool = False,
) -> Float[Array, "n"]:
    """Return (I - M^(-1/2) D^+ D M^(1/2)) times a small change of q or v: its tangent part, which projection preserves.

    `of_positions`: the change is one of q, which rows of velocities alone do not restrict.
    """
    matrix = D(mechanism, t, q, w)
    rates = matrix @ (change / inverse_sqrt_mass(mechanism))
    if of_positions and (free := constraints.rolling_rows(mechanism)).any():
        rates = jnp.where(free, 0.0, rates)
    return change - inverse_sqrt_mass(mechanism) * (pseudoinverse(method, matrix) @ rates)


def inverse_sqrt_mass(mechanism: Mechanism) -> Float[Array, "n"]:
    """Return the diagonal of M^(-1/2)."""
    return 1 / jnp.sqrt(loads.mass(mechanism))


def weigh(w: Weights, rows: Array) -> Array:
    """Return diag(w) times `rows`, a matrix or a vector; unchanged if w is None."""
    return rows if w is None else (rows.T * jnp.asarray(w)).T


def pseudoinverse(method: Pseudoinverse, D: Float[Array, "m n"]) -> "Plus | ZeroPseudoinverse":
    """Return D^+ as an operator, `D_plus @ b` and `D_plus.T @ x`; zero if D has no rows."""
    return method.plus(D) if len(D) else ZeroPseudoinverse(D.shape)


class ZeroPseudoinverse(eqx.Module):
    """D^+ of a matrix D without rows, or the transpose, as an operator that returns zeros."""

    shape: tuple[int, ...] = eqx.field(static=True)

    @property
    def T(self) -> "ZeroPseudoinverse":
        return ZeroPseudoinverse(self.shape[::-1])

    @property
    def rank(self) -> Int[Array, ""]:
        return jnp.zeros((), int)

    def __matmul__(self, b: Array) -> Array:
        return jnp.zeros(self.shape[1])
