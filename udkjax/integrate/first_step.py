"""How long the first step is that an integrator tries."""

import jax.numpy as jnp
from jaxtyping import Array

from udkjax.integrate.norms import largest
from udkjax.integrate.undifferentiated import undifferentiated


def first_step(y: Array, slope: Array, span: Array, rtol: Array, atol: Array, unit: Array) -> Array:
    """A step over which the state y (n, *lanes), with this slope, changes by a small part of itself. `unit` is that of `atol`.

    As in Hairer, Norsett, Wanner, II.4, without its second evaluation: the controller corrects what is off.
    """
    y, slope, span, rtol, atol, unit = undifferentiated((y, slope, span, rtol, atol, unit))
    scale = atol * unit + rtol * jnp.abs(y)
    size, rate = largest(jnp.abs(y) / scale), largest(jnp.abs(slope) / scale)
    ordinary = jnp.isfinite(rate) & (rate > 0) & (size > 0)
    return jnp.where(ordinary, jnp.minimum(0.01 * size / jnp.where(ordinary, rate, 1.0), span), 1e-4 * span)
