"""Assembly branches: all ways to assemble a mechanism for one value of its driver."""

from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.annotations import NumberLike
from udkjax.argument_types import COUNT, NOT_NEGATIVE_COUNT, NUMBERS_BY_NAME
from udkjax.arrays import number
from udkjax.equations.programs.scales import Scales
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.positions.assembling.assembly import State, close
from udkjax.positions.following.drive import Drive, drive
from udkjax.programs.deferred import deferred
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism


@checked
@concrete_only()
def branches(
    mechanism: Mechanism,
    driver: Drive,
    value: NumberLike,
    starts: Annotated[int, COUNT] = 400,
    seed: Annotated[int, NOT_NEGATIVE_COUNT] = 0,
    held: Annotated[Mapping[str, NumberLike], NUMBERS_BY_NAME] | None = None,
) -> Float[Array, "k bodies 3"]:
    """Return the positions that close a mechanism, Psi(s, q) = 0, for one value s of its driver: its assembly branches.

    Random positions are closed, and duplicates removed: each position returned is a branch, but a branch may be missing.
    Four-bars have at most 2 branches, Watt's six-bars 4, Stephenson's 6. The same seed leads to the same result. Angles are
    within half a turn of zero, and branches are sorted by the angles of the bodies, in the order of the bodies.

    Args:
        mechanism: a mechanism of concrete numbers, without a degree of freedom once its driver is held.
        driver: a driver, or a coordinate by name or as a `Coordinate`, as for `kinematics`; None: all drivers.
        value: value of the driver (rad, m); with None the time (s).
        starts: number of positions to search from.
        seed: seed of these positions.
        held: values that other drivers or coordinates hold, by name.

    Returns:
        The k positions found (k, bodies, 3): x, y in m and angle in rad.

    Raises:
        SceneError: no such driver or coordinate, or positions do not follow from it.
    """
    driven = drive(mechanism, driver, 0.0, held)
    guesses = random_positions(mechanism, starts, seed)
    q, closed = _close(driven.mechanism, driven.analysis, number(value), guesses)
    positions = np.asarray(q)[distinct_positions(q, closed, driven.analysis.scales)]
    positions[..., 2] = np.angle(np.exp(1j * positions[..., 2]))
    order = np.lexsort(np.round(positions[..., 2], 6).T[::-1])
    return jnp.asarray(positions[order])


@deferred
def _close(
    mechanism: Mechanism, analysis: Analysis, s: Float[Array, ""], guesses: Float[Array, "count bodies 3"]
) -> tuple[Array, Array]:
    def close_one(q: Float[Array, "bodies 3"]) -> tuple[Array, Array]:
        found = close(mechanism, s, State(q, jnp.zeros_like(q)), analysis=analysis)
        return found.state.q, jnp.asarray(found.is_closed)

    return jax.vmap(close_one)(guesses)


SAME_POSITION_TOL = 1e-5  # tolerance, relative to the characteristic length or in rad, within which positions are the same


def random_positions(mechanism: Mechanism, count: int, seed: int, state: State | None = None) -> Float[Array, "count bodies 3"]:
    """Return the position of `state`, by default the initial guess, and random ones around it, `count` in total, none closed.

    Angles are arbitrary, and places vary within the size of the mechanism.
    """
    rng = np.random.default_rng(int(seed))
    q = np.asarray(mechanism.q0 if state is None else state.q)
    positions = np.tile(q, (count, 1, 1))
    spread = max(float(np.ptp(q[:, :2], axis=0).max()), float(analyse(mechanism).length))
    positions[1:, :, 2] += rng.uniform(-np.pi, np.pi, (count - 1, len(q)))
    positions[1:, :, :2] += rng.uniform(-0.5, 0.5, (count - 1, len(q), 2)) * spread
    return jnp.asarray(positions)


def distinct_positions(q: Float[Array, "count bodies 3"], valid: Bool[Array, "count"], scales: Scales) -> list[int]:
    """Return the indices of valid positions that differ, by more than whole turns, from all valid positions before them."""
    points = np.asarray(q, float)
    length, different = float(scales.length), []
    for k in np.flatnonzero(np.asarray(valid)):
        d = points[k] - points[different]
        d[..., 2] = 2 * np.abs(np.sin(d[..., 2] / 2))
        d[..., :2] /= length
        if not different or np.min(np.max(np.abs(d), axis=(1, 2))) > SAME_POSITION_TOL:
            different.append(int(k))
    return different
