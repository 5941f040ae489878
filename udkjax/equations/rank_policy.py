"""What to do where the rank is in question: the one decision about rows that are, or are nearly, dependent on others."""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, ArrayLike, Float

from udkjax.scene.fields import optional

# Of a row's square: pivots below are rounding errors; Newton's method corrects those of pivots above.
NOTHING_LEFT = 1e-14
# Over the pivot: by how much rounding errors turn the velocities that a row allows (rad; up to a third of that in the paper's
# linkage). Rows of larger pivots than the second are of use to linkages that turn back there, however small the tolerance.
TURNED, USELESS = 1e-15, 1e-8


class RankPolicy(eqx.Module):
    """What elimination does with a row whose pivot, relative to its diagonal entry of D D^T, is below a threshold.

    `refuse`: the result is not a number, for whoever asked to find another way. `drop`: the row counts as dependent on those
    before it. `reveal`: a rank-revealing method takes all rows instead, behind a branch; it also does so where rows that were
    left out as redundant are not satisfied. The threshold is the method's own, or for `drop` the one given here.
    """

    action: Literal["refuse", "drop", "reveal"] = eqx.field(static=True)
    threshold: Float[Array, ""] | None = eqx.field(converter=optional, default=None)


REFUSE = RankPolicy("refuse")
REVEAL = RankPolicy("reveal")


def drop_dependent() -> RankPolicy:
    """Near the manifold: rows that depend on others, but for rounding, are left out of a correction."""
    return RankPolicy("drop", NOTHING_LEFT)


def drop_within(tol: ArrayLike) -> RankPolicy:
    """As `drop_dependent`, and so are rows by which rounding turns velocities by more than the tolerance `tol`."""
    turned: Any = TURNED / stop_gradient(jnp.asarray(tol))
    return RankPolicy("drop", jnp.clip(turned, NOTHING_LEFT, USELESS))
