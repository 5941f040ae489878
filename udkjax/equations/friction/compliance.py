"""Redundant forces shared by the compliances of joints.

With the compliances c of joints (m/N, rad/(N m)), the forces are those of least elastic energy,

    minimize sum(c_i lambda_i^2) / 2  over all lambda with M a + Psi_q^T lambda = F,

which holds for bodies that are stiff compared with their joints. With mu = lambda / w in units of the rows, P = I - D D^+ the
projector on the null space of D^T, and K = diag(w c w), the minimum over mu + P z is at z = -(P K P)^+ P K mu. Among joints
without compliance, loads that remain undetermined are those of least norm.
"""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.annotations import NumberLike
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.rows.determinacy import STATIC_RANK_TOL
from udkjax.pinv import SVD
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote, suggestion

# Threshold for eigenvalues of P K P, relative to the largest: joints with a smaller relative compliance count as rigid.
COMPLIANCE_TOL = 1e-10


def compliance_rows(mechanism: Mechanism, compliances: Mapping[str, NumberLike]) -> Float[Array, "m"]:
    """Return the compliance of each row of Psi, zero for joints without one.

    Raises:
        ValueError: A joint is unknown or has the wrong number of compliances, or one of these is negative.
    """
    constraints, counts = mechanism.constraints, {}
    for name, _ in analyse(mechanism).row_names:
        counts[name] = counts.get(name, 0) + 1
    for name, compliance in compliances.items():
        if name not in constraints:
            raise ValueError(f"compliances: no joint named {quote(name)}{suggestion(name, constraints)}")
        shape, single_number = np.shape(compliance), isinstance(constraints[name], Revolute) or counts[name] == 1
        if shape != (counts[name],) and not (shape == () and single_number):
            raise ValueError(f"compliances: {quote(name)} takes {counts[name]} numbers, one for each row, not {compliance!r}")
        if not isinstance(compliance, Tracer) and not np.all(np.asarray(compliance) >= 0):
            raise ValueError(f"compliances: {quote(name)} has a negative compliance: {compliance!r}")
    rows = [jnp.broadcast_to(jnp.asarray(compliances.get(name, 0.0), float), (count,)) for name, count in counts.items()]
    return jnp.concatenate(rows) if rows else jnp.zeros(0)


def sharing(
    D: Float[Array, "m n"], soft: Float[Array, "k"] | None, w: Float[Array, "m"]
) -> Callable[[Float[Array, "m"]], Float[Array, "m"]]:
    """Return a function that converts multipliers to those of least elastic energy that have the same effect on the bodies.

    Args:
        D: D with weighted rows; the rows after the first k are rigid.
        soft: Compliances of the first k rows; None: multipliers stay as they are.
        w: Weights of the rows.
    """
    if soft is None or not len(soft):
        return lambda multipliers: multipliers
    P = jnp.eye(len(D)) - D @ SVD(rank_tol=STATIC_RANK_TOL)(D)
    K = jnp.pad(soft, (0, len(D) - len(soft))) * w**2
    K = K / jnp.maximum(jnp.max(jax.lax.stop_gradient(K)), jnp.finfo(float).tiny)
    plus = SVD(rank_tol=COMPLIANCE_TOL)(P @ (K[:, None] * P))

    def share(multipliers: Float[Array, "m"]) -> Float[Array, "m"]:
        mu = multipliers / jnp.where(w > 0, w, 1.0)
        return w * (mu - P @ (plus @ (P @ (K * mu))))

    return share
