"""Positions to start searches from, and which of those that are found differ."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.equations.analysis import analyse
from udkjax.equations.scales import Scales
from udkjax.integrate.assembly import State
from udkjax.scene.mechanism import Mechanism

SAME_POSITION = 1e-5  # of the characteristic length, or rad: positions nearer to each other are one


def random_positions(mechanism: Mechanism, count: int, seed: int, state: State | None = None) -> Float[Array, "count bodies 3"]:
    """Return the given position, and others with random angles and places of all bodies, spread over the mechanism's size."""
    rng = np.random.default_rng(seed)
    q = np.asarray(mechanism.q0 if state is None else state.q)
    found = np.tile(q, (count, 1, 1))
    spread = max(float(np.ptp(q[:, :2], axis=0).max()), float(analyse(mechanism).length))
    found[1:, :, 2] += rng.uniform(-np.pi, np.pi, (count - 1, len(q)))
    found[1:, :, :2] += rng.uniform(-0.5, 0.5, (count - 1, len(q), 2)) * spread
    return jnp.asarray(found)


def distinct_positions(q: Float[Array, "count bodies 3"], counts: Bool[Array, "count"], scales: Scales) -> list[int]:
    """Return which of the positions that count differ from all before them; whole turns make no difference."""
    points = np.asarray(q, float)
    length, different = float(scales.length), []
    for k in np.flatnonzero(np.asarray(counts)):
        d = points[k] - points[different]
        d[..., 2] = 2 * np.abs(np.sin(d[..., 2] / 2))
        d[..., :2] /= length
        if not different or np.min(np.max(np.abs(d), axis=(1, 2))) > SAME_POSITION:
            different.append(int(k))
    return different
