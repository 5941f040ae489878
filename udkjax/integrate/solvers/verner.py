"""Verner's pair of orders 6 and 5, the method of the codes DVERK and DIVPRK."""

from collections.abc import Callable
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from udkjax.arrays import fractions

TABLEAU = diffrax.ButcherTableau(
    c=fractions("1/6 4/15 2/3 5/6 1 1/15 1"),
    a_lower=(
        fractions("1/6"),
        fractions("4/75 16/75"),
        fractions("5/6 -8/3 5/2"),
        fractions("-165/64 55/6 -425/64 85/96"),
        fractions("12/5 -8 4015/612 -11/36 88/255"),
        fractions("-8263/15000 124/75 -643/680 -81/250 2484/10625 0"),
        fractions("3501/1720 -300/43 297275/52632 -319/2322 24068/84065 0 3850/26703"),
    ),
    b_sol=fractions("3/40 0 875/2244 23/72 264/1955 0 125/11592 43/616"),
    b_error=fractions("3/40 0 875/2244 23/72 264/1955 0 125/11592 43/616") - fractions("13/160 0 2375/5984 5/16 12/85 3/44 0 0"),
)

# Column m: coefficients of s^(m + 1). Among the weights b(s) of the eight stages that meet the conditions of order 4 at every s,
# these have the smallest residuals in the conditions of order 5, then of order 6. b(1) is b_sol; b'(0) selects the first stage.
DENSE_WEIGHTS = np.array(
    [
        [1.0, -2.7926169818074067, 2.6533780544166103, -0.6910024927492995, -0.09940999448060499, 0.0046514146207005174],
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 4.432732124329612, -7.639913144880652, 3.6811731922639046, -0.08924553024751221, 0.005182057286876691],
        [0.0, -1.373307066340843, 4.471146865263445, -2.830062647293501, 0.056835531282788794, -0.00516823846744502],
        [0.0, -0.22158597720522963, 0.5466502838419368, -0.15620638635620157, -0.03838769832231888, 0.004568141213168795],
        [0.0, -1.360657849485367, 4.224684051120485, -2.6199728703177154, -0.29479603627049866, 0.05074270495309656],
        [0.0, -0.49644988327123873, 1.4654295529654255, -1.1133598943789607, 0.1631887385231116, -0.00802521501156059],
        [0.0, 1.811885633780473, -5.721375662727249, 3.7294310988317734, 0.3018149895150343, -0.05195086459483695],
    ]
)


class VernerInterpolation(diffrax.AbstractLocalInterpolation):
    """Dense output y(t0 + s h) = y0 + sum_i b_i(s) k_i of order 4, without further stages."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    y0: PyTree[Array]
    k: PyTree[Array]  # (stages, ...)

    def __init__(self, *, t0, t1, y0, y1, k):
        del y1  # equals y0 + sum_i b_i(1) k_i
        self.t0, self.t1, self.y0, self.k = t0, t1, y0, k

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        s = (t0 - self.t0) / jnp.where(self.t1 == self.t0, 1.0, self.t1 - self.t0)
        b = jnp.asarray(DENSE_WEIGHTS, s.dtype) @ s ** jnp.arange(1, DENSE_WEIGHTS.shape[1] + 1)
        return jax.tree.map(lambda y, k: y + jnp.tensordot(b, k, axes=1), self.y0, self.k)


class Verner65(diffrax.AbstractERK):
    """Verner's Runge-Kutta pair of orders 6 and 5 with 8 stages; the step continues from the result of order 6.

    The method of IMSL's DIVPRK. J. H. Verner, Explicit Runge-Kutta methods with estimates of the local truncation error,
    SIAM J. Numer. Anal. 15 (1978) 772-790; T. E. Hull, W. H. Enright, K. R. Jackson, User's guide for DVERK, Toronto (1976).
    Dense output is a polynomial of order 4, since the pair has none of its own.

    Args:
        scan_kind: diffrax's way to loop over the stages.
    """

    tableau: ClassVar[diffrax.ButcherTableau] = TABLEAU
    interpolation_cls: ClassVar[Callable[..., VernerInterpolation]] = VernerInterpolation

    def order(self, terms):
        return 6
