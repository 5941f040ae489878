"""How long the first step is that an integrator tries."""

import jax.numpy as jnp
from jaxtyping import Array

from udkjax.integrate.gradients import stop_gradients


def first_step(y: Array, slope: Array, span: Array, rtol: Array, atol: Array, unit: Array) -> Array:
    """A step over which the state y (n,), with this slope, changes by a small part of itself. `unit` is that of `atol`.

    As in Hairer, Norsett, Wanner, II.4, without its second evaluation: the controller corrects what is off.
    """
    y, slope, span, rtol, atol, unit = stop_gradients((y, slope, span, rtol, atol, unit))
    scale = atol * unit + rtol * jnp.abs(y)
    size, rate = jnp.max(jnp.abs(y) / scale, initial=0.0), jnp.max(jnp.abs(slope) / scale, initial=0.0)
    ordinary = jnp.isfinite(rate) & (rate > 0) & (size > 0)
    return jnp.where(ordinary, jnp.minimum(0.01 * size / jnp.where(ordinary, rate, 1.0), span), 1e-4 * span)
