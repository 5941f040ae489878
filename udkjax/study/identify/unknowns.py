"""The unknowns of a fit that are parameters: values in a mechanism, and dimensionless numbers in place of them.

An unknown z is dimensionless, zero at the first guess x0, and may be any number: a positive parameter is x = x0 exp(z), one
between bounds is x = low + (high - low) / (1 + (1 / u0 - 1) exp(-z)) with u0 the place of x0 between them, and any other one is
x = x0 + scale z.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Array, ArrayLike, Float

from udkjax.scene.mechanism import Mechanism
from udkjax.study.quantities import parameter_value

Transform = Literal["positive", "bounded", "free"]
Setter: TypeAlias = Callable[[Mechanism, ArrayLike], Mechanism]  # (mechanism, value) -> mechanism
AT_BOUND = 1e-3  # of the distance between the bounds: a value as near to one of them is said to be at it
FAR = 20.0  # of an unknown: a positive parameter a hundred million times too large is not looked at
GUESS_RADIUS = 0.5  # of a value: how far other guesses are from the first
BOUND_MARGIN = 0.02  # of the distance between the bounds: no guess is nearer, since bounds themselves are infinitely far
STATE_RADIUS = 0.05  # of the scene's length, time and one radian: how far guesses of initial states are from the first


class Target(NamedTuple):
    """What a value is assigned to: hashable, so that what is compiled for it serves all values."""

    names: tuple[str, ...] = ()
    scaled: bool = False
    function: Setter | None = None


class Unknown(NamedTuple):
    """One parameter: what it is called, what its value is assigned to, its first guess, transform, and prior (nan: none)."""

    name: str
    units: str
    target: Target
    guess: float
    kind: Transform
    low: float
    high: float
    scale: float
    mean: float
    sigma: float
    at_scene_value: bool  # whether the first guess is the scene's own


@dataclass(frozen=True, eq=False)
class Unknowns:
    """All P parameters: see `Unknown`; arrays are (P,)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    targets: tuple[Target, ...]
    guess: Float[np.ndarray, "P"]
    kinds: tuple[Transform, ...]
    low: Float[np.ndarray, "P"]
    high: Float[np.ndarray, "P"]
    scale: Float[np.ndarray, "P"]
    mean: Float[np.ndarray, "P"]
    sigma: Float[np.ndarray, "P"]
    at_scene_values: bool = False  # whether all first guesses are

    @classmethod
    def of(cls, each: Sequence[Unknown]) -> "Unknowns":
        """Return some parameters as one."""
        guess, low, high, scale, mean, sigma = np.array(
            [[u.guess, u.low, u.high, u.scale, u.mean, u.sigma] for u in each], float
        ).T
        return cls(
            tuple(u.name for u in each),
            tuple(u.units for u in each),
            tuple(u.target for u in each),
            guess,
            tuple(u.kind for u in each),
            low,
            high,
            scale,
            mean,
            sigma,
            all(u.at_scene_value for u in each),
        )

    def values(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return x(z)."""
        return self._values_and_slopes(z)[0]

    def dx_dz(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return dx/dz."""
        return self._values_and_slopes(z)[1]

    @np.errstate(over="ignore", invalid="ignore")
    def _values_and_slopes(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, slope = np.empty_like(z), np.empty_like(z)
        for k, kind in enumerate(self.kinds):
            x0, low, high = self.guess[k], self.low[k], self.high[k]
            if kind == "positive":
                x[..., k] = slope[..., k] = x0 * np.exp(z[..., k])
            elif kind == "bounded":
                part = 1.0 / (1.0 + ((high - x0) / (x0 - low)) * np.exp(-z[..., k]))
                x[..., k], slope[..., k] = low + (high - low) * part, (high - low) * part * (1.0 - part)
            else:
                x[..., k], slope[..., k] = x0 + self.scale[k] * z[..., k], self.scale[k]
        return x, slope

    def z_of(self, x: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return z(x)."""
        z = np.empty_like(x)
        for k, kind in enumerate(self.kinds):
            x0, low, high = self.guess[k], self.low[k], self.high[k]
            if kind == "positive":
                z[..., k] = np.log(x[..., k] / x0)
            elif kind == "bounded":
                z[..., k] = np.log((x[..., k] - low) / (high - x[..., k]) * ((high - x0) / (x0 - low)))
            else:
                z[..., k] = (x[..., k] - x0) / self.scale[k]
        return z

    def at_bounds(self, x: Float[np.ndarray, "P"]) -> tuple[str, ...]:
        """Return the names of those that are at one of their bounds."""
        near = np.minimum(x - self.low, self.high - x) <= AT_BOUND * (self.high - self.low)
        return tuple(name for name, at, kind in zip(self.names, near, self.kinds, strict=True) if at and kind == "bounded")


def apply_values(mechanism: Mechanism, targets: Sequence[Target], x: Float[Array, "P"] | np.ndarray) -> Mechanism:
    """Return the mechanism with the values x (P,) assigned, in the order of the parameters. Pure; x may be traced."""
    base, values = mechanism, {}
    for k, target in enumerate(targets):
        if target.function is not None:
            mechanism = target.function(mechanism.with_parameters(values) if values else mechanism, x[k])
            values = {}
        else:
            values |= {name: x[k] * parameter_value(base, name) if target.scaled else x[k] for name in target.names}
    return mechanism.with_parameters(values) if values else mechanism


def sample_guesses(u: Unknowns, z: Float[np.ndarray, "K"], count: int, seed: int) -> Float[np.ndarray, "B K"]:
    """Sample guesses beside a first one: each parameter within a half of its value, or anywhere between its bounds.

    Unknowns of initial states, which come after the parameters, are moved by a little.
    """
    from scipy.stats import qmc  # here: it takes a second

    P = len(u.names)
    unit = qmc.Sobol(len(z), rng=seed).random(1 << max(0, int(np.ceil(np.log2(count)))))[:count]
    x0 = u.values(z[None, :P])[0]
    bounded = np.array([kind == "bounded" for kind in u.kinds])
    size = np.where([kind == "positive" for kind in u.kinds], x0, u.scale)
    low, high = np.where(bounded, u.low, x0 - GUESS_RADIUS * size), np.where(bounded, u.high, x0 + GUESS_RADIUS * size)
    inside = BOUND_MARGIN + (1.0 - 2.0 * BOUND_MARGIN) * unit[:, :P]
    states = z[P:] + STATE_RADIUS * (2.0 * unit[:, P:] - 1.0)
    return np.concatenate([u.z_of(low + (high - low) * inside), states], axis=1)
