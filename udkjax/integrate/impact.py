"""Impact: the jump of the velocities when a contact closes, with all constraints kept, however redundant.

A contact g(t, q) >= 0 has the rate g_dot = n v + g_t, n = g_q. Its impulse acts along n^T, those of the constraints along
Psi_q^T: M (v+ - v-) = n^T Lambda + Psi_q^T mu, Psi_q (v+ - v-) = 0, and Newton's law g_dot+ = -e g_dot-. With

    D = Psi_q M^(-1/2),        u = M^(-1/2) n^T,        u_t = (I - D^+ D) u,

where u_t is the part of the impulse that the constraints do not take, this is

    v+ = v- - (1 + e) g_dot- M^(-1/2) u_t / (u_t . u_t).

It is what D^+ of the constraints' rows with the row u^T appended gives, of [0; -(1 + e) g_dot-], where that row does not depend
on the others; where it does, no jump can reverse g_dot, and u_t is zero up to rounding. The kinetic energy of a scleronomic
mechanism changes by -(1 - e^2) / 2 g_dot-^2 / (u_t . u_t).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.textbook import TextbookEquations

# (u_t . u_t) / (u . u): the square of the sine between the contact's row and those of the constraints, in the metric of M.
BLOCKED = 1e-16


class Jump(NamedTuple):
    """The change of the velocities of an impact without restitution; times 1 + e it is that of any impact."""

    dv: Float[Array, "n"]
    free: Bool[Array, ""]  # whether the constraints leave the contact any motion


def jump(equations: TextbookEquations, t: Any, q: Float[Array, "n"], normal: Float[Array, "n"], rate: Any) -> Jump:
    """Bring g_dot, now `rate`, to zero by an impulse along `normal` = g_q, with all constraints kept."""
    mechanism, w = equations.mechanism, equations.weights
    root, D = uk.inverse_sqrt_mass(mechanism), uk.D(mechanism, t, q, w)
    u = root * normal
    u_t = u - uk.pseudoinverse(equations.method, D) @ (D @ u)
    square = u_t @ u_t
    free = square > BLOCKED * (u @ u)
    return Jump(jnp.where(free, -rate / jnp.where(free, square, 1.0) * root * u_t, 0.0), free)
