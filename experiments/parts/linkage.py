"""The paper's linkage from any start, and its exact motion."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import udkjax as udk
from udkjax.study.accuracy import exact_coordinates

OUTPUTS = 481  # of every run: 24 a second where it lasts 20 s; always as many, so that one compiled program serves all runs


def start(degrees: float, rate: float = 0.0) -> udk.State:
    """Return the closed state with the links at an angle (degrees), turning at a rate (rad/s)."""
    return _placed(jnp.deg2rad(degrees), jnp.asarray(rate, float))


@jax.jit
def _placed(angle, rate):
    placed = udk.library.parallelogram(angle, rate)
    return udk.State(placed.q0, placed.v0)


@cache
def parallelogram() -> udk.Mechanism:
    """Return the paper's linkage, built once: what is redundant in it takes longer to find than a run."""
    return udk.library.parallelogram()


def exact(ts: Float[np.ndarray, "T"], state: udk.State) -> Float[np.ndarray, "T bodies 3"]:
    """Return the exact coordinates (m, rad) from a start on."""
    q = exact_coordinates(parallelogram(), ts, state.q, state.v)
    assert q is not None
    return q
