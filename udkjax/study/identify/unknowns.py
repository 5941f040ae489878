"""The unknowns of a fit that are parameters: what values they may take, and how a mechanism gets them.

An unknown z is dimensionless, zero at the first guess x0, and may be any number: a positive parameter is x = x0 exp(z), one
between bounds is x = low + (high - low) / (1 + (1 / u0 - 1) exp(-z)) with u0 the place of x0 between them, and any other one is
x = x0 + scale z.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.scene.mechanism import Mechanism
from udkjax.scene.parameters import parameters_of, split

Transform = Literal["positive", "bounded", "free"]
AT_BOUND = 1e-3  # of the distance of the bounds: what counts as being at one of them


class Target(NamedTuple):
    """What a value is put into: hashable, so that what is compiled for it serves all values."""

    names: tuple[str, ...] = ()
    scaled: bool = False
    function: Callable[[Mechanism, Any], Mechanism] | None = None


@dataclass(frozen=True, eq=False)
class Unknowns:
    """All parameters: their names and targets, first guesses, transforms and priors; arrays (P,)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    targets: tuple[Target, ...]
    start: Float[np.ndarray, "P"]
    kinds: tuple[Transform, ...]
    low: Float[np.ndarray, "P"]
    high: Float[np.ndarray, "P"]
    scale: Float[np.ndarray, "P"]
    mean: Float[np.ndarray, "P"]  # of the prior; not a number: none
    sigma: Float[np.ndarray, "P"]
    own: bool = False  # whether all first guesses are the scene's values

    def values(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """x of z."""
        return self._by_kind(z)[0]

    def slopes(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """dx/dz."""
        return self._by_kind(z)[1]

    @np.errstate(over="ignore", invalid="ignore")
    def _by_kind(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, slope = np.empty_like(z), np.empty_like(z)
        for k, kind in enumerate(self.kinds):
            x0, low, high = self.start[k], self.low[k], self.high[k]
            if kind == "positive":
                x[..., k] = slope[..., k] = x0 * np.exp(z[..., k])
            elif kind == "bounded":
                part = 1.0 / (1.0 + ((high - x0) / (x0 - low)) * np.exp(-z[..., k]))
                x[..., k], slope[..., k] = low + (high - low) * part, (high - low) * part * (1.0 - part)
            else:
                x[..., k], slope[..., k] = x0 + self.scale[k] * z[..., k], self.scale[k]
        return x, slope

    def unknowns(self, x: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """z of x."""
        z = np.empty_like(x)
        for k, kind in enumerate(self.kinds):
            x0, low, high = self.start[k], self.low[k], self.high[k]
            if kind == "positive":
                z[..., k] = np.log(x[..., k] / x0)
            elif kind == "bounded":
                z[..., k] = np.log((x[..., k] - low) / (high - x[..., k]) * ((high - x0) / (x0 - low)))
            else:
                z[..., k] = (x[..., k] - x0) / self.scale[k]
        return z

    def at_bounds(self, x: Float[np.ndarray, "P"]) -> tuple[str, ...]:
        """The names of those that are at one of their bounds."""
        near = np.minimum(x - self.low, self.high - x) <= AT_BOUND * (self.high - self.low)
        return tuple(name for name, at, kind in zip(self.names, near, self.kinds, strict=True) if at and kind == "bounded")


def applied(mechanism: Mechanism, targets: Sequence[Target], x: Any) -> Mechanism:
    """The mechanism with the values x (P,) in, in the order of the parameters. Pure; x may be traced."""
    base, values = parameters_of(mechanism), {}
    for k, target in enumerate(targets):
        if target.function is not None:
            mechanism = target.function(mechanism.with_parameters(values) if values else mechanism, x[k])
            values = {}
        else:
            values |= {name: x[k] * entry_of(base, name) if target.scaled else x[k] for name in target.names}
    return mechanism.with_parameters(values) if values else mechanism


def entry_of(known: Mapping[str, Any], name: str) -> Array:
    """A parameter, or one entry of one, among those of a mechanism."""
    owner, index = split(name, known)
    return jnp.asarray(known[owner].value)[index]
