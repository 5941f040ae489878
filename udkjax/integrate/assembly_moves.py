"""Bodies that assembly moves far from the positions written down: a number that is mistyped closes silently."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.scene.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.suspicions import body_sizes

WORTH_SAYING = 0.01  # of a body's size: what a drawing to scale, or numbers of three digits, leave open


class AssemblyWarning(UserWarning):
    """Assembly moved a body by more than a hundredth of its size from its initial guess."""


def moves_of_assembly(mechanism: Mechanism, q: Float[Array, "bodies 3"]) -> tuple[str, ...]:
    """Return, in words, how far each body was moved from its initial guess to the assembled q, where that is worth saying."""
    change = np.asarray(q) - np.asarray(mechanism.q0)
    distance, angle = np.hypot(change[:, 0], change[:, 1]), np.abs(change[:, 2])
    if not np.any(change):
        return ()
    return tuple(_moves(mechanism, distance, angle))


def _moves(mechanism: Mechanism, distances: np.ndarray, angles: np.ndarray) -> Iterator[str]:
    sizes = body_sizes(mechanism)
    for name, distance, angle in zip(mechanism.body_names, distances, angles, strict=True):
        if distance + angle * sizes[name] > WORTH_SAYING * sizes[name]:
            yield f"assembly moved {name} by {distance:.2g} m and {np.degrees(angle):.2g} deg"


@cached_by_identity
def moves_from_guess(mechanism: Mechanism, t: Array | np.ndarray, closure: Any) -> str:
    """Return a warning where assembly moved a body of a mechanism of known numbers far, to the `Closure` at time t (s)."""
    if isinstance(t, Tracer) or (t and mechanism.drivers) or not closure.is_closed:
        return ""  # at a later time it is the drivers' business where the bodies are
    moves = moves_of_assembly(mechanism, closure.state.q)
    cure = "if that is not meant, a number of these bodies or of their joints is wrong; udk.check says more"
    return f"{'; '.join(moves)}: {cure}" if moves else ""
